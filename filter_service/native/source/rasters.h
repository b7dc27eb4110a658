/* Pixels whose light is being added up, in pairs side by side. */

#include "frame.h"
#include "vectors.h"

/* Sums of two pixels side by side: red, green, blue and nothing of each. */
typedef struct { f32x8 light, coverage; } pixel_pair;

#define PAIRS_ACROSS (BIN_WIDTH / 2)

/* Pixels of one size whose light is being added up.  Those of 2 and 4 px go one beyond
 * the window on each side, as light is interpolated between their middles. */
typedef struct {
    int x0, y0, width, height;  /* in their own size */
    int stride;                 /* pairs from row to row */
    int is_lit;
    pixel_pair *pairs;
} raster;

/* Pixels of a bin or a tile: of the depth that is open in each size, and of the depths
 * before it. */
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

/* Sums of a bin in all sizes; a tile uses the first of each. */
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
