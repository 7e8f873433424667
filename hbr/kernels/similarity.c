/* Similarity of packed views in integers, with the same bits as hbr/descriptors/cosine.py and colours.py. */
#include "kernels.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#define EDGE_BYTES 128
#define EDGE_LEVELS (4 * EDGE_BYTES)
#define COLOUR_BYTES 32
#define COARSE 59 /* the largest value is 63 of this unit; rounding up adds at most 0.5 % to the values that matter */
#define CHUNK 128 /* rows whose intermediate results stay in the cache */

/* How packed rows are compared. */
struct measure {
    int64_t edges_at, colours_at; /* first byte of each part in a row; -1 without it */
    double edges_share, colours_share;
    const int32_t *edge_values;    /* (4): value of each level, below 4096 */
    const int32_t *colour_weights; /* (32): weight of each squared difference, below 128 */
    const double *far, *near;      /* the similarity at distances 4096 * i, and at i below 4096 */
};

struct query {
    const struct measure *measure;
    uint64_t at_level[3][EDGE_LEVELS / 64] __attribute__((aligned(64))); /* where the levels are 1, 2, 3, a bit each */
    int64_t base;                                                        /* product with a row whose levels are all 0 */
    int16_t edges[EDGE_LEVELS] __attribute__((aligned(32))); /* values, in the order in which a row is read */
    int16_t colours[COLOUR_BYTES] __attribute__((aligned(64)));
    int16_t weights[COLOUR_BYTES] __attribute__((aligned(64)));
    int8_t coarse[EDGE_LEVELS] __attribute__((aligned(32))); /* values in units of COARSE, rounded up */
    double square;
};

/* The loops over rows: products of edges, squared distances of colours. */
struct loops {
    void (*prepare)(struct query *q, const uint8_t *edges); /* for `edges`, in the order in which a row is read */
    void (*coarsen)(struct query *q, const uint8_t *edges); /* for `edge_bounds`; null if nothing is needed */
    void (*edges)(const struct query *q, const uint8_t *const *rows, int64_t count, double *dots);
    void (*edge_bounds)(const struct query *q, const uint8_t *const *rows, int64_t count, double *dots);
    void (*colours)(const struct query *q, const uint8_t *const *rows, int64_t count, int32_t *distances);
};

/* In the plain order, all levels in the two highest bits of the bytes come first, then those in the next two. */
static void prepare_plain(struct query *q, const uint8_t *edges) {
    const int32_t *v = q->measure->edge_values;
    for (int field = 0; field < 4; field++)
        for (int i = 0; i < EDGE_BYTES; i++)
            q->edges[field * EDGE_BYTES + i] = (int16_t)v[edges[i] >> (6 - 2 * field) & 3];
}

static void edges_plain(const struct query *q, const uint8_t *const *rows, int64_t count, double *dots) {
    /* any function of two bits is linear in the bits and their product */
    const int32_t *v = q->measure->edge_values;
    const int16_t base = (int16_t)v[0], low = (int16_t)(v[1] - v[0]), high = (int16_t)(v[2] - v[0]),
                  both = (int16_t)(v[3] - v[1] - v[2] + v[0]);
    for (int64_t k = 0; k < count; k++) {
        const uint8_t *row = rows[k] + q->measure->edges_at;
        int64_t total = 0;
        for (int field = 0; field < 4; field++) {
            const int16_t *own = q->edges + field * EDGE_BYTES;
            int32_t sum = 0; /* 128 products below 2^24 */
            for (int i = 0; i < EDGE_BYTES; i++) {
                const int16_t level = (int16_t)(row[i] >> (6 - 2 * field));
                const int16_t l = level & 1, h = (level >> 1) & 1;
                sum += own[i] * (int16_t)(base + low * l + high * h + both * (l & h));
            }
            total += sum;
        }
        dots[k] = (double)total;
    }
}

static void colours_plain(const struct query *q, const uint8_t *const *rows, int64_t count, int32_t *distances) {
    for (int64_t k = 0; k < count; k++) {
        const uint8_t *row = rows[k] + q->measure->colours_at;
        int32_t distance = 0;
        for (int i = 0; i < COLOUR_BYTES; i++) {
            const int32_t apart = q->colours[i] - row[i];
            distance += q->weights[i] * apart * apart;
        }
        distances[k] = distance;
    }
}

static const struct loops PLAIN = {prepare_plain, 0, edges_plain, edges_plain, colours_plain};

#if defined(__x86_64__)
#define AVX2 __attribute__((target("avx2")))

/* Return a table: one byte of the value of the first or second level for each of the 16 half bytes, twice. */
AVX2 static inline __m256i values_of_halves(const int32_t v[4], int second, int shift) {
    uint8_t table[32];
    for (int i = 0; i < 32; i++) table[i] = (uint8_t)(v[second ? i & 3 : i >> 2 & 3] >> shift);
    return _mm256_loadu_si256((const __m256i *)table);
}

AVX2 static inline int64_t sum_of(__m256i a, __m256i b) {
    const __m256i low = _mm256_add_epi64(_mm256_cvtepi32_epi64(_mm256_castsi256_si128(a)),
                                         _mm256_cvtepi32_epi64(_mm256_extracti128_si256(a, 1)));
    const __m256i high = _mm256_add_epi64(_mm256_cvtepi32_epi64(_mm256_castsi256_si128(b)),
                                          _mm256_cvtepi32_epi64(_mm256_extracti128_si256(b, 1)));
    const __m256i four = _mm256_add_epi64(low, high);
    const __m128i two = _mm_add_epi64(_mm256_castsi256_si128(four), _mm256_extracti128_si256(four, 1));
    return _mm_extract_epi64(two, 0) + _mm_extract_epi64(two, 1);
}

AVX2 static void prepare_avx2(struct query *q, const uint8_t *edges) {
    const int32_t *v = q->measure->edge_values;
    const __m256i half = _mm256_set1_epi8(15);
    const __m256i low[2] = {values_of_halves(v, 0, 0), values_of_halves(v, 1, 0)};
    const __m256i high[2] = {values_of_halves(v, 0, 8), values_of_halves(v, 1, 8)};
    __m256i *own = (__m256i *)q->edges;
    for (int vector = 0; vector < EDGE_BYTES / 32; vector++) {
        const __m256i packed = _mm256_loadu_si256((const __m256i *)edges + vector);
        for (int field = 0; field < 4; field++, own += 2) {
            const __m256i halves = _mm256_and_si256(field < 2 ? _mm256_srli_epi16(packed, 4) : packed, half);
            const __m256i l = _mm256_shuffle_epi8(low[field % 2], halves);
            const __m256i h = _mm256_shuffle_epi8(high[field % 2], halves);
            own[0] = _mm256_unpacklo_epi8(l, h);
            own[1] = _mm256_unpackhi_epi8(l, h);
        }
    }
}

AVX2 static void edges_avx2(const struct query *q, const uint8_t *const *rows, int64_t count, double *dots) {
    const int32_t *v = q->measure->edge_values;
    const __m256i half = _mm256_set1_epi8(15);
    const __m256i low[2] = {values_of_halves(v, 0, 0), values_of_halves(v, 1, 0)};
    const __m256i high[2] = {values_of_halves(v, 0, 8), values_of_halves(v, 1, 8)};
    for (int64_t k = 0; k < count; k++) {
        const __m256i *row = (const __m256i *)(rows[k] + q->measure->edges_at), *own = (const __m256i *)q->edges;
        __m256i one = _mm256_setzero_si256(), two = one; /* each of their sums is of 32 products below 2^24 */
#pragma GCC unroll 4
        for (int vector = 0; vector < EDGE_BYTES / 32; vector++) {
            const __m256i packed = _mm256_loadu_si256(row + vector);
            const __m256i halves[2] = {_mm256_and_si256(_mm256_srli_epi16(packed, 4), half),
                                       _mm256_and_si256(packed, half)};
#pragma GCC unroll 4
            for (int field = 0; field < 4; field++, own += 2) {
                const __m256i l = _mm256_shuffle_epi8(low[field % 2], halves[field / 2]);
                const __m256i h = _mm256_shuffle_epi8(high[field % 2], halves[field / 2]);
                one = _mm256_add_epi32(one, _mm256_madd_epi16(_mm256_unpacklo_epi8(l, h), own[0]));
                two = _mm256_add_epi32(two, _mm256_madd_epi16(_mm256_unpackhi_epi8(l, h), own[1]));
            }
        }
        dots[k] = (double)sum_of(one, two);
    }
}

static void coarsen_avx2(struct query *q, const uint8_t *edges) {
    for (int vector = 0; vector < EDGE_BYTES / 32; vector++)
        for (int field = 0; field < 4; field++)
            for (int i = 0; i < 32; i++) {
                const int32_t value = q->measure->edge_values[edges[32 * vector + i] >> (6 - 2 * field) & 3];
                q->coarse[(4 * vector + field) * 32 + i] = (int8_t)((value + COARSE - 1) / COARSE);
            }
}

AVX2 static inline __m256i coarse_of_halves(const int32_t v[4], int second) {
    uint8_t table[32];
    for (int i = 0; i < 32; i++) table[i] = (uint8_t)((v[second ? i & 3 : i >> 2 & 3] + COARSE - 1) / COARSE);
    return _mm256_loadu_si256((const __m256i *)table);
}

/* Store bounds of the products, from above. */
AVX2 static void edge_bounds_avx2(const struct query *q, const uint8_t *const *rows, int64_t count, double *dots) {
    const int32_t *v = q->measure->edge_values;
    const __m256i half = _mm256_set1_epi8(15), ones = _mm256_set1_epi16(1);
    const __m256i coarse[2] = {coarse_of_halves(v, 0), coarse_of_halves(v, 1)};
    for (int64_t k = 0; k < count; k++) {
        const __m256i *row = (const __m256i *)(rows[k] + q->measure->edges_at), *own = (const __m256i *)q->coarse;
        for (int line = 0; line < 3; line++) /* rows mostly follow each other */
            _mm_prefetch((const char *)(row) + 2560 + 64 * line, _MM_HINT_T0);
        __m256i sums = _mm256_setzero_si256();
#pragma GCC unroll 4
        for (int vector = 0; vector < EDGE_BYTES / 32; vector++, own += 4) {
            const __m256i packed = _mm256_loadu_si256(row + vector);
            const __m256i first = _mm256_and_si256(_mm256_srli_epi16(packed, 4), half);
            const __m256i last = _mm256_and_si256(packed, half);
            /* eight products of 63 and 63 are below 2^15 */
            const __m256i a = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_shuffle_epi8(coarse[0], first), own[0]),
                                               _mm256_maddubs_epi16(_mm256_shuffle_epi8(coarse[1], first), own[1]));
            const __m256i b = _mm256_add_epi16(_mm256_maddubs_epi16(_mm256_shuffle_epi8(coarse[0], last), own[2]),
                                               _mm256_maddubs_epi16(_mm256_shuffle_epi8(coarse[1], last), own[3]));
            sums = _mm256_add_epi32(sums, _mm256_madd_epi16(_mm256_add_epi16(a, b), ones));
        }
        __m128i four = _mm_add_epi32(_mm256_castsi256_si128(sums), _mm256_extracti128_si256(sums, 1));
        four = _mm_add_epi32(four, _mm_shuffle_epi32(four, 0x4E));
        four = _mm_add_epi32(four, _mm_shuffle_epi32(four, 0xB1));
        dots[k] = (double)((int64_t)_mm_cvtsi128_si32(four) * (COARSE * COARSE));
    }
}

AVX2 static void colours_avx2(const struct query *q, const uint8_t *const *rows, int64_t count, int32_t *distances) {
    const __m256i *own = (const __m256i *)q->colours, *weights = (const __m256i *)q->weights;
    for (int64_t k = 0; k < count; k++) {
        const __m256i row = _mm256_loadu_si256((const __m256i *)(rows[k] + q->measure->colours_at));
        const __m256i a = _mm256_sub_epi16(own[0], _mm256_cvtepu8_epi16(_mm256_castsi256_si128(row)));
        const __m256i b = _mm256_sub_epi16(own[1], _mm256_cvtepu8_epi16(_mm256_extracti128_si256(row, 1)));
        const __m256i sums = _mm256_add_epi32(_mm256_madd_epi16(a, _mm256_mullo_epi16(a, weights[0])),
                                              _mm256_madd_epi16(b, _mm256_mullo_epi16(b, weights[1])));
        __m128i four = _mm_add_epi32(_mm256_castsi256_si128(sums), _mm256_extracti128_si256(sums, 1));
        four = _mm_add_epi32(four, _mm_shuffle_epi32(four, 0x4E));
        four = _mm_add_epi32(four, _mm_shuffle_epi32(four, 0xB1));
        distances[k] = _mm_cvtsi128_si32(four);
    }
}

static const struct loops WITH_AVX2 = {prepare_avx2, coarsen_avx2, edges_avx2, edge_bounds_avx2, colours_avx2};

#define AVX512 __attribute__((target("avx512f,avx512bw,avx512vpopcntdq,avx512ifma")))
#define EVEN_LANES _MM_SHUFFLE(2, 0, 2, 0) /* of two vectors, for _mm512_shuffle_i64x2 */
#define ODD_LANES _MM_SHUFFLE(3, 1, 3, 1)

/* Store the low and the high bits of all levels of a row, in the same order for every row. */
AVX512 static inline void bits_of_levels(const uint8_t *edges, __m512i *low, __m512i *high) {
    const __m512i first = _mm512_loadu_si512(edges), second = _mm512_loadu_si512(edges + EDGE_BYTES / 2);
    const __m512i even = _mm512_set1_epi8(0x55);
    const int chosen = 0xCA; /* the second operand where the first one has ones, else the third */
    *low = _mm512_ternarylogic_epi64(even, first, _mm512_slli_epi64(second, 1), chosen);
    *high = _mm512_ternarylogic_epi64(even, _mm512_srli_epi64(first, 1), second, chosen);
}

AVX512 static void prepare_avx512(struct query *q, const uint8_t *edges) {
    const int32_t *v = q->measure->edge_values;
    __m512i low, high;
    bits_of_levels(edges, &low, &high);
    const __m512i at_level[3] = {_mm512_andnot_si512(high, low), _mm512_andnot_si512(low, high),
                                 _mm512_and_si512(low, high)};
    q->base = EDGE_LEVELS * v[0];
    for (int level = 1; level < 4; level++) {
        _mm512_store_si512(q->at_level[level - 1], at_level[level - 1]);
        q->base += (v[level] - v[0]) * _mm512_reduce_add_epi64(_mm512_popcnt_epi64(at_level[level - 1]));
    }
    q->base *= v[0];
}

/* Add up the two halves of each lane of 128 bits: lane by lane, the sum of `a` and that of `b`. Numbers of 32 bits are
   added as pairs of them: their sums are below 2^32. */
AVX512 static inline __m512i sums_of_halves(__m512i a, __m512i b) {
    return _mm512_add_epi64(_mm512_unpacklo_epi64(a, b), _mm512_unpackhi_epi64(a, b));
}

/* Add up the four lanes of each vector: lane i has the sum of vector i. */
AVX512 static inline __m512i sums_of_lanes(const __m512i v[4]) {
    __m512i half[2];
#pragma GCC unroll 2
    for (int i = 0; i < 2; i++)
        half[i] = _mm512_add_epi64(_mm512_shuffle_i64x2(v[2 * i], v[2 * i + 1], EVEN_LANES),
                                   _mm512_shuffle_i64x2(v[2 * i], v[2 * i + 1], ODD_LANES));
    return _mm512_add_epi64(_mm512_shuffle_i64x2(half[0], half[1], EVEN_LANES),
                            _mm512_shuffle_i64x2(half[0], half[1], ODD_LANES));
}

/* Add up eight vectors: lane i of the result has the sums of vectors 2i and 2i + 1. */
AVX512 static inline __m512i sums_of_eight(const __m512i v[8]) {
    __m512i two[4];
#pragma GCC unroll 4
    for (int i = 0; i < 4; i++) two[i] = sums_of_halves(v[2 * i], v[2 * i + 1]);
    return sums_of_lanes(two);
}

/* Count the levels that are i in the query and j in the row, for i and j from 1 to 3, and those that are j in the row.
   Each count times its weight is added to the product with a row whose levels are all 0. */
AVX512 static void edges_avx512(const struct query *q, const uint8_t *const *rows, int64_t count, double *dots) {
    const int32_t *v = q->measure->edge_values;
    const __m512i one = _mm512_load_si512(q->at_level[0]), two = _mm512_load_si512(q->at_level[1]),
                  three = _mm512_load_si512(q->at_level[2]), base = _mm512_set1_epi64(q->base);
    __m512i weights[3][4];
    for (int j = 1; j < 4; j++) {
        weights[j - 1][0] = _mm512_set1_epi64((int64_t)v[0] * (v[j] - v[0]));
        for (int i = 1; i < 4; i++) weights[j - 1][i] = _mm512_set1_epi64((int64_t)(v[i] - v[0]) * (v[j] - v[0]));
    }
    for (int64_t k = 0; k < count; k += 8) { /* eight rows at once: their sums are added up together */
        const int64_t left = count - k;
        __m512i of_rows[8];
#pragma GCC unroll 1
        for (int i = 0; i < 8; i++) {
            const uint8_t *row = rows[i < left ? k + i : count - 1] + q->measure->edges_at;
            for (int line = 0; line < 3; line++) /* rows mostly follow each other */
                _mm_prefetch((const char *)row + 2560 + 64 * line, _MM_HINT_T0);
            __m512i low, high;
            bits_of_levels(row, &low, &high);
            const __m512i at_level[3] = {_mm512_andnot_si512(high, low), _mm512_andnot_si512(low, high),
                                         _mm512_and_si512(low, high)};
            __m512i sums[3];
#pragma GCC unroll 3
            for (int j = 0; j < 3; j++) { /* modulo 2^52: weights can be negative, the product is not */
                const __m512i *w = weights[j], here = at_level[j], zero = _mm512_setzero_si512();
                sums[j] = _mm512_madd52lo_epu64(zero, _mm512_popcnt_epi64(here), w[0]);
                sums[j] = _mm512_madd52lo_epu64(sums[j], _mm512_popcnt_epi64(_mm512_and_si512(one, here)), w[1]);
                sums[j] = _mm512_madd52lo_epu64(sums[j], _mm512_popcnt_epi64(_mm512_and_si512(two, here)), w[2]);
                sums[j] = _mm512_madd52lo_epu64(sums[j], _mm512_popcnt_epi64(_mm512_and_si512(three, here)), w[3]);
            }
            of_rows[i] = _mm512_add_epi64(_mm512_add_epi64(sums[0], sums[1]), sums[2]);
        }
        const __m512i total = _mm512_and_si512(_mm512_add_epi64(base, sums_of_eight(of_rows)),
                                               _mm512_set1_epi64((INT64_C(1) << 52) - 1));
        /* below 2^52, a number is the fraction of a double from 2^52 on */
        const __m512d power = _mm512_set1_pd(4503599627370496.0);
        const __m512d dot = _mm512_sub_pd(_mm512_castsi512_pd(_mm512_or_si512(total, _mm512_castpd_si512(power))), power);
        _mm512_mask_storeu_pd(dots + k, left < 8 ? (__mmask8)((1 << left) - 1) : (__mmask8)255, dot);
    }
}

AVX512 static void colours_avx512(const struct query *q, const uint8_t *const *rows, int64_t count, int32_t *distances) {
    const __m512i own = _mm512_load_si512(q->colours), weights = _mm512_load_si512(q->weights);
    for (int64_t k = 0; k < count; k += 16) { /* sixteen rows at once: their sums are added up together */
        const int64_t left = count - k;
        __m512i of_rows[16], pairs[8];
#pragma GCC unroll 1
        for (int i = 0; i < 16; i++) {
            const uint8_t *row = rows[i < left ? k + i : count - 1] + q->measure->colours_at;
            const __m512i apart = _mm512_sub_epi16(own, _mm512_cvtepu8_epi16(_mm256_loadu_si256((const __m256i *)row)));
            of_rows[i] = _mm512_madd_epi16(apart, _mm512_mullo_epi16(apart, weights));
        }
#pragma GCC unroll 8
        for (int i = 0; i < 8; i++)
            pairs[i] = _mm512_add_epi32(_mm512_unpacklo_epi32(of_rows[2 * i], of_rows[2 * i + 1]),
                                        _mm512_unpackhi_epi32(of_rows[2 * i], of_rows[2 * i + 1]));
        _mm512_mask_storeu_epi32(distances + k, left < 16 ? (__mmask16)((1 << left) - 1) : (__mmask16)65535,
                                 sums_of_eight(pairs));
    }
}

static const struct loops WITH_AVX512 = {prepare_avx512, 0, edges_avx512, edges_avx512, colours_avx512};
#endif

static const struct loops *fastest(void) {
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vpopcntdq") &&
        __builtin_cpu_supports("avx512ifma"))
        return &WITH_AVX512;
    if (__builtin_cpu_supports("avx2")) return &WITH_AVX2;
#endif
    return &PLAIN;
}

static void begin_query(struct query *q, const struct measure *m, const uint8_t *packed, const struct loops *loops) {
    q->measure = m;
    if (m->edges_at >= 0) loops->prepare(q, packed + m->edges_at);
    if (m->colours_at >= 0)
        for (int i = 0; i < COLOUR_BYTES; i++) {
            q->colours[i] = packed[m->colours_at + i];
            q->weights[i] = (int16_t)m->colour_weights[i];
        }
}

/* Prepare a query whose length is not known, also for bounds. */
static void begin_new(struct query *q, const struct measure *m, const uint8_t *packed, const struct loops *loops) {
    begin_query(q, m, packed, loops);
    if (m->edges_at < 0) return;
    loops->edges(q, &packed, 1, &q->square);
    if (loops->coarsen) loops->coarsen(q, packed + m->edges_at);
}

/* Store the similarity of a query to at most CHUNK rows, or bounds of it, from above. */
FOR_EVERY_PROCESSOR
static void compare(const struct query *q, const struct loops *loops, int bounds, const uint8_t *const *rows,
                    const double *squares, int64_t count, double *similar) {
    const struct measure *m = q->measure;
    double dots[CHUNK];
    int32_t distances[CHUNK];
    if (m->edges_at >= 0) {
        (bounds ? loops->edge_bounds : loops->edges)(q, rows, count, dots);
        for (int64_t i = 0; i < count; i++) {
            const double cosine = dots[i] / __builtin_sqrt(q->square * squares[i]);
            similar[i] = cosine < 1 ? cosine : 1;
        }
    }
    if (m->colours_at < 0) return;
    loops->colours(q, rows, count, distances);
    if (m->edges_at < 0)
        for (int64_t i = 0; i < count; i++) similar[i] = m->far[distances[i] >> 12] * m->near[distances[i] & 4095];
    else
        for (int64_t i = 0; i < count; i++)
            similar[i] = m->edges_share * similar[i] +
                         m->colours_share * (m->far[distances[i] >> 12] * m->near[distances[i] & 4095]);
}

/* Store the squared length of the edges of packed rows, which are `stride` bytes apart. */
EXPORT void hbr_squares(const struct measure *m, const uint8_t *rows, int64_t stride, int64_t count, double *squares) {
    int64_t of_byte[256]; /* of its four levels */
    for (int byte = 0; byte < 256; byte++) {
        of_byte[byte] = 0;
        for (int shift = 0; shift < 8; shift += 2) {
            const int64_t value = m->edge_values[byte >> shift & 3];
            of_byte[byte] += value * value;
        }
    }
    for (int64_t i = 0; i < count; i++) {
        const uint8_t *edges = rows + i * stride + m->edges_at;
        int64_t total = 0;
        for (int k = 0; k < EDGE_BYTES; k++) total += of_byte[edges[k]];
        squares[i] = (double)total;
    }
}

/* Store the similarity of packed queries to packed rows, (queries, count): to those at `places`, or to the first
   rows if it is null. */
EXPORT void hbr_similarity(const struct measure *m, const uint8_t *queries, int64_t query_stride, int64_t query_count,
                           const uint8_t *rows, int64_t stride, const double *squares, const int64_t *places,
                           int64_t count, double *similar) {
    const struct loops *loops = fastest();
    struct query q = {0};
    const uint8_t *chosen[CHUNK];
    double lengths[CHUNK];
    for (int64_t k = 0; k < query_count; k++, similar += count) {
        begin_new(&q, m, queries + k * query_stride, loops);
        for (int64_t first = 0; first < count; first += CHUNK) {
            const int64_t some = count - first < CHUNK ? count - first : CHUNK;
            for (int64_t i = 0; i < some; i++) {
                const int64_t place = places ? places[first + i] : first + i;
                chosen[i] = rows + place * stride;
                lengths[i] = squares[place];
            }
            compare(&q, loops, 0, chosen, lengths, some, similar + first);
        }
    }
}

/* Store the similarity of two rows of each group, for all pairs: places (groups, size) -> (groups, pairs). Pairs with
   the same first row follow each other. */
EXPORT void hbr_pairs(const struct measure *m, const uint8_t *rows, int64_t stride, const double *squares,
                      const int64_t *places, int64_t groups, int64_t size, const int64_t *first, const int64_t *second,
                      int64_t pairs, double *similar) {
    const struct loops *loops = fastest();
    struct query q;
    const uint8_t *chosen[CHUNK];
    double lengths[CHUNK];
    for (int64_t g = 0; g < groups; g++, places += size, similar += pairs)
        for (int64_t p = 0; p < pairs;) {
            const int64_t with = places[first[p]], begin = p;
            int64_t some = 0;
            for (; p < pairs && first[p] == first[begin] && some < CHUNK; p++) {
                const int64_t place = places[second[p]];
                chosen[some] = rows + place * stride;
                lengths[some++] = squares[place];
            }
            begin_query(&q, m, rows + with * stride, loops);
            q.square = squares[with];
            compare(&q, loops, 0, chosen, lengths, some, similar + begin);
        }
}

/* The views of each object: `count` of the rows at `places[order]` from `begin` on; either may be null, for all. */
struct segments {
    const int64_t *places, *order, *begin, *count;
    int64_t objects;
};

static inline int64_t place_of(const struct segments *s, int64_t i) {
    const int64_t at = s->order ? s->order[i] : i;
    return s->places ? s->places[at] : at;
}

/* Store the bounds of the similarities of an object's rows from `first` on, at most CHUNK, and return how many. */
static int64_t bounds_of_rows(const struct query *q, const struct loops *loops, const uint8_t *rows, int64_t stride,
                              const double *squares, const struct segments *s, int64_t object, int64_t first,
                              double *bounds) {
    const uint8_t *chosen[CHUNK];
    double lengths[CHUNK];
    const int64_t left = s->count[object] - first, some = left < CHUNK ? left : CHUNK;
    for (int64_t i = 0; i < some; i++) {
        const int64_t place = place_of(s, s->begin[object] + first + i);
        chosen[i] = rows + place * stride;
        lengths[i] = squares[place];
    }
    compare(q, loops, 1, chosen, lengths, some, bounds);
    return some;
}

/* Store upper bounds of the similarity of each object's rows. */
EXPORT void hbr_bounds(const struct measure *m, const uint8_t *query, const uint8_t *rows, int64_t stride,
                       const double *squares, const struct segments *s, double *bounds) {
    const struct loops *loops = fastest();
    struct query q;
    double of_rows[CHUNK];
    begin_new(&q, m, query, loops);
    for (int64_t j = 0; j < s->objects; j++) {
        double most = -1;
        for (int64_t first = 0; first < s->count[j];) {
            const int64_t some = bounds_of_rows(&q, loops, rows, stride, squares, s, j, first, of_rows);
            for (int64_t i = 0; i < some; i++) most = of_rows[i] > most ? of_rows[i] : most;
            first += some;
        }
        bounds[j] = most;
    }
}

/* Return whether an object is further away than another: less similar, or as similar and later. */
static inline int further(double a, int64_t object_a, double b, int64_t object_b) {
    return a < b || (a == b && object_a > object_b);
}

/* Store the `kept` objects with the most similar views, of equal ones the first, in any order, and their similarities.
   `by_bound` has the objects by descending bound; `bounds` are those of `hbr_bounds`. */
EXPORT void hbr_nearest(const struct measure *m, const uint8_t *query, const uint8_t *rows, int64_t stride,
                        const double *squares, const struct segments *s, const int64_t *by_bound,
                        const double *bounds, int64_t kept, int64_t *nearest, double *similar) {
    const struct loops *loops = fastest();
    struct query q;
    begin_new(&q, m, query, loops);
    const int is_exact = loops->edge_bounds == loops->edges;
    int64_t found = 0; /* a heap: the furthest object first */
    for (int64_t k = 0; k < s->objects; k++) {
        const int64_t object = by_bound[k];
        if (found == kept && bounds[object] < similar[0]) break;
        double best = is_exact ? bounds[object] : -1, of_rows[CHUNK];
        for (int64_t first = is_exact ? s->count[object] : 0; first < s->count[object];) {
            const int64_t some = bounds_of_rows(&q, loops, rows, stride, squares, s, object, first, of_rows);
            for (int64_t i = 0; i < some; i++) {
                if (of_rows[i] < best || (found == kept && of_rows[i] < similar[0])) continue;
                const int64_t place = place_of(s, s->begin[object] + first + i);
                const uint8_t *row = rows + place * stride;
                double exact;
                compare(&q, loops, 0, &row, squares + place, 1, &exact);
                best = exact > best ? exact : best;
            }
            first += some;
        }
        if (found == kept && !further(similar[0], nearest[0], best, object)) continue;
        int64_t hole; /* sift the new object in */
        if (found < kept) {
            for (hole = found++; hole && further(best, object, similar[(hole - 1) / 2], nearest[(hole - 1) / 2]);
                 hole = (hole - 1) / 2) {
                similar[hole] = similar[(hole - 1) / 2];
                nearest[hole] = nearest[(hole - 1) / 2];
            }
        } else {
            hole = 0;
            for (int64_t child; (child = 2 * hole + 1) < kept; hole = child) {
                if (child + 1 < kept && further(similar[child + 1], nearest[child + 1], similar[child], nearest[child]))
                    child++;
                if (!further(similar[child], nearest[child], best, object)) break;
                similar[hole] = similar[child];
                nearest[hole] = nearest[child];
            }
        }
        similar[hole] = best;
        nearest[hole] = object;
    }
}
