/* CEDD, with the same bits as hbr/descriptors/cedd.py, which explains it.

   Each row of blocks passes through several loops over short arrays, which the compiler turns into vector code. */
#include "kernels.h"

#define BINS 144
#define RULES 12 /* ten, and two zeros */
#define HUES 360
#define COLOURS 8 /* of a texture class, each in three shades */
#define SHADES 4  /* three, and a zero */

/* The tables of hbr/descriptors/cedd.py. */
struct cedd_tables {
    const double *hue_weight;      /* (2, 360) */
    const int64_t *hue_bin;        /* (2, 360): first bin of the two colours of each hue */
    const double *saturation;      /* (256, 12) */
    const double *value;           /* (256, 12) */
    const double *representatives; /* (144, 8) */
};

struct grid {
    int64_t rows, columns, height, width; /* height and width of a quarter of a block, in pixels */
};

/* The values of each block of a row. */
struct blocks {
    int32_t *hue, *saturation, *value, *textures;
};

/* Sum the rows of pixels of one row of quarters: (height, length) -> (length). */
PART void add_rows(const uint8_t *image, int64_t stride, int64_t height, int64_t length, uint16_t *sums) {
    for (int64_t i = 0; i < length; i++) sums[i] = image[i];
    for (int64_t k = 1; k < height; k++) {
        image += stride;
        for (int64_t i = 0; i < length; i++) sums[i] = (uint16_t)(sums[i] + image[i]);
    }
}

/* Sum the pixels of each quarter in a row of them: (quarters, width, 3) -> B, G, R and the luminance in thousandths,
   four times (quarters). */
PART void add_columns(const uint16_t *sums, int64_t quarters, int64_t width,
                                                              int32_t *channels) {
    for (int64_t q = 0; q < quarters; q++) {
        int32_t b = 0, g = 0, r = 0;
        for (int64_t x = 0; x < width; x++, sums += 3) {
            b += sums[0];
            g += sums[1];
            r += sums[2];
        }
        channels[q] = b;
        channels[quarters + q] = g;
        channels[2 * quarters + q] = r;
        channels[3 * quarters + q] = 114 * b + 587 * g + 299 * r;
    }
}

/* Mark the bytes of a row of quarters that differ from those a quarter further left: (height, length) -> (length). */
PART void mark_changes(const uint8_t *image, int64_t stride, int64_t height, int64_t length, int64_t step,
                                uint8_t *changes) {
    for (int64_t i = 0; i < length; i++) changes[i] = i < step;
    for (int64_t k = 0; k < height; k++, image += stride)
        for (int64_t i = step; i < length; i++) changes[i] |= image[i] ^ image[i - step];
}

PART int any(const uint8_t *bytes, int64_t count) {
    uint64_t found = 0;
    int64_t i = 0;
    for (; i + 8 <= count; i += 8) {
        uint64_t eight;
        __builtin_memcpy(&eight, bytes + i, 8);
        found |= eight;
    }
    for (; i + 2 <= count; i += 2) {
        uint16_t two;
        __builtin_memcpy(&two, bytes + i, 2);
        found |= two;
    }
    return (found | (i < count ? bytes[i] : 0)) != 0;
}

/* Return the luminance of a quarter with the rounding errors of the reference: add up the pixels in raster order. */
PART double area_as_rounded(const uint8_t *quarter, int64_t stride, const struct grid *grid,
                                     const double luminance[3][256]) {
    double total = 0;
    for (int64_t y = 0; y < grid->height; y++, quarter += stride)
        for (int64_t x = 0; x < grid->width; x++) {
            const uint8_t *pixel = quarter + 3 * x;
            total += (luminance[0][pixel[0]] + luminance[1][pixel[1]]) + luminance[2][pixel[2]];
        }
    return (double)(int64_t)(total * (4.0 / (double)(4 * grid->height * grid->width)));
}

/* Mark the bytes of 32 pixels that differ from the next byte. Of each pixel, the third byte is compared with the next
   pixel: ignore its mark. */
PART void add_differences(const uint8_t *image, uint8_t *differs) {
    for (int n = 0; n < 96; n++) differs[n] |= image[n] ^ image[n + 1];
}

/* Return whether all pixels of a row of quarters, (height, length), are grey. */
PART int is_grey(const uint8_t *image, int64_t stride, int64_t height, int64_t length) {
    uint8_t differs[96] = {0};
    if (image[0] != image[1] || image[1] != image[2]) return 0;
    for (int64_t k = 0; k < height; k++, image += stride) {
        int64_t i = 0;
        for (; i + 96 < length; i += 96) add_differences(image + i, differs);
        if (length >= 99) add_differences(image + length - 99, differs), i = length - 3; /* marks some bytes twice */
        for (; i + 1 < length; i++) differs[i % 96] |= image[i] ^ image[i + 1];
    }
    unsigned found = 0;
    for (int n = 0; n < 96; n += 3) found |= differs[n] | differs[n + 1];
    return !found;
}

/* Store the luminance of the quarters of a row, 0..255. `greys` are the luminances of grey pixels. */
PART void row_areas(const uint8_t *image, int64_t stride, const struct grid *grid, const int32_t *luminances,
                             const double luminance[3][256], const double *greys, int32_t *rest, uint8_t *changes,
                             double *areas) {
    const int64_t quarters = 2 * grid->columns;
    const int32_t count = (int32_t)(grid->height * grid->width), unit = 1000 * count;
    const double inverse = 1.0 / unit, white = (double)(int64_t)(255.0 * count * (4.0 / (4.0 * count)));
    int32_t undecided = 0;
    for (int64_t q = 0; q < quarters; q++) {
        const int32_t sum = luminances[q], whole = (int32_t)((sum + 0.5) * inverse);
        rest[q] = sum - whole * unit;
        areas[q] = whole;
        undecided += rest[q] == 0;
    }
    if (!undecided) return;
    /* In grey images, about one of n quarters of n pixels is undecided. */
    if (count == 1 && is_grey(image, stride, 1, 3 * quarters)) {
        for (int64_t q = 0; q < quarters; q++) areas[q] = (double)(int32_t)greys[image[3 * q]];
        return;
    }
    if (grid->height == 2 && grid->width == 2 && is_grey(image, stride, 2, 6 * quarters)) {
        int64_t count_undecided = 0; /* no branch: about one of four is undecided */
        for (int64_t q = 0; q < quarters; q++) {
            const int is_undecided = rest[q] == 0;
            rest[count_undecided] = (int32_t)q;
            count_undecided += is_undecided;
        }
        for (int64_t k = 0; k < count_undecided; k++) {
            const int64_t q = rest[k];
            const uint8_t *upper = image + 6 * q, *lower = upper + stride;
            const double total = ((greys[upper[0]] + greys[upper[3]]) + greys[lower[0]]) + greys[lower[3]];
            areas[q] = (double)(int32_t)(total * 0.25);
        }
        return;
    }
    /* In drawings and other flat images, most quarters equal the quarter on their left, which is also undecided. */
    const int64_t step = 3 * grid->width;
    const int flat = 4 * (int64_t)undecided > quarters;
    if (flat) mark_changes(image, stride, grid->height, quarters * step, step, changes);
    for (int64_t q = 0; q < quarters; q++) {
        if (rest[q] || areas[q] == 0) continue;
        if (areas[q] == 255)
            areas[q] = white;
        else if (flat && !any(changes + q * step, step))
            areas[q] = areas[q - 1];
        else
            areas[q] = area_as_rounded(image + q * step, stride, grid, luminance);
    }
}

/* Return the texture classes of a block, as bits, from the luminance of its quarters. */
PART int32_t textures_of(double a, double b, double c, double d) {
    const double root = 1.4142135623730951;
    const double m0 = __builtin_fabs(2 * a - 2 * b - 2 * c + 2 * d), m1 = __builtin_fabs(a + b - c - d),
                 m2 = __builtin_fabs(a - b + c - d), m3 = __builtin_fabs(a * root - d * root),
                 m4 = __builtin_fabs(b * root - c * root);
    double strongest = m0 > m1 ? m0 : m1;
    strongest = m2 > strongest ? m2 : strongest;
    strongest = m3 > strongest ? m3 : strongest;
    strongest = m4 > strongest ? m4 : strongest;
    const double divisor = strongest < 14.0 ? 14.0 : strongest;
    const int32_t classes = (m0 / divisor > 0.68) << 1 | (m1 / divisor > 0.98) << 2 | (m2 / divisor > 0.98) << 3 |
                            (m3 / divisor > 0.98) << 4 | (m4 / divisor > 0.98) << 5;
    return strongest < 14.0 ? 1 : classes;
}

/* Store hue 0..358, saturation 0..255 and value 0..255 of integer B, G, R. Fractions have denominators of at most 255. */
PART void hsv_of(int32_t b, int32_t g, int32_t r, const double *inverse, int32_t *hue, int32_t *saturation,
                          int32_t *value) {
    const int32_t most = b > g ? (b > r ? b : r) : (g > r ? g : r), least = b < g ? (b < r ? b : r) : (g < r ? g : r);
    const int32_t delta = most - least;
    *value = most;
    *saturation = (int32_t)(255 * delta * inverse[most] + 1e-4);
    const int32_t by_red = g >= b ? 60 * (g - b) : 359 * delta + 60 * (g - b);
    const int32_t by_green = 119 * delta + 60 * (b - r), by_blue = 239 * delta + 60 * (r - g);
    *hue = (int32_t)((most == r ? by_red : most == g ? by_green : by_blue) * inverse[delta] + 1e-4);
}

/* Describe the blocks of a row. `channels` and `areas` have the two rows of their quarters. */
PART void describe_blocks(const int32_t *restrict channels, const double *restrict areas, int64_t columns,
                          double inverse, const double *restrict inverses, struct blocks blocks) {
    const int64_t quarters = 2 * columns;
    int32_t *restrict hue = blocks.hue, *restrict saturation = blocks.saturation, *restrict value = blocks.value,
                      *restrict textures = blocks.textures;
    for (int64_t j = 0; j < columns; j++) {
        const double *upper = areas + 2 * j, *lower = upper + quarters;
        int32_t bgr[3];
        for (int c = 0; c < 3; c++) {
            const int32_t *over = channels + c * quarters + 2 * j, *under = over + 4 * quarters;
            bgr[c] = (int32_t)((over[0] + over[1] + under[0] + under[1] + 0.5) * inverse);
        }
        hsv_of(bgr[0], bgr[1], bgr[2], inverses, hue + j, saturation + j, value + j);
        textures[j] = textures_of(upper[0], upper[1], lower[0], lower[1]);
    }
}

PART double lesser(double a, double b) { return a < b ? a : b; }

/* Add the votes of the two fuzzy systems for a colour to the bins of the texture classes of its block. A histogram has
   four places for the three shades of each colour, so the next block can read a sum that was stored as one vector. */
PART void vote(const struct cedd_tables *t, int32_t hue, int32_t saturation, int32_t value, unsigned textures,
               double *histogram) {
    const double *s = t->saturation + RULES * saturation, *v = t->value + RULES * value;
    const double one = t->hue_weight[hue], two = t->hue_weight[HUES + hue];
    double rules[RULES], first[8], second[8], one_shades[SHADES], two_shades[SHADES];
    for (int k = 0; k < RULES; k++) rules[k] = lesser(s[k], v[k]);
    for (int k = 0; k < 8; k++) first[k] = lesser(one, rules[k]);
    for (int k = 0; k < 8; k++) second[k] = lesser(two, rules[k]);
    const double shades[SHADES] = {rules[6], rules[7], rules[8] + rules[9], 0};
    const double outputs[SHADES] = {first[0] + second[0], first[1] + second[1],
                                    ((first[2] + first[3]) + second[2]) + second[3], 0};
    for (int k = 0; k < SHADES; k++) one_shades[k] = (first[4] + first[5]) * shades[k];
    for (int k = 0; k < SHADES; k++) two_shades[k] = (second[4] + second[5]) * shades[k];
    for (; textures; textures &= textures - 1) {
        double *bins = histogram + COLOURS * SHADES * __builtin_ctz(textures);
        double *of_one = bins + t->hue_bin[hue] / 3 * SHADES, *of_two = bins + t->hue_bin[HUES + hue] / 3 * SHADES;
        for (int k = 0; k < SHADES; k++) bins[k] += outputs[k];
        for (int k = 0; k < SHADES; k++) of_one[k] += one_shades[k];
        if (two > 0)
            for (int k = 0; k < SHADES; k++) of_two[k] += two_shades[k];
    }
}

/* Store the 144 levels of an image, (height, width, 3), whose rows of pixels are `stride` bytes apart. A quarter of a
   block has at most 257 rows and 8,000 pixels. `scratch` has room for 4 doubles and 10 integers for each column of
   quarters, and for 2 bytes for each byte of a row. */
FOR_EVERY_PROCESSOR
EXPORT void hbr_cedd(const uint8_t *image, int64_t stride, int64_t rows, int64_t columns, int64_t height, int64_t width,
                     const struct cedd_tables *tables, double *scratch, uint8_t *levels) {
    const struct grid grid = {rows, columns, height, width};
    const int64_t quarters = 2 * columns, length = 3 * quarters * grid.width;
    const double inverse = 1.0 / (double)(4 * grid.height * grid.width);
    double *areas = scratch;
    int32_t *channels = (int32_t *)(areas + 2 * quarters), *rest = channels + 8 * quarters;
    uint16_t *sums = (uint16_t *)(rest + quarters);
    double luminance[3][256], greys[256], inverses[256], histogram[BINS] = {0}, votes[BINS / 3 * SHADES] = {0};
    for (int i = 0; i < 256; i++) {
        luminance[0][i] = 0.114 * i;
        luminance[1][i] = 0.587 * i;
        luminance[2][i] = 0.299 * i;
        greys[i] = (luminance[0][i] + luminance[1][i]) + luminance[2][i];
        inverses[i] = i ? 1.0 / i : 0.0;
    }
    for (int64_t i = 0; i < grid.rows; i++) {
        for (int half = 0; half < 2; half++) {
            const uint8_t *strip = image + (2 * i + half) * grid.height * stride;
            int32_t *own = channels + 4 * quarters * half;
            add_rows(strip, stride, grid.height, length, sums);
            switch (grid.width) { /* the usual widths, unrolled */
            case 1: add_columns(sums, quarters, 1, own); break;
            case 2: add_columns(sums, quarters, 2, own); break;
            case 8: add_columns(sums, quarters, 8, own); break;
            default: add_columns(sums, quarters, grid.width, own);
            }
            row_areas(strip, stride, &grid, own + 3 * quarters, luminance, greys, rest, (uint8_t *)sums,
                      areas + quarters * half);
        }
        /* stored over the luminances, which are not needed any more */
        int32_t *const upper = channels + 3 * quarters, *const lower = channels + 7 * quarters;
        const struct blocks blocks = {upper, upper + columns, lower, lower + columns};
        describe_blocks(channels, areas, columns, inverse, inverses, blocks);
        for (int64_t j = 0; j < columns; j++)
            vote(tables, blocks.hue[j], blocks.saturation[j], blocks.value[j], (unsigned)blocks.textures[j], votes);
    }
    for (int k = 0; k < BINS; k++) histogram[k] = votes[k / 3 * SHADES + k % 3];
    double total = 0;
    for (int k = 0; k < BINS; k++) total += histogram[k];
    for (int k = 0; k < BINS; k++) {
        const double share = histogram[k] / total, *representatives = tables->representatives + 8 * k;
        int nearest = 0;
        for (int level = 1; level < 8; level++)
            nearest = __builtin_fabs(share - representatives[level]) < __builtin_fabs(share - representatives[nearest])
                          ? level
                          : nearest;
        levels[k] = (uint8_t)nearest;
    }
}
