/* Print checksums of the kernels' results for pseudo-random numbers. They must be equal on every processor. */
#include "kernels.h"

#include <stdio.h>
#include <stdlib.h>

void hbr_support(const int64_t *, const int64_t *, const int64_t *, int64_t, const double *, const float *, double,
                 double, int64_t, double *, int64_t, float *);
void hbr_nearest_view(const int64_t *, const int64_t *, const int64_t *, const double *, const int64_t *, int64_t,
                      const double *, int64_t, int64_t *, double *);
void hbr_paths(const uint8_t *, int64_t, int64_t, int64_t, const uint8_t *, int64_t, const int64_t *, const double *,
               const double *, double, const int64_t *, int64_t *, double *, int64_t *, double *, int64_t *,
               int64_t *);
void hbr_cedd(const uint8_t *, int64_t, int64_t, int64_t, int64_t, int64_t, const void *, double *, uint8_t *);

typedef struct {
    const float *input, *weights, *bias, *added;
    float *output;
    const int64_t *taps;
    int64_t tap_count, is_alone, height, width, channels, outputs, row, column, output_row, output_column;
    float low, high;
} layer_t;
void hbr_layers(const layer_t *, int64_t);

static uint64_t state = 88172645463325252ULL, sum = 1469598103934665603ULL;

static uint64_t random_bits(void) {
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

static void add(const void *data, size_t size) {
    for (const uint8_t *byte = data; size--; byte++) sum = (sum ^ *byte) * 1099511628211ULL;
}

static void support(void) {
    static int64_t order[300], begin[10], count[10];
    static double azimuth_deg[300], scratch[1000];
    static float levels[300], found[720];
    for (int i = 0; i < 300; i++) {
        order[i] = i;
        azimuth_deg[i] = (i % 30) * 12 + (double)(random_bits() % 1000) * .01;
        levels[i] = (float)(random_bits() % 10000) / 1e4f;
    }
    for (int i = 0; i < 10; i++) begin[i] = i * 30, count[i] = 30;
    hbr_support(order, begin, count, 10, azimuth_deg, levels, 2 / 360., 1.7, 13, scratch, 60, found);
    add(found, sizeof found);
}

static void next_view(void) {
    static double azimuth_deg[300], at_deg[60], away_deg[60];
    static int64_t order[300], begin[10], count[10], places[6], rows[60];
    for (int i = 0; i < 300; i++) {
        order[i] = i;
        azimuth_deg[i] = (i % 30) * 12 + (double)(random_bits() % 1000) * .01;
    }
    for (int j = 0; j < 10; j++) {
        begin[j] = 30 * j;
        count[j] = 30 - j;
    }
    for (int i = 0; i < 6; i++) places[i] = random_bits() % 10;
    for (int i = 0; i < 60; i++) at_deg[i] = (double)(random_bits() % 200000) * .01 - 1000;
    hbr_nearest_view(order, begin, count, azimuth_deg, places, 6, at_deg, 10, rows, away_deg);
    add(rows, sizeof rows);
    add(away_deg, sizeof away_deg);
}

static void paths(void) {
    static uint8_t levels[300 * 144];
    static int64_t object[300], rows[5 * 300], begin[6], before[5 * 300], taken[10 * 5], objects;
    static double azimuth_deg[300], value[5 * 300], scores[10];
    static const double orientation_deg[5] = {0, 90.3, -170, 1000, 7.125};
    for (size_t i = 0; i < sizeof levels; i++) levels[i] = random_bits() % 3 ? 0 : random_bits() % 8;
    for (int i = 0; i < 300; i++) {
        object[i] = i / 30;
        azimuth_deg[i] = (double)(random_bits() % 36000) * .01;
    }
    for (int q = 0; q <= 5; q++) begin[q] = 300 * q;
    for (int i = 0; i < 5 * 300; i++) rows[i] = 299 - i % 300;
    hbr_paths(levels, 144, 5, 144, levels, 144, object, azimuth_deg, orientation_deg, .5, begin, rows, value, before,
              scores, taken, &objects);
    add(scores, sizeof scores);
    add(taken, sizeof taken);
}

static void cedd(void) {
    static double hues[720], saturation[256 * 12], value[256 * 12], representatives[144 * 8], scratch[20000];
    static int64_t bins[720];
    static uint8_t image[480 * 640 * 3], levels[144];
    static const int64_t sizes[][6] = {{160, 160, 40, 40, 2, 2}, {480, 640, 40, 40, 6, 8}, {90, 100, 40, 40, 1, 1}};
    for (int i = 0; i < 720; i++) {
        hues[i] = (double)(random_bits() % 100) / 100.;
        bins[i] = 3 + 3 * (i % 7);
    }
    for (int i = 0; i < 256 * 12; i++) {
        saturation[i] = (double)(random_bits() % 100) / 100.;
        value[i] = (double)(random_bits() % 100) / 100.;
    }
    for (int i = 0; i < 144 * 8; i++) representatives[i] = (i % 8) * .05;
    const void *tables[5] = {hues, bins, saturation, value, representatives};
    for (int mode = 0; mode < 3; mode++) { /* noise, noise of six greys, flat */
        for (size_t i = 0; i < sizeof image; i++)
            image[i] = (uint8_t)(mode == 0 ? random_bits() >> 9 : mode == 1 ? (random_bits() % 6) * 48 : 127);
        for (int k = 0; k < 3; k++) {
            const int64_t *size = sizes[k];
            hbr_cedd(image, size[1] * 3, size[2], size[3], size[4], size[5], tables, scratch, levels);
            add(levels, sizeof levels);
        }
    }
}

/* A convolution of 3 x 3 pixels, and one of each channel alone. */
static void layers(void) {
    static float image[14 * 14 * 24], weights[9 * 24 * 48], bias[48], found[12 * 12 * 48], alone[12 * 12 * 24];
    int64_t taps[9];
    for (size_t i = 0; i < sizeof image / sizeof *image; i++) image[i] = (float)(random_bits() % 2000) / 1e3f - 1;
    for (size_t i = 0; i < sizeof weights / sizeof *weights; i++) weights[i] = (float)(random_bits() % 2000) / 1e3f - 1;
    for (int i = 0; i < 48; i++) bias[i] = (float)(random_bits() % 1000) / 1e3f;
    for (int i = 0; i < 9; i++) taps[i] = (i / 3 * 14 + i % 3) * 24;
    const layer_t both[2] = {
        {image, weights, bias, 0, found, taps, 9, 0, 12, 12, 24, 48, 14 * 24, 24, 12 * 48, 48, -1, 6},
        {image, weights, bias, alone, alone, taps, 9, 1, 12, 12, 24, 24, 14 * 24, 24, 12 * 24, 24, -1, 6},
    };
    hbr_layers(both, 2);
    add(found, sizeof found);
    add(alone, sizeof alone);
}

int main(void) {
    support();
    printf("support %016llx\n", (unsigned long long)sum);
    cedd();
    printf("cedd %016llx\n", (unsigned long long)sum);
    paths();
    printf("paths %016llx\n", (unsigned long long)sum);
    next_view();
    printf("next_view %016llx\n", (unsigned long long)sum);
    layers();
    printf("layers %016llx\n", (unsigned long long)sum);
    return 0;
}
