/* Light from beyond kernels, on squares, that is added to the pixels of an image. */
#ifndef OCU_ADDED_LIGHT_H
#define OCU_ADDED_LIGHT_H

#include "bounds.h"
#include "constants.h"
#include "vectors.h"

/* Edge of the squares. */
#define SQUARE_PX 4

typedef struct {
    const float *squares;     /* (rows, columns, 8): light, 0, share of white, 0; or NULL */
    int64_t rows, columns;
} added_light;

/* Interpolates squares (count,) from column `first` on, which may be outside, at a row of
 * pixels. */
INLINE void blend_squares(const added_light *added, int64_t y, int64_t first, int64_t count,
                          f32x8 *found) {
    int64_t above = (y + SQUARE_PX / 2) / SQUARE_PX - 1;
    float part = ((float)((y + SQUARE_PX / 2) % SQUARE_PX) + 0.5f) / (float)SQUARE_PX;
    int64_t stride = 8 * added->columns;
    const float *upper = added->squares + stride * larger_index(above, 0);
    const float *lower = added->squares + stride * smaller_index(above + 1, added->rows - 1);
    for (int64_t i = 0; i < count; ++i) {
        int64_t at = 8 * smaller_index(larger_index(first + i, 0), added->columns - 1);
        found[i] = load8(upper + at) + all8(part) * (load8(lower + at) - load8(upper + at));
    }
}

/* Returns two pixels, of which the first has an even x, with the light of squares.  What they
 * receive replaces as much of their own.  blended: squares from `first` on. */
INLINE f32x8 with_light(f32x8 pixels, const f32x8 *blended, int64_t first, int64_t x) {
    const f32x8 *left = blended + (x + SQUARE_PX / 2) / SQUARE_PX - 1 - first;
    float part = ((float)((x + SQUARE_PX / 2) % SQUARE_PX) + 0.5f) / (float)SQUARE_PX;
    f32x8 change = left[1] - left[0];
    f32x8 one = left[0] + all8(part) * change;
    f32x8 other = left[0] + all8(part + 1.0f / (float)SQUARE_PX) * change;
    f32x8 light = MIXED(one, other, 0, 1, 2, 3, 8, 9, 10, 11);
    f32x8 share = MIXED(one, other, 4, 5, 6, 7, 12, 13, 14, 15);
    return pixels - pixels * share + light;
}

#endif
