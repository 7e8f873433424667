/* The support of the dense filter, with the same bits as hbr/dense/index.py, which explains it. */
#include "kernels.h"

#define BINS 72
#define FAR_DEG 2000.0
#define CLEAR_DEG 1e-3 /* more than the rounding of the largest shift */

PART float larger(float a, float b) { return a > b ? a : b; }

/* Find the view whose arc contains each azimuth: the first of `two` - 1 ends that is not before it, or the view after
   them. The azimuths are shifted for object j, because the reference searches all objects at once. */
PART void find_arcs(const double *seen_deg, const double *end_deg, int64_t two, int64_t j, int64_t *nearest) {
    const double shift = 2 * FAR_DEG * (double)j;
    int64_t at = 0;
    for (int b = 0; b < BINS; b++) {
        const double seen = seen_deg[b] + shift;
        while (at + 1 < two && end_deg[at] + shift < seen) at++;
        nearest[b] = at;
    }
}

/* Return whether each azimuth is at an end, or so far from it that the rounding of another shift has no effect. */
PART int is_clear(const double *seen_deg, const double *end_deg, int64_t two, const int64_t *nearest) {
    int clear = 1;
    for (int b = 0; b < BINS; b++) {
        const double before = nearest[b] ? seen_deg[b] - end_deg[nearest[b] - 1] : 1;
        const double behind = nearest[b] + 1 < two ? end_deg[nearest[b]] - seen_deg[b] : 1;
        clear &= before > CLEAR_DEG && (behind > CLEAR_DEG || behind == 0);
    }
    return clear;
}

/* Store the support that one query adds to every azimuth of each object, (objects, 72).

   Object j has the `count[j]` rows from `rows[begin[j]]` on, by ascending azimuth. `levels` are the powers of the
   similarities of all rows. `scratch` has room for 4 floats and 2 doubles for each of twice the largest count. */
FOR_EVERY_PROCESSOR
EXPORT void hbr_support(const int64_t *rows, const int64_t *begin, const int64_t *count, int64_t objects,
                        const double *azimuth_deg, const float *levels, double slope, double part_deg, int64_t whole,
                        double *scratch, int64_t room, float *support) {
    double *ring_deg = scratch, *end_deg = ring_deg + room;
    float *own = (float *)(end_deg + room), *penalty = own + room, *before = penalty + room, *behind = before + room;
    const float none = -__builtin_inff();
    const float revolution = (float)(slope * 360);
    double seen_deg[BINS];
    float slope_at[BINS], best[BINS];
    int64_t nearest[BINS], ready = 0; /* number of views for which the arcs are known; 0 if unknown */
    for (int b = 0; b < BINS; b++) {
        seen_deg[b] = part_deg + b * 5.0;
        slope_at[b] = (float)(seen_deg[b] * slope);
    }
    for (int64_t j = 0; j < objects; j++, support += BINS) {
        const int64_t n = count[j], two = 2 * n;
        const int64_t *mine = rows + begin[j];

        /* two revolutions, from −180° on; usually at the azimuths of the previous object */
        int64_t first = 0, moved = n != ready;
        while (first < n && azimuth_deg[mine[first]] < 180) first++;
        for (int64_t i = 0; i < n; i++) {
            const int64_t k = first + i < n ? first + i : first + i - n, row = mine[k];
            const double deg = azimuth_deg[row] < 180 ? azimuth_deg[row] : azimuth_deg[row] - 360;
            moved |= deg != ring_deg[i];
            ring_deg[i] = deg;
            ring_deg[n + i] = deg + 360;
            own[i] = own[n + i] = levels[row];
        }
        if (moved) {
            for (int64_t i = 0; i + 1 < two; i++) {
                end_deg[i] = (ring_deg[i + 1] + ring_deg[i]) / 2;
                penalty[i] = (float)(end_deg[i] * slope);
            }
            find_arcs(seen_deg, end_deg, two, j, nearest);
            ready = is_clear(seen_deg, end_deg, two, nearest) ? n : 0;
        }

        /* the best before and after each view: first within each revolution, because each step needs the previous maximum */
        float one_before = none, two_before = none, one_behind = none, two_behind = none;
        before[0] = behind[two - 1] = none;
        for (int64_t i = 0; i + 1 < n; i++) {
            before[i + 1] = one_before = larger(one_before, own[i] + penalty[i]);
            before[n + i + 1] = two_before = larger(two_before, own[n + i] + penalty[n + i]);
            behind[n - 2 - i] = one_behind = larger(one_behind, own[n - 1 - i] - penalty[n - 2 - i]);
            behind[two - 2 - i] = two_behind = larger(two_behind, own[two - 1 - i] - penalty[two - 2 - i]);
        }
        before[n] = one_before = larger(one_before, own[n - 1] + penalty[n - 1]);
        behind[n - 1] = two_behind = larger(two_behind, own[n] - penalty[n - 1]);
        for (int64_t i = 1; i < n; i++) before[n + i] = larger(one_before, before[n + i]);
        for (int64_t i = 0; i + 1 < n; i++) behind[i] = larger(two_behind, behind[i]);

        for (int b = 0; b < BINS; b++) {
            const int64_t at = nearest[b];
            best[b] = larger(larger(before[at] - slope_at[b], behind[at] + slope_at[b]), own[at]);
        }
        one_before -= revolution; /* the third revolution */
        two_behind -= revolution;
        for (int b = 0; b < BINS; b++)
            best[b] = larger(best[b], larger(one_before - slope_at[b], two_behind + slope_at[b]));
        for (int64_t b = whole; b < BINS; b++) support[b - whole] = best[b];
        for (int64_t b = 0; b < whole; b++) support[BINS - whole + b] = best[b];
    }
}
