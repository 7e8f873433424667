/* Parts of the descriptors of the object, with the same bits as hbr/descriptors/edges.py and colours.py. */
#include "kernels.h"

#define DIRECTIONS 8

PART float positive(float a) { return a > 0 ? a : 0; }
PART float absolute(float a) { return a < 0 ? -a : a; }

/* Choose the channel with the strongest edge: (count, 3) gradients -> (count). */
EXPORT FOR_EVERY_PROCESSOR void hbr_strongest(const float *x, const float *y, int64_t count, float *own_x,
                                              float *own_y) {
    for (int64_t i = 0; i < count; i++, x += 3, y += 3) {
        float best = x[0] * x[0] + y[0] * y[0];
        float best_x = x[0], best_y = y[0];
        for (int64_t c = 1; c < 3; c++) {
            const float strength = x[c] * x[c] + y[c] * y[c];
            const int more = strength > best;
            best = more ? strength : best;
            best_x = more ? x[c] : best_x;
            best_y = more ? y[c] : best_y;
        }
        own_x[i] = best_x;
        own_y[i] = best_y;
    }
}

/* Divide the magnitude of each pixel between the two nearest of eight directions, which repeat every 180 degrees: (count)
   -> (8, count). */
EXPORT FOR_EVERY_PROCESSOR void hbr_votes(const float *magnitude, const float *angle, int64_t count, float scale,
                                          float *votes) {
    for (int64_t k = 0; k < DIRECTIONS; k++, votes += count)
        for (int64_t i = 0; i < count; i++) {
            const float place = angle[i] * scale;
            float vote = positive(1 - absolute(place - (float)k));
            vote += positive(1 - absolute(place - (float)(k + DIRECTIONS)));
            if (k == 0) vote += positive(place - (2 * DIRECTIONS - 1));
            votes[i] = vote * magnitude[i];
        }
}

/* Average the colours of cells, each pixel by its weight, and the weights: (cells size, cells size, 3) and (cells size,
   cells size) -> (cells, cells, 3) and (cells, cells). The sums of float32 weights, and of their rounded products with a
   byte, are exact. */
EXPORT FOR_EVERY_PROCESSOR void hbr_cell_means(const uint8_t *image, const float *weight, int64_t cells, int64_t size,
                                               double *means, double *covered) {
    const double pixels = (double)(size * size);
    for (int64_t row = 0; row < cells; row++)
        for (int64_t column = 0; column < cells; column++, means += 3, covered++) {
            double blue = 0, green = 0, red = 0, sum = 0;
            for (int64_t y = row * size; y < (row + 1) * size; y++)
                for (int64_t x = column * size; x < (column + 1) * size; x++) {
                    const int64_t at = y * cells * size + x;
                    const float own = weight[at];
                    blue += (double)((float)image[3 * at] * own);
                    green += (double)((float)image[3 * at + 1] * own);
                    red += (double)((float)image[3 * at + 2] * own);
                    sum += (double)own;
                }
            means[0] = blue / pixels;
            means[1] = green / pixels;
            means[2] = red / pixels;
            *covered = sum / pixels;
        }
}
