/* The averages by which an image shrinks, with the same bits as cv2.resize(INTER_AREA). */
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
