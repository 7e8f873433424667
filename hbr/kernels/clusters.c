/* Five clusters of colours, with the labels of cv2.kmeans with ten iterations from centres by k-means++.

   Source: D. Arthur and S. Vassilvitskii, "k-means++: the advantages of careful seeding", SODA 2007. Colours are whole
   numbers, so sums of colours and of the first distances are exact in any order. */
#include "grab_cut.h"

#define ROUNDS 10 /* of the centres, including the ones drawn at random */
#define TRIALS 3  /* drawn for each further centre; the best one is used */
#define BLOCK 4096
#define STILL (1.1920928955078125e-07 * 1.1920928955078125e-07) /* largest squared movement of centres that count as still */

/* Multiply with carry, as cv::RNG does. */
PART uint32_t drawn(uint64_t *random) {
    *random = (uint64_t)(uint32_t)*random * 4164903690u + (uint32_t)(*random >> 32);
    return (uint32_t)*random;
}

PART double drawn_share(uint64_t *random) {
    const uint64_t high = drawn(random);
    return (double)(high << 32 | drawn(random)) * 5.4210108624275221700372640043497e-20; /* 2^-64 */
}

PART int64_t fewer(int64_t a, int64_t b) { return a < b ? a : b; }

struct samples {
    const float *blue, *green, *red;
    int64_t count;
};

/* Store the smaller of `before` and the squared distance to one of the samples. Returns the sum of the stored ones. */
PART int64_t distances(const struct samples *s, int64_t at, const int32_t *before, int32_t *after) {
    const float blue = s->blue[at], green = s->green[at], red = s->red[at];
    int64_t sum = 0;
    for (int64_t begin = 0; begin < s->count; begin += BLOCK) {
        const int64_t end = fewer(begin + BLOCK, s->count);
        int32_t part = 0;
#pragma GCC ivdep
        for (int64_t i = begin; i < end; i++) {
            const float b = s->blue[i] - blue, g = s->green[i] - green, r = s->red[i] - red;
            const int32_t own = (int32_t)(b * b + g * g + r * r);
            after[i] = own < before[i] ? own : before[i];
            part += after[i];
        }
        sum += part;
    }
    return sum;
}

/* Return the first sample up to which the distances add up to a value; the last one if their sum is smaller. */
PART int64_t reached(const int32_t *distance, int64_t count, double value) {
    int64_t at = 0;
    for (; at + 64 < count; at += 64) {
        int32_t part = 0;
        for (int64_t i = at; i < at + 64; i++) part += distance[i];
        if (value - part <= 0) break;
        value -= part; /* exact: both are multiples of the same power of two */
    }
    for (; at < count - 1; at++) {
        value -= distance[at];
        if (value <= 0) break;
    }
    return at;
}

/* Draw the first centres among the samples. */
PART void draw_centres(const struct samples *s, uint64_t *random, int32_t *work, float centre[COLOURS][3]) {
    int32_t *distance = work, *best = work + s->count, *trial = work + 2 * s->count;
    int64_t chosen = (int64_t)(drawn(random) % (uint32_t)s->count);
    for (int64_t i = 0; i < s->count; i++) best[i] = INT32_MAX;
    int64_t sum = distances(s, chosen, best, distance);
    for (int64_t k = 0;; k++) {
        centre[k][0] = s->blue[chosen];
        centre[k][1] = s->green[chosen];
        centre[k][2] = s->red[chosen];
        if (k == COLOURS - 1) return;
        int64_t least = INT64_MAX;
        for (int64_t j = 0; j < TRIALS; j++) {
            const int64_t at = reached(distance, s->count, drawn_share(random) * (double)sum);
            const int64_t own = distances(s, at, distance, trial);
            if (own >= least) continue;
            least = own;
            chosen = at;
            int32_t *other = best;
            best = trial;
            trial = other;
        }
        sum = least;
        int32_t *other = distance;
        distance = best;
        best = other;
    }
}

/* Give each sample the label of the nearest centre, the first one of equal ones. */
PART void assign(const struct samples *s, float centre[COLOURS][3], int32_t *label) {
#pragma GCC ivdep
    for (int64_t i = 0; i < s->count; i++) {
        const float blue = s->blue[i], green = s->green[i], red = s->red[i];
        float least = __builtin_inff();
        int32_t own = 0;
#pragma GCC unroll 5
        for (int32_t k = 0; k < COLOURS; k++) {
            const float b = blue - centre[k][0], g = green - centre[k][1], r = red - centre[k][2];
            const float distance = b * b + g * g + r * r;
            own = least > distance ? k : own;
            least = least > distance ? distance : least;
        }
        label[i] = own;
    }
}

/* Count and add up the samples of each label. */
PART void add_up(const struct samples *s, const int32_t *label, int32_t sum[COLOURS][4]) {
    for (int32_t k = 0; k < COLOURS; k++) {
        int32_t blue = 0, green = 0, red = 0, count = 0;
        for (int64_t i = 0; i < s->count; i++) {
            const int32_t own = -(label[i] == k);
            blue += (int32_t)s->blue[i] & own;
            green += (int32_t)s->green[i] & own;
            red += (int32_t)s->red[i] & own;
            count -= own;
        }
        sum[k][0] = blue;
        sum[k][1] = green;
        sum[k][2] = red;
        sum[k][3] = count;
    }
}

/* Give each label without samples the sample of the largest cluster that is farthest from its centre. */
PART void fill_empty(const struct samples *s, int32_t *label, int32_t sum[COLOURS][4]) {
    for (int32_t k = 0; k < COLOURS; k++) {
        if (sum[k][3]) continue;
        int32_t most = 0;
        for (int32_t other = 1; other < COLOURS; other++)
            if (sum[most][3] < sum[other][3]) most = other;
        const float share = 1.0f / (float)sum[most][3];
        const float blue = (float)sum[most][0] * share, green = (float)sum[most][1] * share;
        const float red = (float)sum[most][2] * share;
        float farthest = 0;
        int64_t moved = 0;
        for (int64_t i = 0; i < s->count; i++) {
            if (label[i] != most) continue;
            const float b = s->blue[i] - blue, g = s->green[i] - green, r = s->red[i] - red;
            const float distance = b * b + g * g + r * r;
            if (farthest <= distance) {
                farthest = distance;
                moved = i;
            }
        }
        label[moved] = k;
        const int32_t colour[4] = {(int32_t)s->blue[moved], (int32_t)s->green[moved], (int32_t)s->red[moved], 1};
        for (int32_t c = 0; c < 4; c++) {
            sum[most][c] -= colour[c];
            sum[k][c] += colour[c];
        }
    }
}

FOR_EVERY_PROCESSOR void hbr_find_clusters(const float *colours, int64_t stride, int64_t count, uint64_t *random,
                                           int32_t *work, int32_t *label) {
    const struct samples samples = {colours, colours + stride, colours + 2 * stride, count};
    float centre[COLOURS][3];
    draw_centres(&samples, random, work, centre);
    for (int64_t round = 1;; round++) {
        assign(&samples, centre, label);
        int32_t sum[COLOURS][4];
        add_up(&samples, label, sum);
        fill_empty(&samples, label, sum);
        double farthest = 0;
        for (int32_t k = 0; k < COLOURS; k++) {
            const float share = 1.0f / (float)sum[k][3];
            double squared = 0;
            for (int32_t c = 0; c < 3; c++) {
                const float before = centre[k][c];
                centre[k][c] = (float)sum[k][c] * share;
                const double moved = (double)(centre[k][c] - before);
                squared += moved * moved;
            }
            farthest = farthest < squared ? squared : farthest;
        }
        if (round == ROUNDS - 1 || farthest <= STILL) return; /* the labels do not change any more */
    }
}
