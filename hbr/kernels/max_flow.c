/* Maximum flow through a grid of pixels, each connected with its eight neighbours.

   Source: Y. Boykov and V. Kolmogorov, "An experimental comparison of min-cut/max-flow algorithms for energy minimization
   in vision", IEEE TPAMI 2004. A tree grows from the source and a tree grows from the sink, until they touch; flow is
   sent along the path; vertices that this cuts off search for another parent. A vertex that is in neither tree at the end
   has the side of its last tree, so the order of all steps must be that of OpenCV. */
#include "grab_cut.h"

#define SIDES 8 /* neighbours: lower right, below, lower left, right, and the opposite ones from the upper right on */

enum { TERMINAL = -1, ORPHAN = -2, FREE = -3 }; /* instead of the side of the parent */
enum { SOURCE, SINK };
#define ABSENT (-1) /* not in the queue of active vertices */

static const int8_t opposite[SIDES] = {6, 5, 4, 7, 2, 1, 0, 3};

PART double smaller(double a, double b) { return b < a ? b : a; } /* a if b is NaN */
PART double magnitude(double a) { return a < 0 ? -a : a; }

struct search {
    double *rest, *capacity;
    int32_t *next;             /* in the queue */
    int32_t *since, *distance; /* number of the path at which the distance to the terminal was right */
    int32_t *orphans, *edges, *children;
    int16_t *up; /* step to the parent */
    int8_t *parent;
    uint8_t *tree, *out, *in; /* `out`, `in`: bits of the sides to which, and from which, flow is possible */
    int32_t step[SIDES], edge[SIDES];
    int32_t first, last, end; /* of the queue */
    int32_t now, waiting;     /* number of this path, and of orphans */
};

/* Return the index of the capacity from a vertex to a side. That of the opposite direction differs in the last bit. */
PART int32_t edge_of(const struct search *s, int32_t at, int side) { return at * SIDES + s->edge[side]; }

PART void append(struct search *s, int32_t at) {
    if (s->next[at] != ABSENT) return;
    s->next[at] = s->end;
    s->next[s->last] = at;
    s->last = at;
}

PART void abandon(struct search *s, int32_t at) {
    s->parent[at] = ORPHAN;
    s->orphans[s->waiting++] = at;
}

PART void adopt(struct search *s, int32_t at, int side, int32_t since, int32_t distance) {
    s->parent[at] = (int8_t)side;
    s->up[at] = (int16_t)s->step[side];
    s->since[at] = since;
    s->distance[at] = distance;
}

/* Mark whether flow is possible along an edge. */
static void mark(struct search *s, int32_t edge, int possible) {
    const int side = edge >> 1 & 3, back = opposite[side];
    const int32_t near = edge / SIDES, far = near + s->step[side];
    uint8_t *out = edge & 1 ? s->out + far : s->out + near, *in = edge & 1 ? s->in + near : s->in + far;
    const unsigned leaving = 1u << (edge & 1 ? back : side), entering = 1u << (edge & 1 ? side : back);
    *out = (uint8_t)(possible ? *out | leaving : *out & ~leaving);
    *in = (uint8_t)(possible ? *in | entering : *in & ~entering);
}

/* Send flow along an edge. Returns whether the edge is then full. */
PART int push(struct search *s, int32_t edge, double flow) {
    double *there = s->capacity + edge, *back = s->capacity + (edge ^ 1);
    const double before = *back;
    *back = before + flow;
    *there -= flow;
    if (before == 0) mark(s, edge ^ 1, 1);
    if (*there != 0) return 0;
    mark(s, edge, 0);
    return 1;
}

/* Grow the trees until they touch. Returns the edge from one to the other, or -1 if they cannot touch. */
static int32_t grow(struct search *s, int32_t *from, int32_t *to) {
    while (s->first != s->end) {
        const int32_t at = s->first;
        if (s->parent[at] != FREE) {
            const int tree = s->tree[at];
            const int32_t since = s->since[at], distance = s->distance[at] + 1;
            for (unsigned sides = tree == SOURCE ? s->out[at] : s->in[at]; sides; sides &= sides - 1) {
                const int side = __builtin_ctz(sides);
                const int32_t other = at + s->step[side];
                if (s->parent[other] == FREE) {
                    s->tree[other] = (uint8_t)tree;
                    adopt(s, other, opposite[side], since, distance);
                    append(s, other);
                } else if (s->tree[other] != tree) {
                    *from = tree == SOURCE ? at : other;
                    *to = tree == SOURCE ? other : at;
                    return edge_of(s, at, side) ^ tree;
                } else if (s->distance[other] > distance && s->since[other] <= since) {
                    adopt(s, other, opposite[side], since, distance);
                }
            }
        }
        s->first = s->next[at];
        s->next[at] = ABSENT;
    }
    return -1;
}

/* List the edges from a vertex to the terminal of its tree, as the flow passes them. Returns the terminal's neighbour. */
PART int32_t trace(struct search *s, int32_t at, int tree, double *flow, int32_t *count) {
    int32_t n = *count;
    double least = *flow;
    for (; s->parent[at] >= 0; n++) {
        s->children[n] = at;
        s->edges[n] = edge_of(s, at, s->parent[at]) ^ (tree == SOURCE);
        least = smaller(least, s->capacity[s->edges[n]]);
        at += s->up[at];
    }
    *flow = smaller(least, magnitude(s->rest[at]));
    *count = n;
    return at;
}

/* Send flow along the path over an edge between the trees, and collect the vertices that it cuts off. */
static void augment(struct search *s, int32_t edge, int32_t from, int32_t to) {
    double flow = s->capacity[edge];
    int32_t half = 0;
    const int32_t begin = trace(s, from, SOURCE, &flow, &half);
    int32_t count = half;
    const int32_t end = trace(s, to, SINK, &flow, &count);
    push(s, edge, flow);
    for (int32_t i = 0; i < half; i++)
        if (push(s, s->edges[i], flow)) abandon(s, s->children[i]);
    s->rest[begin] -= flow;
    if (s->rest[begin] == 0) abandon(s, begin);
    for (int32_t i = half; i < count; i++)
        if (push(s, s->edges[i], flow)) abandon(s, s->children[i]);
    s->rest[end] += flow;
    if (s->rest[end] == 0) abandon(s, end);
}

/* Return the distance to the terminal through a vertex; INT32_MAX if the vertex is cut off. */
PART int32_t distance_over(struct search *s, int32_t start) {
    const int32_t now = s->now;
    int32_t distance = 1, at = start;
    for (; s->since[at] != now; at += s->up[at]) {
        distance++;
        if (s->parent[at] >= 0) continue;
        if (s->parent[at] == ORPHAN) return INT32_MAX;
        s->since[at] = now;
        s->distance[at] = 1;
        distance--;
        break;
    }
    const int32_t found = distance += s->distance[at];
    for (at = start; s->since[at] != now; at += s->up[at]) {
        s->since[at] = now;
        s->distance[at] = --distance;
    }
    return found;
}

/* Give each vertex that was cut off the nearest parent in its tree. Without one, free it and cut off its children. */
static void restore(struct search *s) {
    while (s->waiting) {
        const int32_t at = s->orphans[--s->waiting];
        const int tree = s->tree[at];
        const unsigned open = tree == SOURCE ? s->in[at] : s->out[at];
        int32_t nearest = INT32_MAX;
        int best = FREE;
        for (unsigned sides = open; sides; sides &= sides - 1) {
            const int side = __builtin_ctz(sides);
            const int32_t other = at + s->step[side];
            if (s->tree[other] != tree || s->parent[other] == FREE) continue;
            const int32_t distance = distance_over(s, other);
            if (distance < nearest) {
                nearest = distance;
                best = side;
            }
        }
        if (best != FREE) {
            adopt(s, at, best, s->now, nearest);
            continue;
        }
        s->parent[at] = FREE;
        s->since[at] = 0;
        for (int side = 0; side < SIDES; side++) {
            const int32_t other = at + s->step[side];
            if (s->tree[other] != tree || s->parent[other] == FREE) continue;
            if (open >> side & 1) append(s, other);
            if (s->parent[other] == opposite[side]) abandon(s, other);
        }
    }
}

void hbr_max_flow(int64_t height, int64_t width, double *rest, double *capacity, int32_t *work, uint8_t *tree) {
    const int32_t row = (int32_t)width, count = (int32_t)(height * width);
    struct search search = {
        .rest = rest,
        .capacity = capacity,
        .next = work,
        .since = work + count,
        .distance = work + 2 * count,
        .orphans = work + 3 * count,
        .edges = work + 4 * count,
        .children = work + 6 * count,
        .up = (int16_t *)(work + 8 * count),
        .parent = (int8_t *)(work + 9 * count),
        .tree = tree,
        .out = (uint8_t *)(work + 10 * count),
        .in = (uint8_t *)(work + 11 * count),
        .step = {row + 1, row, row - 1, 1, 1 - row, -row, -row - 1, -1},
        .first = count,
        .end = count,
    };
    struct search *s = &search;
    for (int side = 0; side < SIDES; side++)
        s->edge[side] = side < 4 ? 2 * side : s->step[side] * SIDES + 2 * opposite[side] + 1;
    for (int32_t at = 0; at < count; at++) {
        const int active = rest[at] != 0;
        s->since[at] = 0;
        s->up[at] = 0;
        s->out[at] = s->in[at] = 0;
        s->distance[at] = active;
        s->parent[at] = active ? TERMINAL : FREE;
        s->tree[at] = rest[at] < 0 ? SINK : SOURCE;
        s->next[at] = ABSENT;
        if (!active) continue;
        if (s->first == count)
            s->first = at;
        else
            s->next[s->last] = at;
        s->last = at;
        s->next[at] = count;
    }
    for (int32_t edge = 0; edge < count * SIDES; edge++)
        if (capacity[edge] != 0) mark(s, edge, 1);
    int32_t from, to;
    for (int32_t edge; (edge = grow(s, &from, &to)) >= 0;) {
        augment(s, edge, from, to);
        s->now++;
        restore(s);
    }
}
