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
    int is_set;                 /* all sums outside the lit rows are zero; otherwise not set */
    int top, bottom;            /* lit rows: the first, and the last plus one */
    pixel_pair *pairs;
} raster;

/* Light of one group of depths in each size. */
typedef struct { raster sizes[RESOLUTIONS]; } depth_group;

/* Pixels of a bin, in rows of PAIRS_ACROSS. */
typedef struct {
    int x0, y0, width, height;
    depth_group open;           /* the nearest group that is not closed, or all light */
    pixel_pair *near;           /* light of closed groups, each behind those before it */
    pixel_pair *total;          /* light of closed groups, regardless of order */
    float least[BIN_HEIGHT];    /* coverage of near of each row, of any color */
    float least_strength[BIN_HEIGHT];  /* of edges, of total */
} window;

INLINE void clear_pairs(pixel_pair *pairs, int stride, int width, int height) {
    for (int y = 0; y < height; ++y)
        memset(pairs + y * stride, 0, sizeof *pairs * (size_t)(width / 2));
}

static __attribute__((noinline)) void clear_raster(raster *own) {
    clear_pairs(own->pairs, own->stride, own->width, own->height);
    own->is_set = 1;
}

/* Prepares rows of a raster to which light is added. */
INLINE void light_rows(raster *own, int top, int bottom) {
    if (__builtin_expect(!own->is_set, 0)) clear_raster(own);
    own->top = smaller_int(own->top, larger_int(top, 0));
    own->bottom = larger_int(own->bottom, smaller_int(bottom, own->height));
}

/* Removes all light. */
INLINE void darken_raster(raster *own) {
    int rows = own->bottom - own->top;
    if (rows > 0)
        clear_pairs(own->pairs + own->top * own->stride, own->stride, own->width, rows);
    own->top = own->height;
    own->bottom = 0;
}

/* Sums of a group of depths in all sizes. */
typedef struct {
    pixel_pair whole[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair half[(BIN_HEIGHT / 2 + 2) * (PAIRS_ACROSS / 2 + 1)];
    pixel_pair quarter[(BIN_HEIGHT / 4 + 2) * (PAIRS_ACROSS / 4 + 1)];
} group_sums;

/* Sums of a bin. */
typedef struct {
    pixel_pair near[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair total[BIN_HEIGHT * PAIRS_ACROSS];
    group_sums open;
} bin_sums;

/* Opens a window on a bin. */
INLINE window open_window(int x0, int y0, bin_sums *s) {
    window w = {.x0 = x0, .y0 = y0, .width = BIN_WIDTH, .height = BIN_HEIGHT,
                .near = s->near, .total = s->total};
    pixel_pair *sums[RESOLUTIONS] = {s->open.whole, s->open.half, s->open.quarter};
    w.open.sizes[0] = (raster){x0, y0, BIN_WIDTH, BIN_HEIGHT, PAIRS_ACROSS, 0,
                                BIN_HEIGHT, 0, sums[0]};
    for (int r = 1; r < RESOLUTIONS; ++r) {
        int width = (BIN_WIDTH >> r) + 2, height = (BIN_HEIGHT >> r) + 2;
        w.open.sizes[r] = (raster){(x0 >> r) - 1, (y0 >> r) - 1, width, height, width / 2, 0,
                                   height, 0, sums[r]};
    }
    return w;
}

/* Prepares a window for groups of depths in order. */
INLINE void open_order(window *w) {
    clear_pairs(w->near, PAIRS_ACROSS, w->width, w->height);
    clear_pairs(w->total, PAIRS_ACROSS, w->width, w->height);
    memset(w->least, 0, sizeof w->least);
    memset(w->least_strength, 0, sizeof w->least_strength);
}
