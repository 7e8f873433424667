/* The support of the dense filter, with the same bits as hbr/dense/index.py, which explains it. */
#include "kernels.h"

#define BINS 72
#define FAR_DEG 2000.0

PART float larger(float a, float b) { return a > b ? a : b; }

/* Store what one query adds to every azimuth of each object, (objects, 72).

   Object j has the `count[j]` rows from `rows[begin[j]]` on, by rising azimuth. `levels` are the powers of the
   similarities of all rows. `scratch` has room for 5 floats and a double for each of twice the largest count. */
FOR_EVERY_PROCESSOR
EXPORT void hbr_support(const int64_t *rows, const int64_t *begin, const int64_t *count, int64_t objects,
                        const double *azimuth_deg, const float *levels, double slope, double part_deg, int64_t whole,
                        double *scratch, int64_t room, float *support) {
    double *ring_deg = scratch;
    float *own = (float *)(ring_deg + room), *penalty = own + room, *before = penalty + room, *behind = before + room;
    const float none = -__builtin_inff();
    double seen_deg[BINS];
    float slope_at[BINS], best[BINS];
    for (int b = 0; b < BINS; b++) {
        seen_deg[b] = part_deg + b * 5.0;
        slope_at[b] = (float)(seen_deg[b] * slope);
    }
    for (int64_t j = 0; j < objects; j++, support += BINS) {
        const int64_t n = count[j], two = 2 * n;
        const int64_t *mine = rows + begin[j];
        int64_t first = 0; /* two revolutions, from 180° before 0 on */
        while (first < n && azimuth_deg[mine[first]] < 180) first++;
        for (int64_t i = 0; i < n; i++) {
            const int64_t k = first + i < n ? first + i : first + i - n, row = mine[k];
            const double deg = azimuth_deg[row] < 180 ? azimuth_deg[row] : azimuth_deg[row] - 360;
            ring_deg[i] = deg;
            ring_deg[n + i] = deg + 360;
            own[i] = own[n + i] = levels[row];
        }
        const double shift = 2 * FAR_DEG * (double)j; /* as the reference searches all objects at once */
        for (int64_t i = 0; i + 1 < two; i++) {
            const double end_deg = (ring_deg[i + 1] + ring_deg[i]) / 2;
            penalty[i] = (float)(end_deg * slope);
            ring_deg[i] = end_deg + shift;
        }
        float largest_before = none, largest_behind = none;
        before[0] = behind[two - 1] = none;
        for (int64_t i = 0, k = two - 2; i + 1 < two; i++, k--) { /* together: each waits for its last maximum */
            before[i + 1] = largest_before = larger(largest_before, own[i] + penalty[i]);
            behind[k] = largest_behind = larger(largest_behind, own[k + 1] - penalty[k]);
        }
        int64_t nearest = 0;
        for (int b = 0; b < BINS; b++) {
            const double seen = seen_deg[b] + shift;
            while (nearest + 1 < two && ring_deg[nearest] < seen) nearest++;
            const float beside = larger(before[nearest] - slope_at[b], behind[nearest] + slope_at[b]);
            best[b] = larger(beside, own[nearest]);
        }
        for (int b = 0; b < BINS; b++) support[b] = best[(b + whole) % BINS];
    }
}
