/* Accumulation buffers: pixels in horizontal pairs. */

#include "frame.h"
#include "vectors.h"

/* Sums of two adjacent pixels: red, green, blue and an unused lane of each. */
typedef struct { f32x8 light, coverage; } pixel_pair;

#define PAIRS_ACROSS (BIN_WIDTH / 2)

/* Accumulated pixels of one size.  Those of 2 and 4 px extend one pixel beyond the window on
 * each side, as light is interpolated between their centers. */
typedef struct {
    int x0, y0, width, height;  /* in their own size */
    int stride;                 /* pairs from row to row */
    int is_lit;
    pixel_pair *pairs;
} raster;

/* Pixels of a bin or a tile: of the open depth in each size, and of the nearer depths. */
typedef struct {
    int x0, y0, width, height;
    raster open[RESOLUTIONS];
    pixel_pair *near;           /* rows of PAIRS_ACROSS */
} window;

INLINE void clear_pairs(pixel_pair *pairs, int stride, int width, int height) {
    for (int y = 0; y < height; ++y)
        memset(pairs + y * stride, 0, sizeof *pairs * (size_t)(width / 2));
}

INLINE void clear_raster(raster *own) {
    clear_pairs(own->pairs, own->stride, own->width, own->height);
    own->is_lit = 0;
}

/* Sums of a bin in all sizes; a tile uses the first elements of each. */
typedef struct {
    pixel_pair near[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair open[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair half[(BIN_HEIGHT / 2 + 2) * (PAIRS_ACROSS / 2 + 1)];
    pixel_pair quarter[(BIN_HEIGHT / 4 + 2) * (PAIRS_ACROSS / 4 + 1)];
} bin_sums;

INLINE window open_window(int x0, int y0, int width, int height, bin_sums *s) {
    window w = {x0, y0, width, height, {{x0, y0, width, height, PAIRS_ACROSS, 0, s->open}}, s->near};
    pixel_pair *coarse[RESOLUTIONS] = {s->open, s->half, s->quarter};
    for (int r = 1; r < RESOLUTIONS; ++r)
        w.open[r] = (raster){(x0 >> r) - 1, (y0 >> r) - 1, (width >> r) + 2, (height >> r) + 2,
                             ((width >> r) + 2) / 2, 0, coarse[r]};
    for (int r = 0; r < RESOLUTIONS; ++r) clear_raster(w.open + r);
    return w;
}
