/* Masks of 0 and 1: opened, closed and filled with the same pixels as by OpenCV in hbr/segmentation/silhouette.py.

   Each pixel is one bit. A row begins with a margin of `EDGE` zeros and ends with at least as many, so that bits that
   grow past an end of a row do not reach the next one. */
#include "kernels.h"

#define EDGE 16 /* wider than the discs */
#define EACH 0x0101010101010101ull

PART int64_t words_of(int64_t width) { return (width + 2 * EDGE + 63) / 64; }

/* Write a mask (height, width) to rows of bits; their margins do not change. */
PART void pack(const uint8_t *mask, int64_t height, int64_t width, int64_t words, uint64_t *rows) {
    for (int64_t y = 0; y < height; y++, mask += width) {
        uint8_t *row = (uint8_t *)(rows + y * words) + EDGE / 8;
        for (int64_t x = 0; x < width; x += 8) {
            uint64_t eight = 0;
            if (width - x >= 8)
                __builtin_memcpy(&eight, mask + x, 8);
            else
                for (int64_t i = 0; i < width - x; i++) eight |= (uint64_t)mask[x + i] << 8 * i;
            row[x / 8] = (uint8_t)(eight * 0x0102040810204080ull >> 56);
        }
    }
}

/* Write rows of bits to a mask, inverted: 1 for each bit that is 0. */
PART void unpack_inverted(const uint64_t *rows, int64_t height, int64_t width, int64_t words, uint8_t *mask) {
    for (int64_t y = 0; y < height; y++, mask += width) {
        const uint8_t *row = (const uint8_t *)(rows + y * words) + EDGE / 8;
        for (int64_t x = 0; x < width; x += 8) {
            const uint64_t spread = row[x / 8] * EACH & 0x8040201008040201ull;
            const uint64_t eight = ~((spread + 0x7f7f7f7f7f7f7f7full) >> 7) & EACH;
            if (width - x >= 8)
                __builtin_memcpy(mask + x, &eight, 8);
            else
                for (int64_t i = 0; i < width - x; i++) mask[x + i] = eight >> 8 * i & 1;
        }
    }
}

/* Grow rows of bits by a symmetric disc, whose rows reach `reach[j]` pixels to both sides, j = 0 .. 2 radius. There is a
   word of zeros before and after `near` and `far`. `near` holds the mask and is overwritten. */
PART void grow(int64_t height, int64_t words, const int64_t *reach, int64_t radius, uint64_t *near, uint64_t *far,
               uint64_t *out) {
    const int64_t n = height * words;
    for (int64_t i = 0; i < n; i++) out[i] = 0;
    for (int64_t k = 0; k <= radius; k++) {
        if (k) { /* one pixel further to both sides */
#pragma GCC ivdep
            for (int64_t i = 0; i < n; i++)
                far[i] = near[i] | near[i] << 1 | near[i - 1] >> 63 | near[i] >> 1 | near[i + 1] << 63;
            uint64_t *other = near;
            near = far;
            far = other;
        }
        for (int64_t j = -radius; j <= radius; j++) {
            if (reach[j + radius] != k) continue;
            const int64_t shift = j * words, from = shift < 0 ? -shift : 0, to = shift < 0 ? n : n - shift;
#pragma GCC ivdep
            for (int64_t i = from; i < to; i++) out[i] |= near[i + shift];
        }
    }
}

/* Open a mask (height, width) with one disc, then close it with another one. Pixels outside the image count neither as
   part of the mask nor as a gap in it. `work` (4 height words + 4) holds zeros. */
EXPORT FOR_EVERY_PROCESSOR void hbr_cleaned(const uint8_t *mask, int64_t height, int64_t width, const int64_t *open_reach,
                                            int64_t open_radius, const int64_t *close_reach, int64_t close_radius,
                                            uint64_t *work, uint8_t *out) {
    const int64_t words = words_of(width), n = height * words;
    uint64_t *near = work + 1, *far = near + n + 2, *inside = far + n + 1, *grown = inside + n;
    for (int64_t y = 0; y < height; y++)
        for (int64_t k = 0; k < words; k++) {
            const int64_t first = EDGE - 64 * k, last = first + width; /* of the pixels, by the bits of this word */
            const uint64_t begun = first <= 0 ? ~0ull : first < 64 ? ~0ull << first : 0;
            const uint64_t ended = last >= 64 ? 0 : last > 0 ? ~0ull << last : ~0ull;
            inside[y * words + k] = begun & ~ended;
        }
    pack(mask, height, width, words, near);
    for (int64_t i = 0; i < n; i++) near[i] = ~near[i] & inside[i];
    grow(height, words, open_reach, open_radius, near, far, grown);
    for (int64_t i = 0; i < n; i++) near[i] = ~grown[i] & inside[i];
    grow(height, words, open_reach, open_radius, near, far, grown);
    for (int64_t i = 0; i < n; i++) near[i] = grown[i] & inside[i];
    grow(height, words, close_reach, close_radius, near, far, grown);
    for (int64_t i = 0; i < n; i++) near[i] = ~grown[i] & inside[i];
    grow(height, words, close_reach, close_radius, near, far, grown);
    unpack_inverted(grown, height, width, words, out);
}

/* Extend the bits of `found` along the ones of `open`, towards both ends of a row of words. */
PART void extend(const uint64_t *open, int64_t words, uint64_t *found) {
    uint64_t carry = 0;
    for (int64_t k = 0; k < words; k++) { /* an addition carries a bit to the end of its run of ones */
        const uint64_t seeds = found[k] | (open[k] & carry);
        found[k] = ((open[k] ^ (open[k] + seeds)) & open[k]) | seeds;
        carry = found[k] >> 63;
    }
    carry = 0;
    for (int64_t k = words - 1; k >= 0; k--) {
        uint64_t bits = found[k] | (open[k] & carry << 63), run = open[k];
        for (int shift = 1; shift < 64; shift *= 2) {
            bits |= run & bits >> shift;
            run &= run >> shift;
        }
        found[k] = bits;
        carry = bits & 1;
    }
}

/* Add to a row what is connected with a neighbouring row; return whether it changed. */
PART int connect(const uint64_t *open, const uint64_t *beside, int64_t words, uint64_t *found) {
    uint64_t more = 0;
    for (int64_t k = 0; k < words; k++) {
        const uint64_t seeds = open[k] & beside[k] & ~found[k];
        found[k] |= seeds;
        more |= seeds;
    }
    if (more) extend(open, words, found);
    return more != 0;
}

/* Close a mask (height, width) with a disc and fill its holes: pixels without a path to the outside, from side to side.
   `work` (4 rows words + 4, rows = height + 32) holds zeros. */
EXPORT FOR_EVERY_PROCESSOR void hbr_filled(const uint8_t *mask, int64_t height, int64_t width, const int64_t *reach,
                                           int64_t radius, uint64_t *work, uint8_t *out) {
    const int64_t words = words_of(width), rows = height + 2 * EDGE, n = rows * words;
    uint64_t *near = work + 1, *far = near + n + 2, *open = far + n + 1, *outside = open + n;

    /* close the mask; all other pixels are open */
    pack(mask, height, width, words, near + EDGE * words);
    grow(rows, words, reach, radius, near, far, open);
    for (int64_t i = 0; i < n; i++) near[i] = ~open[i];
    grow(rows, words, reach, radius, near, far, open);

    /* from the upper margin down and up until nothing is added */
    for (int64_t k = 0; k < words; k++) outside[k] = open[k];
    for (int more = 1; more;) {
        more = 0;
        for (int64_t y = 1; y < rows; y++)
            more |= connect(open + y * words, outside + (y - 1) * words, words, outside + y * words);
        for (int64_t y = rows - 2; y >= 0; y--)
            more |= connect(open + y * words, outside + (y + 1) * words, words, outside + y * words);
    }
    unpack_inverted(outside + EDGE * words, height, width, words, out);
}
