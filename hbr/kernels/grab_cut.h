/* The functions of clusters.c and max_flow.c that grab_cut.c uses. */
#ifndef HBR_GRAB_CUT_H
#define HBR_GRAB_CUT_H

#include "kernels.h"

#define COLOURS 5 /* clusters, and parts of a mixture */

/* Find five clusters of colours: `colours` (3, stride) of which `count` are used, at least five and fewer than 65793 ->
   `label` (count). `random` is the state of the random numbers; `work` holds 3 * count integers. */
void hbr_find_clusters(const float *colours, int64_t stride, int64_t count, uint64_t *random, int32_t *work,
                       int32_t *label);

/* Send as much as possible from the source to the sink, in a grid (height, width). No flow passes through the vertices
   of its margin, which is one vertex wide. `rest` (height, width) is what the source gives to a vertex, or, below 0,
   what the sink takes from it. `capacity` (height, width, 4, 2) is the capacity from a vertex to its neighbours on the
   lower right, below, on the lower left and on the right, and back. `work` holds 14 numbers for each vertex. -> `tree`
   (height, width) is 0 on the side of the source and 1 on that of the sink. */
void hbr_max_flow(int64_t height, int64_t width, double *rest, double *capacity, int32_t *work, uint8_t *tree);

#endif
