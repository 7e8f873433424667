/* The paths of the paper's retrieval, with the same bits as hbr/paper/hough.py, which explains them. */
#include "kernels.h"

#define LONGEST 4096

/* The distance of two directions in revolutions, as in hbr/core/angles.py. A large summand rounds halves to even. */
PART double revolutions(double difference_deg) {
    const double large = 6755399441055744.0, quotient = difference_deg / 360.0;
    return __builtin_fabs(difference_deg - 360.0 * ((quotient + large) - large)) / 360.0;
}

PART int is_before(const int64_t *object_index, int64_t a, int64_t b) {
    return object_index[a] < object_index[b] || (object_index[a] == object_index[b] && a < b);
}

static void sink(const int64_t *object_index, int64_t *rows, int64_t i, int64_t count) {
    const int64_t row = rows[i];
    for (int64_t child; (child = 2 * i + 1) < count; i = child) {
        if (child + 1 < count && is_before(object_index, rows[child], rows[child + 1])) child++;
        if (!is_before(object_index, row, rows[child])) break;
        rows[i] = rows[child];
    }
    rows[i] = row;
}

/* Sort views by object, then by index, drop repeated ones, and return how many are left. */
static int64_t sorted(const int64_t *object_index, int64_t *rows, int64_t count) {
    for (int64_t i = count / 2 - 1; i >= 0; i--) sink(object_index, rows, i, count);
    for (int64_t last = count - 1; last > 0; last--) {
        const int64_t row = rows[0];
        rows[0] = rows[last];
        rows[last] = row;
        sink(object_index, rows, 0, last);
    }
    int64_t left = count > 0;
    for (int64_t i = 1; i < count; i++)
        if (rows[i] != rows[left - 1]) rows[left++] = rows[i];
    return left;
}

PART int32_t dot(const int16_t *query, const uint8_t *row, int64_t length) {
    int32_t sum = 0;
    for (int64_t i = 0; i < length; i++) sum += query[i] * (int16_t)row[i];
    return sum;
}

/* Store the score and the best path of every object, in ascending order of the objects, and the number of objects.

   The views `rows[begin[i]]` to `rows[begin[i + 1] - 1]` are those of query i; they are sorted in place. Every object has
   a view for each query. `value` and `predecessor` have room for all of them, `paths` is (objects, queries). */
FOR_EVERY_PROCESSOR
EXPORT void hbr_paths(const uint8_t *queries, int64_t query_stride, int64_t query_count, int64_t length,
                      const uint8_t *descriptors, int64_t stride, const int64_t *object_index,
                      const double *azimuth_deg, const double *orientation_deg, double omega, const int64_t *begin,
                      int64_t *rows, double *value, int64_t *predecessor, double *scores, int64_t *paths,
                      int64_t *objects) {
    int16_t query[LONGEST];
    int64_t before = 0, before_count = 0; /* the views of the previous query */
    /* forward: the best value of a path that ends at each view, and its predecessor on that path */
    for (int64_t i = 0; i < query_count; i++) {
        int64_t *here = rows + begin[i];
        const int64_t count = sorted(object_index, here, begin[i + 1] - begin[i]);
        int32_t square = 0;
        for (int64_t b = 0; b < length; b++) {
            query[b] = queries[i * query_stride + b];
            square += query[b] * query[b];
        }
        int64_t tail = 0;
        for (int64_t k = 0; k < count; k++) {
            const uint8_t *levels = descriptors + here[k] * stride;
            int32_t own = 0;
            for (int64_t b = 0; b < length; b++) own += (int16_t)levels[b] * (int16_t)levels[b];
            const int32_t product = dot(query, levels, length);
            const double either = (double)square + (double)own - (double)product;
            const double similar = either > 0 ? (double)product / either : 0;
            double best = 0;
            if (i) {
                const int64_t object = object_index[here[k]];
                const double rotated_deg = orientation_deg[i - 1] - orientation_deg[i];
                while (object_index[rows[before + tail]] < object) tail++;
                best = -__builtin_inf();
                for (int64_t t = tail; t < before_count && object_index[rows[before + t]] == object; t++) {
                    const double azimuth_step_deg = azimuth_deg[rows[before + t]] - azimuth_deg[here[k]];
                    const double through = value[before + t] - omega * revolutions(azimuth_step_deg - rotated_deg);
                    if (through > best) {
                        best = through;
                        predecessor[begin[i] + k] = before + t;
                    }
                }
            }
            value[begin[i] + k] = i ? best + similar : similar;
        }
        before = begin[i];
        before_count = count;
    }
    /* backward: follow the predecessors from the best last view of each object */
    int64_t found = 0;
    for (int64_t k = 0; k < before_count; found++) {
        const int64_t object = object_index[rows[before + k]];
        int64_t node = before + k;
        for (; k < before_count && object_index[rows[before + k]] == object; k++)
            if (value[before + k] > value[node]) node = before + k;
        scores[found] = value[node];
        for (int64_t i = query_count - 1; i >= 0; i--) {
            paths[found * query_count + i] = rows[node];
            node = predecessor[node];
        }
    }
    *objects = found;
}
