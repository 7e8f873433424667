/* The Tanimoto coefficient of rows of bytes, with the same bits as hbr/descriptors/similarity.py. */
#include "kernels.h"

#define LONGEST 4096

/* Return the product of two rows; the sum of 4096 products of bytes is below 2^31. */
PART int32_t dot(const int16_t *query, const uint8_t *row, int64_t length) {
    int32_t sum = 0;
    for (int64_t i = 0; i < length; i++) sum += query[i] * (int16_t)row[i];
    return sum;
}

PART int32_t expanded(const uint8_t *row, int64_t length, int16_t *values) {
    for (int64_t i = 0; i < length; i++) values[i] = row[i];
    return dot(values, row, length);
}

PART double coefficient(int32_t product, int32_t square_a, int32_t square_b) {
    const double either = (double)square_a + (double)square_b - (double)product;
    return either > 0 ? (double)product / either : 0;
}

/* Store the squared length of every row; rows are `stride` bytes apart. */
FOR_EVERY_PROCESSOR
EXPORT void hbr_byte_squares(const uint8_t *rows, int64_t stride, int64_t length, int64_t count, int32_t *squares) {
    int16_t values[LONGEST];
    for (int64_t i = 0; i < count; i++) squares[i] = expanded(rows + i * stride, length, values);
}

/* Store the coefficient of every row of a with every row of b, (count_a, count_b). */
FOR_EVERY_PROCESSOR
EXPORT void hbr_tanimoto(const uint8_t *a, int64_t stride_a, int64_t count_a, const uint8_t *b, int64_t stride_b,
                         const int32_t *squares_b, int64_t count_b, int64_t length, double *similar) {
    int16_t query[LONGEST];
    for (int64_t i = 0; i < count_a; i++) {
        const int32_t square = expanded(a + i * stride_a, length, query);
        for (int64_t k = 0; k < count_b; k++)
            *similar++ = coefficient(dot(query, b + k * stride_b, length), square, squares_b[k]);
    }
}

/* Store the `kept` rows with the largest coefficients, best first; of equal ones, the first. */
PART void top(const uint8_t *asked, const uint8_t *rows, int64_t stride, int64_t length, const int32_t *squares,
              int64_t count, int64_t kept, int64_t *best, double *similar) {
    int16_t query[LONGEST];
    const int32_t square = expanded(asked, length, query);
    int64_t found = 0;
    for (int64_t i = 0; i < count; i++) {
        const double value = coefficient(dot(query, rows + i * stride, length), square, squares[i]);
        if (found == kept && !(value > similar[kept - 1])) continue;
        int64_t k = found < kept ? found++ : kept - 1; /* few are kept, and few rows come here */
        for (; k && value > similar[k - 1]; k--) {
            similar[k] = similar[k - 1];
            best[k] = best[k - 1];
        }
        similar[k] = value;
        best[k] = i;
    }
}

FOR_EVERY_PROCESSOR
EXPORT void hbr_tanimoto_top(const uint8_t *asked, const uint8_t *rows, int64_t stride, int64_t length,
                             const int32_t *squares, int64_t count, int64_t kept, int64_t *best, double *similar) {
    /* A length that the compiler knows saves the loop's overhead for each row; 144 is the length of CEDD. */
    if (length == 144) top(asked, rows, stride, 144, squares, count, kept, best, similar);
    else top(asked, rows, stride, length, squares, count, kept, best, similar);
}
