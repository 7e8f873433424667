/* Parts of the segmentation of a view, with the same bits as OpenCV and NumPy in hbr/segmentation. */
#include "kernels.h"

#define MAGIC 12582912.0f /* 1.5 * 2^23: adding it rounds a small number to a whole one, halves to even */

PART uint8_t rounded(float value) { return (uint8_t)((value + MAGIC) - MAGIC); }

/* Vectors of four numbers for three channels; the fourth number belongs to the next pixel. */
typedef float float4 __attribute__((vector_size(16)));
typedef int32_t int4 __attribute__((vector_size(16)));
typedef uint16_t short4 __attribute__((vector_size(8)));
typedef uint8_t byte4 __attribute__((vector_size(4)));

/* Store a pixel, rounded. */
PART void store(float4 pixel, uint8_t *to) {
    const byte4 bytes = __builtin_convertvector(__builtin_convertvector((pixel + MAGIC) - MAGIC, int4), byte4);
    __builtin_memcpy(to, &bytes, 3);
}

/* Add up `factor` neighbours in a row of sums, and store their averages: 3 width factor + 1 numbers -> 3 width. */
PART void shrink_row(const uint16_t *sums, int64_t width, int64_t factor, float share, uint8_t *small) {
    for (int64_t x = 0; x < width; x++, small += 3) {
        int4 sum = {0, 0, 0, 0};
        for (int64_t k = 0; k < factor; k++, sums += 3) {
            short4 pixel;
            __builtin_memcpy(&pixel, sums, sizeof pixel);
            sum += __builtin_convertvector(pixel, int4);
        }
        store(__builtin_convertvector(sum, float4) * share, small);
    }
}

/* Average squares of `factor` x `factor` pixels: (height factor, width factor, 3) -> (height, width, 3). `sums` holds
   a row of the image and one more number; it can hold sums of up to 257 bytes. */
EXPORT FOR_EVERY_PROCESSOR void hbr_shrink(const uint8_t *image, int64_t stride, int64_t height, int64_t width,
                                           int64_t factor, uint16_t *sums, uint8_t *small) {
    const int64_t length = 3 * width * factor;
    const float share = 1.0f / (float)(factor * factor);
    sums[length] = 0;
    for (int64_t y = 0; y < height; y++, small += 3 * width) {
        for (int64_t i = 0; i < length; i++) sums[i] = image[i];
        for (int64_t k = 1; k < factor; k++) {
            image += stride;
            for (int64_t i = 0; i < length; i++) sums[i] = (uint16_t)(sums[i] + image[i]);
        }
        image += stride;
        if (factor == 5) /* 640 x 480, unrolled */
            shrink_row(sums, width, 5, share, small);
        else
            shrink_row(sums, width, factor, share, small);
    }
}

/* Average by area from a square of `size` pixels to one of `side`, with the sums of cv2.INTER_AREA: first along each
   row, then over the rows. A pixel takes `most` pixels from `first` on with `weights` (side, most), the same in both
   directions; some weights are 0. `pixels` holds 3 * size + 1 floats, because three channels are read as
   four; `line` and `sums` hold 4 * side floats each. */

PART void average_row(const float *pixels, int64_t side, const int64_t *first, const float *weights, int64_t most,
                      float *line) {
    for (int64_t x = 0; x < side; x++, weights += most) {
        const float *pixel = pixels + 3 * first[x];
        float4 sum = {0, 0, 0, 0};
        for (int64_t j = 0; j < most; j++) {
            float4 four;
            __builtin_memcpy(&four, pixel + 3 * j, sizeof four);
            sum += four * weights[j];
        }
        __builtin_memcpy(line + 4 * x, &sum, sizeof sum);
    }
}

EXPORT FOR_EVERY_PROCESSOR void hbr_average(const uint8_t *image, int64_t stride, int64_t size, int64_t side,
                                            const int64_t *first, const float *weights, int64_t most, float *pixels,
                                            float *line, float *sums, uint8_t *out) {
    int64_t ready = -1; /* the row whose averages are in `line` */
    for (int64_t y = 0; y < side; y++) {
        for (int64_t i = 0; i < 4 * side; i++) sums[i] = 0;
        for (int64_t k = 0; k < most; k++) {
            const int64_t row = first[y] + k;
            const float share = weights[y * most + k];
            if (share == 0) continue;
            if (row != ready) {
                for (int64_t i = 0; i < 3 * size; i++) pixels[i] = image[row * stride + i];
                if (most == 3) /* unrolled */
                    average_row(pixels, side, first, weights, 3, line);
                else if (most == 4)
                    average_row(pixels, side, first, weights, 4, line);
                else
                    average_row(pixels, side, first, weights, most, line);
                ready = row;
            }
            for (int64_t i = 0; i < 4 * side; i++) sums[i] += line[i] * share;
        }
        for (int64_t x = 0; x < side; x++, out += 3)
            for (int64_t c = 0; c < 3; c++) out[c] = rounded(sums[4 * x + c]);
    }
}

PART float largest(float a, float b) { return a > b ? a : b; }
PART float absolute(float a) { return a < 0 ? -a : a; }

/* Compare the logarithms of a small frame, those of each level in `logarithm` (256), with `table_log`, those of the
   empty-table image: (height, width, 3) -> `evenly`, `coloured` (height, width), and as 0 or 1 the pixels that are
   certain, possible, and in agreement. `along` (3 width) and `down` (3 height) are the parts of the planes that the
   illumination adds, `noise` (256) is that of each level. `line` holds 8 floats for each column. */
EXPORT FOR_EVERY_PROCESSOR void hbr_difference(const uint8_t *small, const uint8_t *table, const float *logarithm,
                                               const float *table_log, int64_t height, int64_t width,
                                               const float *along, const float *down, const float *noise,
                                               float agrees_below, float *line, float *evenly, float *coloured,
                                               uint8_t *certain, uint8_t *possible, uint8_t *agrees) {
    float *rest = line, *tile = line + 3 * width, *grain = line + 6 * width;
    uint8_t *darker = (uint8_t *)(line + 7 * width);
    for (int64_t y = 0; y < height; y++, down += 3) {
        for (int64_t x = 0; x < width; x++)
            for (int64_t c = 0; c < 3; c++) tile[3 * x + c] = down[c];
#pragma GCC ivdep
        for (int64_t i = 0; i < 3 * width; i++) rest[i] = (logarithm[small[i]] - table_log[i]) - (along[i] + tile[i]);
#pragma GCC ivdep
        for (int64_t i = 0; i < 3 * width; i++) darker[i] = small[i] < table[i] ? small[i] : table[i];
        for (int64_t x = 0; x < width; x++) {
            const uint8_t b = darker[3 * x], g = darker[3 * x + 1], r = darker[3 * x + 2], bg = b < g ? b : g;
            grain[x] = noise[bg < r ? bg : r];
        }
#pragma GCC ivdep
        for (int64_t x = 0; x < width; x++) {
            const float b = rest[3 * x], g = rest[3 * x + 1], r = rest[3 * x + 2];
            const float mean = ((b + g) + r) * (1.0f / 3.0f);
            evenly[x] = mean;
            coloured[x] = largest(largest(absolute(b - mean), absolute(g - mean)), absolute(r - mean));
            tile[x] = largest(largest(absolute(b), absolute(g)), absolute(r));
        }
#pragma GCC ivdep
        for (int64_t x = 0; x < width; x++) {
            const int sure = (coloured[x] > 0.08f + grain[x]) | (evenly[x] > 0.10f + grain[x]) | (evenly[x] < -1.1f);
            certain[x] = (uint8_t)sure;
            possible[x] = (evenly[x] < -0.12f) & !sure;
            agrees[x] = tile[x] < agrees_below;
        }
        small += 3 * width, table += 3 * width, table_log += 3 * width;
        evenly += width, coloured += width, certain += width, possible += width, agrees += width;
    }
}

#define REACH 7 /* pixels that the blur of a mask reaches to each side */

/* Return the place in a row or column of which `at`, beyond an end, is the mirror image. The end is not repeated. */
PART int64_t mirrored(int64_t at, int64_t side) {
    at = at < 0 ? -at : at;
    return at < side ? at : 2 * side - 2 - at;
}

#define WHOLE 6755399441055744.0 /* 1.5 * 2^52: adding it rounds to a whole number, halves to even */

/* Return the mean of the colours of the pixels whose mask is above 127, added up as by cv2.mean. */
PART double brightness(const uint8_t *crop, const uint8_t *mask, int64_t count) {
    int64_t blue = 0, green = 0, red = 0, pixels = 0;
    for (int64_t begin = 0; begin < count; begin += 4096) {
        const int64_t end = begin + 4096 < count ? begin + 4096 : count;
        int32_t b = 0, g = 0, r = 0, n = 0;
        for (int64_t i = begin; i < end; i++) {
            const int32_t own = -(mask[i] > 127);
            b += crop[3 * i] & own;
            g += crop[3 * i + 1] & own;
            r += crop[3 * i + 2] & own;
            n -= own;
        }
        blue += b;
        green += g;
        red += r;
        pixels += n;
    }
    const double each = pixels ? 1.0 / (double)pixels : 0;
    return ((double)blue * each + (double)green * each + (double)red * each) / 3.0;
}

/* Put an even grey around the object: (side, side, 3) and its mask (side, side) -> (side, side, 3). Its level is
   `bright` times the brightness of the object. The mask is blurred by a Gaussian of sigma 2.5 in fixed point. `line`
   holds side + 14 bytes, `blurred` side * side values. */
EXPORT FOR_EVERY_PROCESSOR void hbr_surround(const uint8_t *crop, const uint8_t *mask, int64_t side, double bright,
                                             uint8_t *line, uint16_t *blurred, uint8_t *out) {
    static const uint16_t share[REACH + 1] = {40, 38, 30, 20, 11, 6, 2, 1}; /* of 256, from the middle on */
    const uint8_t level = (uint8_t)((bright * brightness(crop, mask, side * side) + WHOLE) - WHOLE);
    const float ground = (float)level;
    for (int64_t y = 0; y < side; y++) {
        for (int64_t x = 0; x < side; x++) line[x + REACH] = mask[y * side + x];
        for (int64_t k = 1; k <= REACH; k++) {
            line[REACH - k] = mask[y * side + mirrored(-k, side)];
            line[side - 1 + REACH + k] = mask[y * side + mirrored(side - 1 + k, side)];
        }
        uint16_t *to = blurred + y * side;
        const uint8_t *middle = line + REACH;
#pragma GCC ivdep
        for (int64_t x = 0; x < side; x++) {
            uint16_t sum = (uint16_t)(share[0] * middle[x]);
            for (int64_t k = 1; k <= REACH; k++) sum = (uint16_t)(sum + share[k] * (middle[x - k] + middle[x + k]));
            to[x] = sum;
        }
    }
    for (int64_t y = 0; y < side; y++) {
        const uint16_t *rows[2 * REACH + 1];
        for (int64_t k = -REACH; k <= REACH; k++) rows[k + REACH] = blurred + mirrored(y + k, side) * side;
#pragma GCC ivdep
        for (int64_t x = 0; x < side; x++) {
            uint32_t sum = (uint32_t)share[0] * rows[REACH][x];
            for (int64_t k = 1; k <= REACH; k++)
                sum += share[k] * ((uint32_t)rows[REACH - k][x] + rows[REACH + k][x]);
            line[x] = (uint8_t)((sum + (1 << 15)) >> 16);
        }
        for (int64_t x = 0; x < side;) {
            uint64_t eight = 1;
            if (x + 8 <= side) __builtin_memcpy(&eight, line + x, sizeof eight);
            if (eight == 0 || eight == UINT64_MAX) { /* the same result as by the products below */
                for (int64_t i = 0; i < 24; i++) out[i] = eight ? crop[i] : level;
                x += 8, crop += 24, out += 24;
                continue;
            }
            const float weight = (float)line[x] * (1.0f / 255.0f), rest = 1.0f - weight;
            const float sum = weight + rest + 1e-5f, even = ground * rest;
            const float4 pixel = {crop[0], crop[1], crop[2], 0};
            store((pixel * weight + even) / sum, out);
            x++, crop += 3, out += 3;
        }
    }
}
