/* The compressed pixels of a PNG file: filtered, and in Huffman codes alone (RFC 1951, no repetitions are searched for).

   Noise hides repetitions in a camera's frames, so that the search for them only takes time. Each row has the filter
   "average" of the PNG specification: the value minus half the sum of its left and its upper neighbour. */
#include "kernels.h"

#define SYMBOLS 257 /* bytes, and the end of the block */
#define END 256
#define LONGEST 14 /* bits of a code: four codes and seven waiting bits fill 64 bits */
#define ADLER 65521
#define ADLER_STEP 4096 /* so many bytes are summed in 32 bits */

struct writer {
    uint8_t *out;
    uint64_t bits;
    int64_t count; /* of waiting bits, below 8 after `flush` */
};

PART void put(struct writer *to, uint64_t bits, int64_t count) {
    to->bits |= bits << to->count;
    to->count += count;
}

PART void flush(struct writer *to) {
    for (; to->count >= 8; to->count -= 8, to->bits >>= 8) *to->out++ = (uint8_t)to->bits;
}

/* Filter rows: (rows, length) -> (rows, 1 + length). The row above the first one is `above`, or zeros without it. */
PART void filter_rows(const uint8_t *image, int64_t stride, const uint8_t *above, int64_t rows, int64_t length,
                      uint8_t *filtered) {
    for (int64_t y = 0; y < rows; y++, above = image, image += stride) {
        *filtered++ = 3;
        if (above) {
            for (int64_t i = 0; i < 3 && i < length; i++) filtered[i] = (uint8_t)(image[i] - (above[i] >> 1));
            for (int64_t i = 3; i < length; i++)
                filtered[i] = (uint8_t)(image[i] - ((image[i - 3] + above[i]) >> 1));
        } else {
            for (int64_t i = 0; i < 3 && i < length; i++) filtered[i] = image[i];
            for (int64_t i = 3; i < length; i++) filtered[i] = (uint8_t)(image[i] - (image[i - 3] >> 1));
        }
        filtered += length;
    }
}

PART void count_bytes(const uint8_t *bytes, int64_t n, uint32_t *counts) {
    uint32_t part[4][256];
    for (int64_t i = 0; i < 256; i++) part[0][i] = part[1][i] = part[2][i] = part[3][i] = 0;
    int64_t i = 0;
    for (; i + 4 <= n; i += 4) {
        part[0][bytes[i]]++;
        part[1][bytes[i + 1]]++;
        part[2][bytes[i + 2]]++;
        part[3][bytes[i + 3]]++;
    }
    for (; i < n; i++) part[0][bytes[i]]++;
    for (int64_t s = 0; s < 256; s++) counts[s] = part[0][s] + part[1][s] + part[2][s] + part[3][s];
    counts[END] = 1;
}

/* Find the lengths of the codes by Huffman's method; symbols that do not occur have none. Returns the longest. */
static int64_t code_lengths(const uint32_t *counts, uint8_t *lengths) {
    int16_t order[SYMBOLS], parent[2 * SYMBOLS];
    uint32_t weight[2 * SYMBOLS];
    int64_t n = 0;
    for (int64_t s = 0; s < SYMBOLS; s++) {
        lengths[s] = 0;
        if (counts[s]) order[n++] = (int16_t)s;
    }
    for (int64_t gap = 121; gap; gap /= 3)
        for (int64_t i = gap; i < n; i++) {
            int16_t one = order[i];
            int64_t j = i;
            for (; j >= gap && (counts[order[j - gap]] > counts[one] ||
                                (counts[order[j - gap]] == counts[one] && order[j - gap] > one)); j -= gap)
                order[j] = order[j - gap];
            order[j] = one;
        }
    for (int64_t i = 0; i < n; i++) weight[i] = counts[order[i]];
    /* leaves and inner nodes are two queues, both ascending */
    int64_t leaf = 0, inner = n;
    for (int64_t made = n; made < 2 * n - 1; made++) {
        uint32_t sum = 0;
        for (int64_t k = 0; k < 2; k++) {
            int64_t taken = leaf < n && (inner == made || weight[leaf] <= weight[inner]) ? leaf++ : inner++;
            sum += weight[taken];
            parent[taken] = (int16_t)made;
        }
        weight[made] = sum;
    }
    /* from the root down: the weights of the nodes become their depths */
    weight[2 * n - 2] = 0;
    int64_t longest = 0;
    for (int64_t i = 2 * n - 3; i >= 0; i--) {
        weight[i] = weight[parent[i]] + 1;
        if (i < n) {
            lengths[order[i]] = (uint8_t)weight[i];
            if (weight[i] > longest) longest = weight[i];
        }
    }
    return longest;
}

/* Number the codes by length and symbol, and reverse their bits: the first bit of a code is written first. */
static void make_codes(const uint8_t *lengths, uint16_t *codes) {
    uint32_t next[LONGEST + 2] = {0};
    for (int64_t s = 0; s < SYMBOLS; s++)
        if (lengths[s]) next[lengths[s] + 1]++;
    for (int64_t bits = 2; bits <= LONGEST; bits++) next[bits] = (next[bits] + next[bits - 1]) << 1;
    for (int64_t s = 0; s < SYMBOLS; s++) {
        if (!lengths[s]) continue;
        uint32_t code = next[lengths[s]]++, reversed = 0;
        for (int64_t bit = 0; bit < lengths[s]; bit++) reversed |= (code >> bit & 1) << (lengths[s] - 1 - bit);
        codes[s] = (uint16_t)reversed;
    }
}

/* Write one block of codes (RFC 1951, 3.2.7). The lengths of the codes have four bits each. */
PART void write_block(const uint8_t *bytes, int64_t n, int last, struct writer *to) {
    uint32_t counts[SYMBOLS];
    uint8_t lengths[SYMBOLS];
    uint16_t codes[SYMBOLS];
    count_bytes(bytes, n, counts);
    while (code_lengths(counts, lengths) > LONGEST)
        for (int64_t s = 0; s < SYMBOLS; s++) counts[s] = counts[s] ? counts[s] >> 2 | 1 : 0;
    make_codes(lengths, codes);
    put(to, (uint64_t)last | 2 << 1, 3); /* codes of its own */
    put(to, 0 | 1 << 5 | 15 << 10, 14);  /* 257 symbols, 2 distances, 19 lengths of codes of lengths */
    flush(to);
    for (int64_t k = 0; k < 19; k++, flush(to)) put(to, k < 3 ? 0 : 4, 3); /* 16, 17 and 18 do not occur */
    for (int64_t s = 0; s < SYMBOLS + 2; s++, flush(to)) {
        uint64_t bits = s < SYMBOLS ? lengths[s] : 1; /* the distances do not occur, but decoders want a code */
        put(to, (bits & 1) << 3 | (bits & 2) << 1 | (bits & 4) >> 1 | bits >> 3, 4);
    }
    uint64_t waiting = to->bits;
    int64_t count = to->count, i = 0;
    uint8_t *out = to->out;
    for (; i + 4 <= n; i += 4) {
        for (int64_t k = 0; k < 4; k++) {
            uint8_t symbol = bytes[i + k];
            waiting |= (uint64_t)codes[symbol] << count;
            count += lengths[symbol];
        }
        for (int64_t k = 0; k < 8; k++) out[k] = (uint8_t)(waiting >> 8 * k);
        out += count >> 3;
        waiting >>= count & ~7;
        count &= 7;
    }
    *to = (struct writer){out, waiting, count};
    for (; i < n; i++, flush(to)) put(to, codes[bytes[i]], lengths[bytes[i]]);
    put(to, codes[END], lengths[END]);
    flush(to);
}

/* Add bytes to the checksum of RFC 1950. */
PART uint32_t adler(uint32_t before, const uint8_t *bytes, int64_t n) {
    uint32_t low = before & 0xffff, high = before >> 16;
    for (; n; ) {
        int64_t part = n < ADLER_STEP ? n : ADLER_STEP;
        uint32_t sum = 0, weighted = 0;
        for (int64_t i = 0; i < part; i++) {
            sum += bytes[i];
            weighted += (uint32_t)(part - i) * bytes[i];
        }
        high = (high + (uint32_t)part * low % ADLER + weighted % ADLER) % ADLER;
        low = (low + sum) % ADLER;
        bytes += part;
        n -= part;
    }
    return high << 16 | low;
}

/* Compress pixels: (height, length bytes) -> a zlib stream in `out`, and its size. `scratch` holds `rows` filtered rows,
   of which a block is made; `out` has twice as many bytes as the pixels and 4096 more. */
EXPORT FOR_EVERY_PROCESSOR void hbr_png(const uint8_t *image, int64_t stride, int64_t height, int64_t length,
                                        int64_t rows, uint8_t *scratch, uint8_t *out, int64_t *size) {
    struct writer to = {out, 0, 0};
    put(&to, 0x0178, 16);
    flush(&to);
    uint32_t checksum = 1;
    for (int64_t y = 0; y < height; y += rows) {
        int64_t own = height - y < rows ? height - y : rows, n = own * (1 + length);
        const uint8_t *first = image + y * stride;
        filter_rows(first, stride, y ? first - stride : 0, own, length, scratch);
        checksum = adler(checksum, scratch, n);
        write_block(scratch, n, y + own == height, &to);
    }
    if (to.count) put(&to, 0, 8 - to.count);
    flush(&to);
    for (int64_t k = 24; k >= 0; k -= 8) *to.out++ = (uint8_t)(checksum >> k);
    *size = to.out - out;
}
