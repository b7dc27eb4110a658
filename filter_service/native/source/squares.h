/* Merging of squares of 2, 4 and 8 similar pixels where blur hides the difference.  Twin:
 * merge_fragments.comp.glsl. */

#include "frame.h"
#include "vectors.h"

/* Adjacent squares in eight lanes: those of 2^n pixels fill 2^n lanes each. */
typedef struct {
    f32x8 mean[RGB], low[RGB], high[RGB];    /* linear light */
    f32x8 dpt, least_dpt, most_dpt;
    f32x8 place, nearest, farthest;          /* in layers */
    f32x8 spread_px;                         /* smallest */
} square_row;

/* The squares of a block.  Sets are bit masks of their first pixels. */
typedef struct {
    square_row rows[MAX_LEVEL][TILE_SIZE_PX / 2];  /* of level 1 and higher */
    uint64_t merged[MAX_LEVEL + 1];
    uint32_t kernel[BLOCK_PIXELS];           /* of the largest square that starts there */
} block_squares;

INLINE square_row pixel_row_of(const block *b, int y) {
    square_row row;
    int first = y * TILE_SIZE_PX;
    for (int c = 0; c < RGB; ++c)
        row.mean[c] = row.low[c] = row.high[c] = load8(b->rgb[c] + first);
    row.dpt = row.least_dpt = row.most_dpt = load8(b->dpt + first);
    row.place = row.nearest = row.farthest = load8(b->place + first);
    row.spread_px = load8(b->spread_px + first);
    return row;
}

INLINE f32x8 least_of(f32x8 a, f32x8 b, int level) {
    f32x8 both = smaller8(a, b);
    return smaller8(both, across8(both, level));
}

INLINE f32x8 most_of(f32x8 a, f32x8 b, int level) {
    f32x8 both = larger8(a, b);
    return larger8(both, across8(both, level));
}

INLINE f32x8 mean_of(f32x8 a, f32x8 b, int level) {
    f32x8 both = a + b;
    return (both + across8(both, level)) * all8(0.25f);
}

/* Joins two rows of the level below to one of this level. */
INLINE void join_rows(const square_row *a, const square_row *b, int level, square_row *to) {
    for (int c = 0; c < RGB; ++c) {
        to->mean[c] = mean_of(a->mean[c], b->mean[c], level);
        to->low[c] = least_of(a->low[c], b->low[c], level);
        to->high[c] = most_of(a->high[c], b->high[c], level);
    }
    to->dpt = mean_of(a->dpt, b->dpt, level);
    to->least_dpt = least_of(a->least_dpt, b->least_dpt, level);
    to->most_dpt = most_of(a->most_dpt, b->most_dpt, level);
    to->place = mean_of(a->place, b->place, level);
    to->nearest = least_of(a->nearest, b->nearest, level);
    to->farthest = most_of(a->farthest, b->farthest, level);
    to->spread_px = least_of(a->spread_px, b->spread_px, level);
}

/* Difference of light in one color; if the output is encoded for a display, the equivalent
 * difference in a midtone. */
INLINE f32x8 seen_contrast(const frame *f, const square_row *s, int c) {
    f32x8 contrast = s->high[c] - s->low[c];
    if (!f->is_encoded) return contrast;
    f32x8 light = (s->high[c] + s->low[c]) * all8(0.5f / (MERGE_MIDTONE * f->white_level));
    return contrast / root8(smaller8(larger8(light, all8(MERGE_DARKEST)), all8(1.0f)));
}

/* Bit mask of the squares that blur allows to merge into one fragment.  Relative to twice
 * the blur, a square of the next level looks the same, and so does its error. */
INLINE uint32_t similar_lanes(const block *b, const square_row *s, int level) {
    const frame *f = b->f;
    f32x8 spread = s->spread_px * all8(1.0f / (float)(1 << (level - 1)));
    f32x8 contrast = seen_contrast(f, s, 0);
    for (int c = 1; c < RGB; ++c) contrast = larger8(contrast, seen_contrast(f, s, c));
    f32x8 most = all8(b->tolerance * f->white_level * MERGE_CONTRAST) * spread * root8(spread);
    f32x8 step = larger8(all8(MERGE_MAX_BLUR_STEP_PX), all8(MERGE_MAX_BLUR_RATIO) * s->spread_px);
    f32x8 blur_px = (s->most_dpt - s->least_dpt) * all8(f->blur_px_per_dpt);
    i32x8 intervals = whole8(s->farthest) - whole8(s->nearest);
    return bits_of8((spread >= all8(b->smallest_spread_px)) & (contrast <= most)
                    & (blur_px <= all8(b->tolerance) * step) & (intervals <= 1));
}

INLINE float lane_of(const f32x8 *lanes, int lane) { return ((const float *)lanes)[lane]; }

/* Returns whether the kernel of a square allows this level; stores the kernel. */
INLINE int take_square(const block *b, block_squares *all, const square_row *s, int i, int level) {
    const frame *f = b->f;
    int lane = i % TILE_SIZE_PX;
    uint32_t kernel = kernel_at(b, i, lane_of(&s->place, lane));
    const kernel_shape *shape = f->shapes + kernel;
    if (shape->highest_level < level) return 0;
    /* Coarse pixels would be visible in light brighter than white. */
    if (resolution_of(f, shape, level) > 0)
        for (int c = 0; c < RGB; ++c)
            if (lane_of(&s->high[c], lane) > f->white_level) return 0;
    all->kernel[i] = kernel;
    return 1;
}

/* Pixels, or squares of the level below, that start a group of 2 x 2. */
INLINE uint64_t starts_of_four(uint64_t below, int level) {
    static const uint64_t grid[MAX_LEVEL + 1] = {0, 0x0055005500550055u, 0x0000001100000011u, 1};
    int side = 1 << (level - 1);
    uint64_t pairs = below & below >> side;
    return pairs & pairs >> (side * TILE_SIZE_PX) & grid[level];
}

/* Merges squares of the level below; the compiler generates a loop for each level. */
INLINE uint64_t merge_level(const block *b, block_squares *all, uint64_t below, int level) {
    uint64_t starts = starts_of_four(below, level);
    if (starts == 0) return 0;
    uint64_t similar = 0;
    for (int row = 0; row < TILE_SIZE_PX >> level; ++row) {
        square_row *to = &all->rows[level - 1][row];
        if (level == 1) {
            square_row upper = pixel_row_of(b, 2 * row), lower = pixel_row_of(b, 2 * row + 1);
            join_rows(&upper, &lower, level, to);
        } else {
            const square_row *from = &all->rows[level - 2][2 * row];
            join_rows(from, from + 1, level, to);
        }
        similar |= (uint64_t)similar_lanes(b, to, level) << (row * TILE_SIZE_PX << level);
    }
    uint64_t merged = 0;
    for (uint64_t left = starts & similar; left; left &= left - 1) {
        int i = __builtin_ctzll(left);
        const square_row *s = &all->rows[level - 1][i / TILE_SIZE_PX >> level];
        if (take_square(b, all, s, i, level)) merged |= (uint64_t)1 << i;
    }
    return merged;
}

/* Merges a block as far as its kernels and `highest` allow. */
INLINE void merge_squares(const block *b, int highest, block_squares *all) {
    memset(all->merged, 0, sizeof all->merged);
    if (highest > 0) all->merged[1] = merge_level(b, all, b->held, 1);
    if (highest > 1) all->merged[2] = merge_level(b, all, all->merged[1], 2);
    if (highest > 2) all->merged[3] = merge_level(b, all, all->merged[2], 3);
}
