/* Parts of the fit of a plane to the difference of two images, with the same bits as hbr/segmentation/background.py. The
   products of matrices are left to NumPy. */
#include "kernels.h"

PART double absolute(double a) { return a < 0 ? -a : a; }
PART double larger(double a, double b) { return a > b ? a : b; }

/* Return the value that has this place after sorting. Changes the order of the values. */
static double selected(double *value, int64_t count, int64_t place) {
    int64_t first = 0, last = count - 1;
    while (first < last) {
        const double middle = value[first + (last - first) / 2];
        int64_t i = first, j = last;
        while (i <= j) {
            while (value[i] < middle) i++;
            while (value[j] > middle) j--;
            if (i > j) break;
            const double other = value[i];
            value[i++] = value[j];
            value[j--] = other;
        }
        if (place <= j)
            last = j;
        else if (place >= i)
            first = i;
        else
            break;
    }
    return value[place];
}

/* Take every fifth pixel in both directions, from the third one on, if both images (height, width) are neither black
   nor overexposed there: `useful` marks these pixels of one image, `small` (height, width, 3) has the levels of the
   other, whose logarithms are in `logarithm` (256). `plane` (rows, columns, 3) is what is fitted there. -> `count` rows
   of `basis` and `difference` (count, 3), and the medians (3) of the latter. `work` has 3 * rows * columns numbers. */
EXPORT void hbr_samples(const uint8_t *small, const uint8_t *useful, const float *logarithm, const float *table_log,
                        int64_t height, int64_t width, const double *plane, double *work, double *basis,
                        double *difference, double *median, int64_t *count) {
    int64_t n = 0;
    for (int64_t y = 2; y < height; y += 5)
        for (int64_t x = 2; x < width; x += 5, plane += 3) {
            const int64_t at = y * width + x;
            const uint8_t b = small[3 * at], g = small[3 * at + 1], r = small[3 * at + 2], bg = b > g ? b : g;
            const uint8_t brightest = bg > r ? bg : r;
            if (!useful[at] || brightest <= 6 || brightest >= 250) continue;
            for (int64_t c = 0; c < 3; c++) {
                basis[3 * n + c] = plane[c];
                difference[3 * n + c] = (double)(logarithm[small[3 * at + c]] - table_log[3 * at + c]);
            }
            n++;
        }
    *count = n;
    if (!n) return;
    for (int64_t c = 0; c < 3; c++) {
        for (int64_t i = 0; i < n; i++) work[i] = difference[3 * i + c];
        median[c] = selected(work, n, n / 2);
        if (n % 2) continue;
        double below = work[0];
        for (int64_t i = 1; i < n / 2; i++) below = larger(below, work[i]);
        median[c] = (below + median[c]) / 2;
    }
}

/* Choose the rows (count, 3) that differ from what is fitted by at most `tolerance`, or, if these are too few, the
   nearest ones up to the place `quarter`. -> `kept` rows of `own_basis` and `own_values`. `work` holds 2 * count
   numbers. */
EXPORT void hbr_inliers(const double *values, const double *fitted, const double *basis, int64_t count, double tolerance,
                        int64_t quarter, double *work, double *own_basis, double *own_values, int64_t *kept) {
    double *away = work, *sorted = work + count;
    int64_t near = 0;
    for (int64_t i = 0; i < count; i++) {
        const double *v = values + 3 * i, *f = fitted + 3 * i;
        away[i] = larger(larger(absolute(v[0] - f[0]), absolute(v[1] - f[1])), absolute(v[2] - f[2]));
        near += away[i] <= tolerance;
    }
    double limit = tolerance;
    if (near <= quarter) {
        for (int64_t i = 0; i < count; i++) sorted[i] = away[i];
        limit = selected(sorted, count, quarter);
    }
    int64_t n = 0;
    for (int64_t i = 0; i < count; i++) {
        if (away[i] > limit) continue;
        for (int64_t c = 0; c < 3; c++) {
            own_basis[3 * n + c] = basis[3 * i + c];
            own_values[3 * n + c] = values[3 * i + c];
        }
        n++;
    }
    *kept = n;
}
