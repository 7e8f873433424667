/* Parts of the segmentation of a view, with the same bits as OpenCV and NumPy in hbr/segmentation. */
#include "kernels.h"

#define MAGIC 12582912.0f /* 1.5 * 2^23: adding it rounds a small number to a whole one, halves to even */

PART uint8_t rounded(float value) { return (uint8_t)((value + MAGIC) - MAGIC); }

/* Average squares of `factor` x `factor` pixels: (height factor, width factor, 3) -> (height, width, 3). `sums` holds
   a row of the image, whose sums of up to 257 bytes fit. */
EXPORT FOR_EVERY_PROCESSOR void hbr_shrink(const uint8_t *image, int64_t stride, int64_t height, int64_t width,
                                           int64_t factor, uint16_t *sums, uint8_t *small) {
    const int64_t length = 3 * width * factor;
    const float share = 1.0f / (float)(factor * factor);
    for (int64_t y = 0; y < height; y++) {
        for (int64_t i = 0; i < length; i++) sums[i] = image[i];
        for (int64_t k = 1; k < factor; k++) {
            image += stride;
            for (int64_t i = 0; i < length; i++) sums[i] = (uint16_t)(sums[i] + image[i]);
        }
        image += stride;
        const uint16_t *from = sums;
        for (int64_t x = 0; x < width; x++, small += 3) {
            int32_t b = 0, g = 0, r = 0;
            for (int64_t k = 0; k < factor; k++, from += 3) {
                b += from[0];
                g += from[1];
                r += from[2];
            }
            small[0] = rounded((float)b * share);
            small[1] = rounded((float)g * share);
            small[2] = rounded((float)r * share);
        }
    }
}

/* Average by area from a square of `size` pixels to one of `side`, with the sums of cv2.INTER_AREA: first along each
   row, then over the rows. A pixel takes `count` pixels from `first` on with `weights` (side, most), the same in both
   directions. `pixels` holds 4 * size floats, `line` and `sums` 4 * side each. */
EXPORT FOR_EVERY_PROCESSOR void hbr_average(const uint8_t *image, int64_t stride, int64_t size, int64_t side,
                                            const int64_t *first, const int64_t *count, const float *weights,
                                            int64_t most, float *pixels, float *line, float *sums, uint8_t *out) {
    int64_t ready = -1; /* the row of which `line` has the averages */
    for (int64_t y = 0; y < side; y++) {
        for (int64_t i = 0; i < 4 * side; i++) sums[i] = 0;
        for (int64_t k = 0; k < count[y]; k++) {
            const int64_t row = first[y] + k;
            if (row != ready) {
                const uint8_t *from = image + row * stride;
                for (int64_t i = 0; i < size; i++)
                    for (int64_t c = 0; c < 3; c++) pixels[4 * i + c] = from[3 * i + c];
                for (int64_t x = 0; x < side; x++) {
                    float four[4] = {0, 0, 0, 0};
                    const float *pixel = pixels + 4 * first[x], *weight = weights + x * most;
                    for (int64_t j = 0; j < count[x]; j++, pixel += 4)
                        for (int64_t c = 0; c < 4; c++) four[c] += pixel[c] * weight[j];
                    for (int64_t c = 0; c < 4; c++) line[4 * x + c] = four[c];
                }
                ready = row;
            }
            const float weight = weights[y * most + k];
            for (int64_t i = 0; i < 4 * side; i++) sums[i] += line[i] * weight;
        }
        for (int64_t x = 0; x < side; x++, out += 3)
            for (int64_t c = 0; c < 3; c++) out[c] = rounded(sums[4 * x + c]);
    }
}

struct difference_tables {
    const float *logarithm; /* (256) */
    const float *noise;     /* (256) */
};

PART float largest(float a, float b) { return a > b ? a : b; }
PART float absolute(float a) { return a < 0 ? -a : a; }

/* Compare a small frame with the empty-table image: (height, width, 3) -> `evenly`, `coloured` (height, width), and as
   0 or 1 the pixels that are certain, possible, and in agreement. `along` (3 width) and `down` (3 height) are the parts
   of the planes that the illumination adds. */
EXPORT FOR_EVERY_PROCESSOR void hbr_difference(const uint8_t *small, const uint8_t *table, const float *table_log,
                                               int64_t height, int64_t width, const float *along, const float *down,
                                               const struct difference_tables *tables, float agrees_below,
                                               float *evenly, float *coloured, uint8_t *certain, uint8_t *possible,
                                               uint8_t *agrees) {
    for (int64_t y = 0; y < height; y++) {
        for (int64_t x = 0; x < width; x++) {
            const int64_t at = y * width + x;
            float rest[3], low = 0;
            uint8_t darkest = 255;
            for (int64_t c = 0; c < 3; c++) {
                const uint8_t a = small[3 * at + c], b = table[3 * at + c];
                rest[c] = (tables->logarithm[a] - table_log[3 * at + c]) - (along[3 * x + c] + down[3 * y + c]);
                low = largest(low, absolute(rest[c]));
                darkest = a < darkest ? a : darkest;
                darkest = b < darkest ? b : darkest;
            }
            const float mean = ((rest[0] + rest[1]) + rest[2]) * (1.0f / 3.0f);
            const float away = largest(largest(absolute(rest[0] - mean), absolute(rest[1] - mean)),
                                       absolute(rest[2] - mean));
            const float noise = tables->noise[darkest];
            evenly[at] = mean;
            coloured[at] = away;
            certain[at] = (away > 0.08f + noise) | (mean > 0.10f + noise) | (mean < -1.1f);
            possible[at] = (mean < -0.12f) & !certain[at];
            agrees[at] = low < agrees_below;
        }
    }
}

/* The largest (or smallest) value of 0 and 1 within a symmetric disc; pixels outside the image do not count. Rows of the
   disc reach `reach[k]` pixels to both sides, k = 0 .. 2 radius. `spread` holds radius + 1 rows for each row. */
PART void morph(const uint8_t *mask, int64_t height, int64_t width, const int64_t *reach, int64_t radius, int grows,
                uint8_t *spread, uint8_t *out) {
    const int64_t rows = radius + 1;
    for (int64_t y = 0; y < height; y++) {
        uint8_t *wide = spread + y * rows * width;
        for (int64_t x = 0; x < width; x++) wide[x] = mask[y * width + x] ^ !grows;
        for (int64_t k = 1; k <= radius; k++) { /* one pixel further to both sides */
            const uint8_t *before = wide + (k - 1) * width;
            uint8_t *now = wide + k * width;
            if (width == 1) {
                now[0] = before[0];
                continue;
            }
            now[0] = before[0] | before[1];
            for (int64_t x = 1; x < width - 1; x++) now[x] = before[x - 1] | before[x] | before[x + 1];
            now[width - 1] = before[width - 2] | before[width - 1];
        }
    }
    for (int64_t y = 0; y < height; y++) {
        uint8_t *to = out + y * width;
        for (int64_t x = 0; x < width; x++) to[x] = 0;
        for (int64_t k = 0; k <= 2 * radius; k++) {
            const int64_t row = y + k - radius;
            if (row < 0 || row >= height) continue;
            const uint8_t *wide = spread + (row * rows + reach[k]) * width;
            for (int64_t x = 0; x < width; x++) to[x] |= wide[x];
        }
        for (int64_t x = 0; x < width; x++) to[x] ^= !grows;
    }
}

/* Close a mask of 0 and 1 with a disc: grow it, then shrink it. */
EXPORT FOR_EVERY_PROCESSOR void hbr_closed(const uint8_t *mask, int64_t height, int64_t width, const int64_t *reach,
                                           int64_t radius, uint8_t *spread, uint8_t *grown, uint8_t *out) {
    morph(mask, height, width, reach, radius, 1, spread, grown);
    morph(grown, height, width, reach, radius, 0, spread, out);
}
