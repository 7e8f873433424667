/* Layers of neural networks: convolutions of all channels, or of each channel alone. Images are float32 (height, width,
   channels) with zeros around them. Every sum is taken in the same order, and a product is added without rounding it
   first. So all processors that can do this, those with AVX2 and all of aarch64, return the same bits. */
#include "kernels.h"

#if defined(__clang__)
#pragma clang fp contract(fast)
#else
#pragma GCC optimize("fp-contract=fast")
#endif

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define FOR_EVERY_FUSING_PROCESSOR __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FOR_EVERY_FUSING_PROCESSOR
#endif

#define LANES 8 /* of a vector: one register with AVX2, two of aarch64 */
typedef float floats __attribute__((vector_size(4 * LANES)));
typedef int32_t ints __attribute__((vector_size(4 * LANES)));

/* As in hbr/kernels/nets.py. Steps are between neighbours of the output: in the input, and in the output itself. */
typedef struct {
    const float *input, *weights, *bias, *added; /* `added` has the steps of the output, or is null */
    float *output;
    const int64_t *taps; /* where each pixel of the kernel is in the input, from the place of the output's pixel */
    int64_t tap_count, is_alone, height, width, channels, outputs;
    int64_t row, column, output_row, output_column;
    float low, high; /* the sums are clipped */
} layer_t;

/* By pointers: without AVX, a function cannot return such a vector in a register. */
PART void load(const float *from, floats *to) { __builtin_memcpy(to, from, sizeof *to); }

PART void store(const floats *sum, float low, float high, float *to) {
    const floats lowest = low - (floats){0}, highest = high - (floats){0};
    ints chosen = *sum > lowest;
    floats clipped = (floats)(((ints)*sum & chosen) | ((ints)lowest & ~chosen));
    chosen = clipped < highest;
    clipped = (floats)(((ints)clipped & chosen) | ((ints)highest & ~chosen));
    __builtin_memcpy(to, &clipped, sizeof clipped);
}

/* Compute `pixels` neighbours in a row and `vectors` of their channels: as many sums as there are registers. */
PART void tile(const layer_t *layer, int64_t y, int64_t x, int64_t first, int pixels, int vectors, int is_alone) {
    floats sum[8][3];
    const int64_t to = y * layer->output_row + x * layer->output_column + first;
    for (int p = 0; p < pixels; p++)
        for (int v = 0; v < vectors; v++) {
            load(layer->bias + first + LANES * v, &sum[p][v]);
            if (!layer->added) continue;
            floats added;
            load(layer->added + to + p * layer->output_column + LANES * v, &added);
            sum[p][v] += added;
        }
    const float *weights = layer->weights + first;
    for (int64_t t = 0; t < layer->tap_count; t++) {
        const float *from = layer->input + y * layer->row + x * layer->column + layer->taps[t];
        if (is_alone) {
            floats weight, values;
            load(weights, &weight);
            for (int p = 0; p < pixels; p++) {
                load(from + p * layer->column + first, &values);
                sum[p][0] += weight * values;
            }
            weights += layer->outputs;
            continue;
        }
        for (int64_t c = 0; c < layer->channels; c++, weights += layer->outputs) {
            floats weight[3];
            for (int v = 0; v < vectors; v++) load(weights + LANES * v, &weight[v]);
            for (int p = 0; p < pixels; p++) {
                const float value = from[p * layer->column + c];
                for (int v = 0; v < vectors; v++) sum[p][v] += weight[v] * value;
            }
        }
    }
    for (int p = 0; p < pixels; p++)
        for (int v = 0; v < vectors; v++)
            store(&sum[p][v], layer->low, layer->high, layer->output + to + p * layer->output_column + LANES * v);
}

/* Compute a layer row by row, because a row of all channels stays in the cache, and each row tile by tile. The last tile
   of a row overlaps the one before it, with the same results. */
PART void tiles(const layer_t *layer, int pixels, int vectors, int is_alone) {
    for (int64_t y = 0; y < layer->height; y++)
        for (int64_t first = 0; first < layer->outputs; first += LANES * vectors)
            for (int64_t x = 0; x < layer->width; x += pixels)
                tile(layer, y, x + pixels > layer->width ? layer->width - pixels : x, first, pixels, vectors, is_alone);
}

EXPORT FOR_EVERY_FUSING_PROCESSOR void hbr_layers(const layer_t *layers, int64_t count) {
    for (const layer_t *layer = layers; layer < layers + count; layer++) {
        if (layer->width < 6) /* for tests */
            tiles(layer, 1, 1, layer->is_alone != 0);
        else if (layer->is_alone)
            tiles(layer, 4, 1, 1);
        else if (layer->outputs % (3 * LANES) == 0)
            tiles(layer, 4, 3, 0);
        else if (layer->outputs % (2 * LANES) == 0)
            tiles(layer, 6, 2, 0);
        else
            tiles(layer, 6, 1, 0);
    }
}
