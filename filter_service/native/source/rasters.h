/* Accumulation buffers: pixels in horizontal pairs. */

#include "frame.h"
#include "vectors.h"

/* Sums of two adjacent pixels: red, green, blue and a fourth lane of each, which is the
 * strength of edges with the light, and the excess light with the coverage. */
typedef struct { f32x8 light, coverage; } pixel_pair;

/* Share of each pixel's light that is in excess of its surroundings. */
INLINE f32x8 excess_shares(const pixel_pair *sums) {
    float shares[2];
    for (int pixel = 0; pixel < 2; ++pixel) {
        const float *light = (const float *)&sums->light + 4 * pixel;
        float mean = (light[0] + light[1] + light[2]) * (1.0f / RGB);
        float excess = ((const float *)&sums->coverage)[4 * pixel + 3];
        shares[pixel] = mean > 0.0f ? smaller_float(excess / mean, 1.0f) : 0.0f;
    }
    return (f32x8){shares[0], shares[0], shares[0], shares[0],
                   shares[1], shares[1], shares[1], shares[1]};
}

INLINE int has_excess(const pixel_pair *sums) {
    return sums->coverage[3] + sums->coverage[7] > 0.0f;
}

#define PAIRS_ACROSS (BIN_WIDTH / 2)

/* Accumulated pixels of one size.  Those of 2 and 4 px extend one pixel beyond the window on
 * each side, as light is interpolated between their centers. */
typedef struct {
    int x0, y0, width, height;  /* in their own size */
    int stride;                 /* pairs from row to row */
    int is_lit;                 /* otherwise its sums are not set */
    pixel_pair *pairs;
} raster;

/* Light of one group of depths in each size. */
typedef struct { raster sizes[RESOLUTIONS]; } depth_group;

/* Pixels of a bin or a tile, in rows of PAIRS_ACROSS. */
typedef struct {
    int x0, y0, width, height;
    depth_group open[2];        /* two consecutive groups; without order, only the first */
    pixel_pair *near;           /* light of closed groups, each behind those before it */
    pixel_pair *total;          /* light of closed groups, regardless of order */
    int has_hidden;             /* whether it includes light of a hidden surface */
} window;

INLINE void clear_pairs(pixel_pair *pairs, int stride, int width, int height) {
    for (int y = 0; y < height; ++y)
        memset(pairs + y * stride, 0, sizeof *pairs * (size_t)(width / 2));
}

static __attribute__((noinline)) void begin_raster(raster *own) {
    clear_pairs(own->pairs, own->stride, own->width, own->height);
    own->is_lit = 1;
}

/* Clears a raster to which nothing has been added.  That is rare: inlined, it takes registers
 * from the loop over fragments. */
INLINE void light_raster(raster *own) {
    if (__builtin_expect(!own->is_lit, 0)) begin_raster(own);
}

/* Sums of a group of depths in all sizes; a tile uses the first elements of each. */
typedef struct {
    pixel_pair whole[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair half[(BIN_HEIGHT / 2 + 2) * (PAIRS_ACROSS / 2 + 1)];
    pixel_pair quarter[(BIN_HEIGHT / 4 + 2) * (PAIRS_ACROSS / 4 + 1)];
} group_sums;

/* Sums of a bin. */
typedef struct {
    pixel_pair near[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair total[BIN_HEIGHT * PAIRS_ACROSS];
    group_sums open[2];
} bin_sums;

INLINE depth_group open_group(int x0, int y0, int width, int height, group_sums *s) {
    depth_group group = {{{x0, y0, width, height, PAIRS_ACROSS, 0, s->whole}}};
    pixel_pair *coarse[RESOLUTIONS] = {s->whole, s->half, s->quarter};
    for (int r = 1; r < RESOLUTIONS; ++r)
        group.sizes[r] = (raster){(x0 >> r) - 1, (y0 >> r) - 1, (width >> r) + 2,
                                  (height >> r) + 2, ((width >> r) + 2) / 2, 0, coarse[r]};
    return group;
}

/* Opens a window with one group of depths. */
INLINE window open_window(int x0, int y0, int width, int height, bin_sums *s) {
    window w = {.x0 = x0, .y0 = y0, .width = width, .height = height,
                .near = s->near, .total = s->total};
    w.open[0] = open_group(x0, y0, width, height, s->open);
    return w;
}

/* Prepares a window for groups of depths in order. */
INLINE void open_order(window *w, bin_sums *s) {
    w->open[1] = open_group(w->x0, w->y0, w->width, w->height, s->open + 1);
    clear_pairs(w->near, PAIRS_ACROSS, w->width, w->height);
    clear_pairs(w->total, PAIRS_ACROSS, w->width, w->height);
}
