/* The cut of an object by its colours, with the mask of cv2.grabCut after one iteration from a mask.

   Source: C. Rother, V. Kolmogorov and A. Blake, "GrabCut", SIGGRAPH 2004. */
#include "grab_cut.h"

#define GAMMA 50.0              /* largest weight between neighbours */
#define CERTAIN (9 * GAMMA)     /* weight that binds a vertex of the background to the sink */
#define DIAGONAL (GAMMA / (double)1.41421353816986083984375f)
#define SINGULAR 1e-6           /* a covariance with a smaller determinant has no inverse */
#define EPSILON 2.220446049250313e-16
#define NOISE 0.01              /* added to the diagonal of such a covariance */
#define CLEAR 1e-6              /* difference of logarithms whose sign rounding does not change */
#define TINY (-600.0)           /* logarithm of a density that is far above the smallest number */
#define LOST 40.0               /* difference of logarithms: a density smaller by more does not change a sum */
#define ZERO (-746.0)           /* the exponential of a smaller number is 0 */
#define KNOWN 4096              /* number of differences whose weights are stored */
#define MOST_PIXELS 65000       /* with more, sums of colours are not exact in float32 */

typedef double (*function)(double);

enum { BACKGROUND, OBJECT };

struct mixture {
    int64_t count[COLOURS], sum[COLOURS][3], product[COLOURS][3][3];
    double share[COLOURS], mean[COLOURS][3], inverse[COLOURS][3][3], factor[COLOURS];
    double log_factor[COLOURS], log_weight[COLOURS]; /* of the factor, and of its product with the share */
};

PART void start_sums(struct mixture *m) {
    for (int k = 0; k < COLOURS; k++) {
        m->count[k] = 0;
        for (int i = 0; i < 3; i++) {
            m->sum[k][i] = 0;
            for (int j = 0; j < 3; j++) m->product[k][i][j] = 0;
        }
    }
}

PART void add(struct mixture *m, int k, const uint8_t *pixel) {
    m->count[k]++;
    for (int i = 0; i < 3; i++) {
        m->sum[k][i] += pixel[i];
        for (int j = i; j < 3; j++) m->product[k][i][j] += pixel[i] * pixel[j];
    }
}

PART double determinant(const double *c) {
    return c[0] * (c[4] * c[8] - c[5] * c[7]) - c[1] * (c[3] * c[8] - c[5] * c[6]) + c[2] * (c[3] * c[7] - c[4] * c[6]);
}

/* Compute the parts of a mixture from their sums. Returns 0 if one has no inverse covariance. */
PART int learn(struct mixture *m, function logarithm) {
    int64_t total = 0;
    for (int k = 0; k < COLOURS; k++) total += m->count[k];
    for (int k = 0; k < COLOURS; k++) {
        m->share[k] = m->log_factor[k] = 0;
        if (!m->count[k]) continue;
        const double each = 1.0 / (double)m->count[k];
        double c[9], *mean = m->mean[k];
        m->share[k] = (double)m->count[k] / (double)total;
        for (int i = 0; i < 3; i++) mean[i] = (double)m->sum[k][i] * each;
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                c[3 * i + j] = (double)m->product[k][i < j ? i : j][i < j ? j : i] * each - mean[i] * mean[j];
        double found = determinant(c);
        if (found <= SINGULAR) {
            c[0] += NOISE;
            c[4] += NOISE;
            c[8] += NOISE;
            found = determinant(c);
        }
        if (!(found > EPSILON)) return 0;
        const double over = 1.0 / found;
        double(*inverse)[3] = m->inverse[k];
        inverse[0][0] = (c[4] * c[8] - c[5] * c[7]) * over;
        inverse[1][0] = -(c[3] * c[8] - c[5] * c[6]) * over;
        inverse[2][0] = (c[3] * c[7] - c[4] * c[6]) * over;
        inverse[0][1] = -(c[1] * c[8] - c[2] * c[7]) * over;
        inverse[1][1] = (c[0] * c[8] - c[2] * c[6]) * over;
        inverse[2][1] = -(c[0] * c[7] - c[1] * c[6]) * over;
        inverse[0][2] = (c[1] * c[5] - c[2] * c[4]) * over;
        inverse[1][2] = -(c[0] * c[5] - c[2] * c[3]) * over;
        inverse[2][2] = (c[0] * c[4] - c[1] * c[3]) * over;
        m->factor[k] = 1.0 / __builtin_sqrt(found);
        m->log_factor[k] = logarithm(m->factor[k]);
        m->log_weight[k] = m->log_factor[k] + logarithm(m->share[k]);
    }
    return 1;
}

/* Compute for each colour (3, stride) of a row the exponents of the densities: (COLOURS, stride). */
FOR_EVERY_PROCESSOR static void exponents(const struct mixture *m, const double *colour, int64_t count, int64_t stride,
                                          double *exponent) {
    for (int k = 0; k < COLOURS; k++, exponent += stride) {
        if (!(m->share[k] > 0)) {
            for (int64_t i = 0; i < count; i++) exponent[i] = -__builtin_inf();
            continue;
        }
        const double *mean = m->mean[k];
        const double(*inverse)[3] = m->inverse[k];
#pragma GCC ivdep
        for (int64_t i = 0; i < count; i++) {
            const double b = colour[i] - mean[0], g = colour[stride + i] - mean[1], r = colour[2 * stride + i] - mean[2];
            const double sum = b * (b * inverse[0][0] + g * inverse[1][0] + r * inverse[2][0]) +
                               g * (b * inverse[0][1] + g * inverse[1][1] + r * inverse[2][1]) +
                               r * (b * inverse[0][2] + g * inverse[1][2] + r * inverse[2][2]);
            exponent[i] = -0.5 * sum;
        }
    }
}

/* Return the part of a mixture with the highest density. */
PART int likeliest(const struct mixture *m, const double *exponent, int64_t stride, function exponential) {
    double highest = 0;
    int best = 0;
    for (int k = 0; k < COLOURS; k++) {
        if (!(m->share[k] > 0)) continue;
        const double own = m->factor[k] * exponential(exponent[k * stride]);
        if (own > highest) {
            highest = own;
            best = k;
        }
    }
    return best;
}

/* Find the same part for each pixel of a row by the logarithms of the densities: (COLOURS, stride) -> (count). `clear`
   is 0 if they are too close or too small. */
FOR_EVERY_PROCESSOR static void compare(const struct mixture *m, const double *exponent, int64_t count, int64_t stride,
                                        double *part, double *clear) {
#pragma GCC ivdep
    for (int64_t i = 0; i < count; i++) {
        double most = m->log_factor[0] + exponent[i], second = -__builtin_inf(), best = 0;
#pragma GCC unroll 4
        for (int k = 1; k < COLOURS; k++) {
            const double own = m->log_factor[k] + exponent[k * stride + i], lower = own > most ? most : own;
            best = own > most ? k : best;
            second = lower > second ? lower : second;
            most = own > most ? own : most;
        }
        part[i] = best;
        clear[i] = (most > TINY) & (most - second > CLEAR) ? 1.0 : 0.0;
    }
}

/* Return the density of a mixture. Does not compute parts that do not change the sum. */
PART double density(const struct mixture *m, const double *exponent, int64_t stride, function exponential) {
    double most = -__builtin_inf();
    int part[COLOURS], parts = 0;
    for (int k = 0; k < COLOURS; k++) {
        if (!(m->share[k] > 0) || exponent[k * stride] < ZERO) continue;
        const double own = m->log_weight[k] + exponent[k * stride];
        if (own < most - LOST && most > TINY) continue;
        if (own > most + LOST && own > TINY) parts = 0;
        part[parts++] = k;
        most = own > most ? own : most;
    }
    double sum = 0;
    for (int i = 0; i < parts; i++) {
        const int k = part[i];
        sum += m->share[k] * (m->factor[k] * exponential(exponent[k * stride]));
    }
    return sum;
}

PART int64_t squared_difference(const uint8_t *a, const uint8_t *b) {
    const int32_t x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2];
    return x * x + y * y + z * z;
}

/* Add up the squared differences of all neighbours. */
FOR_EVERY_PROCESSOR static int64_t contrast(const uint8_t *image, int64_t height, int64_t width) {
    const int64_t length = 3 * width;
    int64_t sum = 0;
    for (int64_t y = 0; y < height; y++, image += length) {
        int32_t part = 0;
        for (int64_t i = 3; i < length; i++) part += (image[i] - image[i - 3]) * (image[i] - image[i - 3]);
        sum += part;
        if (!y) continue;
        const uint8_t *above = image - length;
        part = 0;
        for (int64_t i = 0; i < length; i++) part += (image[i] - above[i]) * (image[i] - above[i]);
        sum += part;
        part = 0;
        for (int64_t i = 3; i < length; i++) part += (image[i] - above[i - 3]) * (image[i] - above[i - 3]);
        sum += part;
        part = 0;
        for (int64_t i = 3; i < length; i++) part += (image[i - 3] - above[i]) * (image[i - 3] - above[i]);
        sum += part;
    }
    return sum;
}

struct weights {
    double beta, of[2][KNOWN]; /* of neighbours in a row or column, and of diagonal ones; 0 if not computed yet */
    function exponential;
};

PART double weight(struct weights *w, int diagonal, int64_t squared) {
    const double most = diagonal ? DIAGONAL : GAMMA;
    if (squared >= KNOWN) return most * w->exponential(-w->beta * (double)squared);
    double *known = &w->of[diagonal][squared];
    if (*known == 0) *known = most * w->exponential(-w->beta * (double)squared);
    return *known;
}

/* Cut the object out of an image (height, width, 3): `mask` (height, width) is 1 for it. Pixels outside of the
   rectangle `inner` (left, top, right, bottom; not at the frame's border) are background. Inside, `start` (height,
   width) is not 0 for the pixels that probably show the object. `work` holds 18 numbers for each pixel. `done` is 0 if
   this kernel cannot cut this image. */
EXPORT void hbr_grab_cut(const uint8_t *image, int64_t height, int64_t width, const int64_t *inner, const uint8_t *start,
                         function exponential, function logarithm, double *work, uint8_t *mask, int64_t *done) {
    const int64_t pixels = height * width, left = inner[0], top = inner[1], right = inner[2], bottom = inner[3];
    struct mixture mixture[2];
    *done = 0;
    if (pixels > MOST_PIXELS) return;
    for (int64_t i = 0; i < pixels; i++) mask[i] = 0;
    for (int64_t y = top; y < bottom; y++)
        for (int64_t x = left; x < right; x++) mask[y * width + x] = start[y * width + x] != 0;

    /* the first mixtures, from clusters */
    uint64_t random = 0xffffffff; /* cv2.setRNGSeed(0) */
    float *colours = (float *)work;
    int32_t *label = (int32_t *)(colours + 3 * pixels), *distance = label + pixels;
    for (int side = BACKGROUND; side <= OBJECT; side++) {
        int64_t count = 0;
        for (int64_t i = 0; i < pixels; i++) {
            if (mask[i] != side) continue;
            for (int64_t c = 0; c < 3; c++) colours[c * pixels + count] = image[3 * i + c];
            count++;
        }
        if (count < COLOURS) return;
        hbr_find_clusters(colours, pixels, count, &random, distance, label);
        start_sums(&mixture[side]);
        count = 0;
        for (int64_t i = 0; i < pixels; i++)
            if (mask[i] == side) add(&mixture[side], label[count++], image + 3 * i);
        if (!learn(&mixture[side], logarithm)) return;
    }

    /* the mixtures of the iteration */
    double *colour = work, *exponent[2] = {work + 3 * width, work + (3 + COLOURS) * width};
    double *part[2] = {work + 13 * width, work + 14 * width}, *clear[2] = {work + 15 * width, work + 16 * width};
    struct mixture next[2];
    start_sums(&next[BACKGROUND]);
    start_sums(&next[OBJECT]);
    for (int64_t y = 0; y < height; y++) {
        const uint8_t *row = image + 3 * y * width;
        for (int64_t x = 0; x < width; x++)
            for (int64_t c = 0; c < 3; c++) colour[c * width + x] = row[3 * x + c];
        for (int side = BACKGROUND; side <= OBJECT; side++) {
            if (side == OBJECT && (y < top || y >= bottom)) continue;
            exponents(&mixture[side], colour, width, width, exponent[side]);
            compare(&mixture[side], exponent[side], width, width, part[side], clear[side]);
        }
        for (int64_t x = 0; x < width; x++) {
            const int side = mask[y * width + x];
            const int k = clear[side][x] != 0 ? (int)part[side][x]
                                              : likeliest(&mixture[side], exponent[side] + x, width, exponential);
            add(&next[side], k, row + 3 * x);
        }
    }
    if (!learn(&next[BACKGROUND], logarithm) || !learn(&next[OBJECT], logarithm)) return;

    /* the graph, with a margin of one pixel of background, which cannot change its side */
    struct weights weights = {.exponential = exponential};
    const double difference = (double)contrast(image, height, width);
    weights.beta = difference > 0 ? 1.0 / (2 * difference / (double)(4 * width * height - 3 * width - 3 * height + 2)) : 0;
    const int64_t rows = bottom - top + 2, columns = right - left + 2, count = rows * columns;
    double *rest = work + (3 + 2 * COLOURS) * width, *capacity = rest + count;
    int32_t *memory = (int32_t *)(capacity + 8 * count);
    uint8_t *tree = (uint8_t *)(memory + 14 * count);
    for (int64_t i = 0; i < 8 * count; i++) capacity[i] = 0;
    for (int64_t i = 0; i < count; i++) rest[i] = -CERTAIN;
    static const int8_t across[4] = {1, 0, -1, 1}, down[4] = {1, 1, 1, 0};
    for (int64_t y = 0; y < rows; y++)
        for (int64_t x = 0; x < columns; x++)
            for (int side = 0; side < 4; side++) {
                const int64_t v = y + down[side], u = x + across[side];
                const int own = x > 0 && x < columns - 1 && y > 0 && y < rows - 1;
                const int other = u > 0 && u < columns - 1 && v > 0 && v < rows - 1;
                if (!own && !other) continue;
                const uint8_t *pixel = image + 3 * ((y + top - 1) * width + x + left - 1);
                const uint8_t *neighbour = image + 3 * ((v + top - 1) * width + u + left - 1);
                double *both = capacity + 8 * (y * columns + x) + 2 * side;
                both[0] = both[1] = weight(&weights, across[side] && down[side], squared_difference(pixel, neighbour));
            }
    for (int64_t y = top; y < bottom; y++) {
        const uint8_t *row = image + 3 * (y * width + left);
        for (int64_t x = 0; x < right - left; x++)
            for (int64_t c = 0; c < 3; c++) colour[c * width + x] = row[3 * x + c];
        for (int side = BACKGROUND; side <= OBJECT; side++)
            exponents(&next[side], colour, right - left, width, exponent[side]);
        double *vertex = rest + (y - top + 1) * columns + 1;
        for (int64_t x = 0; x < right - left; x++) {
            const double source = -logarithm(density(&next[BACKGROUND], exponent[BACKGROUND] + x, width, exponential));
            const double sink = -logarithm(density(&next[OBJECT], exponent[OBJECT] + x, width, exponential));
            vertex[x] = source - sink;
        }
    }
    hbr_max_flow(rows, columns, rest, capacity, memory, tree);
    for (int64_t y = top; y < bottom; y++)
        for (int64_t x = left; x < right; x++)
            mask[y * width + x] = !tree[(y - top + 1) * columns + x - left + 1];
    *done = 1;
}
