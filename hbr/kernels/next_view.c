/* Parts of the choice of the next view, with the same bits as hbr/dense/next_view.py and hbr/dense/index.py. */
#include "kernels.h"

/* Return the nearest whole number; halves are rounded to even. For values below 2^51. */
PART double nearest_whole(double value) { return (value + 6755399441055744.0) - 6755399441055744.0; }

/* Return the size of a difference of directions, 0..180. */
PART double size_deg(double difference) {
    const double size = difference - 360.0 * nearest_whole(difference / 360.0);
    return size < 0 ? -size : size;
}

/* Return an angle below 10^9 in [0, 360): the product and the differences are exact. */
PART double wrap360(double deg) {
    double rest = deg - 360.0 * (double)(int64_t)(deg / 360.0);
    if (rest >= 360.0) rest -= 360.0;
    if (rest < 0) rest += 360.0;
    return rest == 360.0 ? 0.0 : rest; /* a tiny negative angle is rounded up */
}

/* Store which view of each object is nearest to the azimuths, (angles, size), and how far away it is; of equally near
   views, the one with the smaller azimuth.

   Object j has the `count[j]` rows from `order[begin[j]]` on, by ascending azimuth. */
EXPORT void hbr_nearest_view(const int64_t *order, const int64_t *begin, const int64_t *count,
                             const double *azimuth_deg, const int64_t *places, int64_t size, const double *at_deg,
                             int64_t angles, int64_t *rows, double *away_deg) {
    for (int64_t m = 0; m < size; m++) {
        const int64_t *own = order + begin[places[m]], n = count[places[m]];
        int64_t next = 0; /* the first view at or after the azimuth: often near the last one */
        for (int64_t a = 0; a < angles; a++) {
            const double at = at_deg[a * size + m], key = wrap360(at);
            while (next < n && azimuth_deg[own[next]] < key) next++;
            while (next && azimuth_deg[own[next - 1]] >= key) next--;
            const int64_t behind = next == n ? 0 : next;
            int64_t before = next ? next - 1 : n - 1;
            while (before && azimuth_deg[own[before - 1]] == azimuth_deg[own[before]]) before--;
            const double before_deg = size_deg(azimuth_deg[own[before]] - at);
            const double behind_deg = size_deg(azimuth_deg[own[behind]] - at);
            const int is_before = before_deg < behind_deg || (before_deg == behind_deg && before < behind);
            rows[a * size + m] = own[is_before ? before : behind];
            away_deg[a * size + m] = is_before ? before_deg : behind_deg;
        }
    }
}
