/* The connected parts of a mask, and which of them belong to the object. Two pixels are connected if their sides or
   corners touch. Of equal parts, the first one in the order of cv2.connectedComponents counts: the order of the first
   square of 2 x 2 pixels that contains a pixel of the part. */
#include "kernels.h"

struct run {
    int32_t y, begin, end; /* pixels [begin, end) of row y */
    int32_t root;          /* index of a run of the same part; a root has its own index */
    int32_t left, top, right, bottom, area, square; /* of the whole part; only the root has them */
    double weight;
};

PART int32_t root_of(struct run *run, int32_t at) {
    while (run[at].root != at) {
        run[at].root = run[run[at].root].root;
        at = run[at].root;
    }
    return at;
}

PART int32_t lower(int32_t a, int32_t b) { return a < b ? a : b; }
PART int32_t higher(int32_t a, int32_t b) { return a > b ? a : b; }

PART void join(struct run *run, int32_t a, int32_t b) {
    a = root_of(run, a);
    b = root_of(run, b);
    if (a != b) run[higher(a, b)].root = lower(a, b);
}

/* Find the runs of a mask and join those that touch. Returns their number, at most height * (width + 1) / 2. */
static int32_t runs_of(const uint8_t *mask, int32_t height, int32_t width, struct run *run) {
    int32_t count = 0, above = 0;
    for (int32_t y = 0; y < height; y++, mask += width) {
        const int32_t first = count;
        for (int32_t x = 0; x < width;) {
            if (!mask[x]) {
                x++;
                continue;
            }
            const int32_t begin = x;
            while (x < width && mask[x]) x++;
            run[count] = (struct run){.y = y, .begin = begin, .end = x, .root = count};
            while (above < first && run[above].end < begin) above++;
            for (int32_t i = above; i < first && run[i].begin <= x; i++) join(run, i, count);
            count++;
        }
        above = first;
    }
    return count;
}

/* Add up what the runs of each part cover; `prior` (height, width) may be 0. */
static void add_up(struct run *run, int32_t count, int32_t width, const float *prior) {
    for (int32_t i = 0; i < count; i++) {
        struct run *r = run + i, *part = run + root_of(run, i);
        const int32_t square = (r->y / 2) * ((width + 1) / 2) + r->begin / 2;
        if (part == r) {
            r->left = r->begin;
            r->top = r->y;
            r->right = r->end;
            r->square = square;
        }
        part->left = lower(part->left, r->begin);
        part->right = higher(part->right, r->end);
        part->bottom = r->y + 1;
        part->area += r->end - r->begin;
        part->square = lower(part->square, square);
        if (prior)
            for (int32_t x = r->begin; x < r->end; x++) part->weight += (double)prior[r->y * width + x];
    }
}

PART int is_near(const struct run *a, const struct run *b, int32_t away) {
    return a->left < b->right + away && b->left < a->right + away && a->top < b->bottom + away &&
           b->top < a->bottom + away;
}

/* Store the runs of the parts that are marked by a weight below 0. */
static void paint(struct run *run, int32_t count, int32_t height, int32_t width, uint8_t *out) {
    for (int32_t i = 0; i < height * width; i++) out[i] = 0;
    for (int32_t i = 0; i < count; i++)
        if (run[root_of(run, i)].weight < 0)
            for (int32_t x = run[i].begin; x < run[i].end; x++) out[run[i].y * width + x] = 1;
}

/* Select the largest part and those that have this share of its area. If `framed`, parts at the border do not count, and
   the others must be near it. `found` is 0 if the largest part is smaller than `least`, or than this share of one at the
   border. `work` holds 6 numbers for each run, at most height * (width + 1) / 2. */
EXPORT void hbr_largest_parts(const uint8_t *mask, int64_t height, int64_t width, int64_t framed, int64_t near,
                              double least, double of_border, double share, void *work, uint8_t *out, int64_t *found) {
    struct run *run = work, *largest = 0;
    const int32_t count = runs_of(mask, (int32_t)height, (int32_t)width, run);
    int32_t at_border = 0;
    *found = 0;
    add_up(run, count, (int32_t)width, 0);
    for (int32_t i = 0; i < count; i++) {
        struct run *part = run + i;
        if (part->root != i) continue;
        if (framed && (!part->left || !part->top || part->right == width || part->bottom == height)) {
            at_border = higher(at_border, part->area);
            continue;
        }
        part->weight = 1; /* counts */
        if (!largest || part->area > largest->area || (part->area == largest->area && part->square < largest->square))
            largest = part;
    }
    if (!largest || largest->area < least || largest->area < of_border * at_border) return;
    for (int32_t i = 0; i < count; i++) {
        struct run *part = run + i;
        if (part->root == i && part->weight == 1 && part->area > share * largest->area &&
            (!framed || is_near(part, largest, (int32_t)near)))
            part->weight = -1;
    }
    paint(run, count, (int32_t)height, (int32_t)width, out);
    *found = 1;
}

/* Select the part with the largest sum of `prior` (height, width), and the parts near it that have this share of its area
   and a mean of `prior` above `mean`. */
EXPORT void hbr_likely_parts(const uint8_t *mask, int64_t height, int64_t width, const float *prior, int64_t near,
                             double share, double mean, void *work, uint8_t *out, int64_t *found) {
    struct run *run = work, *main = 0;
    const int32_t count = runs_of(mask, (int32_t)height, (int32_t)width, run);
    add_up(run, count, (int32_t)width, prior);
    for (int32_t i = 0; i < count; i++) {
        struct run *part = run + i;
        if (part->root == i && (!main || part->weight > main->weight ||
                                (part->weight == main->weight && part->square < main->square)))
            main = part;
    }
    *found = main != 0;
    if (!main) return;
    for (int32_t i = 0; i < count; i++) {
        struct run *part = run + i;
        if (part->root == i && part != main && part->area > share * main->area && part->weight > mean * part->area &&
            is_near(part, main, (int32_t)near))
            part->weight = -1;
    }
    main->weight = -1;
    paint(run, count, (int32_t)height, (int32_t)width, out);
}
