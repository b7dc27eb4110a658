/* Merging of squares of 2, 4 and 8 similar pixels where blur hides the difference; squares that
 * just miss a limit are moved toward their mean.  Twin: merge_fragments.comp.glsl. */

#include "frame.h"
#include "vectors.h"

/* Bit masks of the pixels of a square that starts at pixel 0. */
static const uint64_t square_pixels[MAX_LEVEL + 1] = {1, 0x0303u, 0x0F0F0F0Fu, ~(uint64_t)0};

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
    uint64_t fading[MAX_LEVEL + 1];          /* that miss a limit, but not by far */
    float fade[MAX_LEVEL + 1][BLOCK_PIXELS]; /* of these: share of the way to their mean */
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

/* How far a value is from missing its limit by MERGE_FADE_RATIO, from 1 at the limit to 0.  The
 * margin is never 0, so that equal values below a limit of 0 are at 1. */
INLINE f32x8 fade_lanes(f32x8 value, f32x8 limit) {
    f32x8 margin = all8(MERGE_FADE_RATIO) * limit + all8(1e-30f);
    return (limit - value) / margin + all8(1.0f);
}

/* Bit mask of the squares that blur allows to merge into one fragment, and of those that do not
 * miss a limit by far (`close`), with their share of the way to their mean.  Relative to twice the blur, a square of the
 * next level looks the same, and so does its error. */
INLINE uint32_t similar_lanes(const block *b, const square_row *s, int level, uint32_t *close,
                              float *fade) {
    const frame *f = b->f;
    f32x8 spread = s->spread_px * all8(1.0f / (float)(1 << (level - 1)));
    f32x8 contrast = seen_contrast(f, s, 0);
    for (int c = 1; c < RGB; ++c) contrast = larger8(contrast, seen_contrast(f, s, c));
    f32x8 most = all8(b->tolerance * f->white_level * MERGE_CONTRAST) * spread * root8(spread);
    f32x8 step = larger8(all8(MERGE_MAX_BLUR_STEP_PX), all8(MERGE_MAX_BLUR_RATIO) * s->spread_px);
    f32x8 blur_px = (s->most_dpt - s->least_dpt) * all8(f->blur_px_per_dpt);
    f32x8 most_px = all8(b->tolerance) * step;
    /* Farther apart, there may be no kernel between them. */
    i32x8 near = whole8(s->farthest) - whole8(s->nearest) <= 1;
    f32x8 least = all8(b->smallest_spread_px);
    uint32_t similar =
        bits_of8((spread >= least) & (contrast <= most) & (blur_px <= most_px) & near);
    f32x8 more = all8(1.0f + MERGE_FADE_RATIO);
    *close = similar
             | bits_of8((spread > all8(1.0f - MERGE_FADE_RATIO) * least)
                        & (contrast < more * most) & (blur_px < more * most_px) & near);
    f32x8 smallest = all8(1.0f);
    if (*close != similar) {
        smallest += (spread - least) / (all8(MERGE_FADE_RATIO) * least);
        smallest = smaller8(smallest, fade_lanes(contrast, most));
        smallest = smaller8(smallest, fade_lanes(blur_px, most_px));
    }
    store8(fade, smallest);
    return similar;
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

/* The smallest fade of the four squares of the level below; 1 for merged ones, and pixels. */
INLINE float part_fade(const block_squares *all, int i, int level) {
    float least = 1.0f;
    if (level == 1) return least;
    for (int part = 0; part < 4; ++part) {
        int at = i + (part & 1) * (1 << (level - 1)) + (part >> 1) * (TILE_SIZE_PX << (level - 1));
        if (!(all->merged[level - 1] >> at & 1))
            least = smaller_float(all->fade[level - 1][at], least);
    }
    return least;
}

/* How far the coverage of a hidden square allows its merging: it must be visible in full. */
INLINE float coverage_fade(const block *b, int i, int level) {
    float least = 1.0f;
    if (b->surface == 0) return least;
    for (uint64_t left = square_pixels[level] << i; left; left &= left - 1)
        least = smaller_float(b->share[__builtin_ctzll(left)], least);
    return 1.0f - (1.0f - least) * (1.0f / MERGE_FADE_RATIO);
}

/* Merges squares of the level below; the compiler generates a loop for each level. */
INLINE void merge_level(const block *b, block_squares *all, int level) {
    uint64_t whole = level == 1 ? b->held : all->merged[level - 1];
    uint64_t below = level == 1 ? b->held : all->merged[level - 1] | all->fading[level - 1];
    uint64_t starts = starts_of_four(below, level);
    if (starts == 0) return;
    uint64_t similar = 0, close = 0;
    for (int row = 0; row < TILE_SIZE_PX >> level; ++row) {
        square_row *to = &all->rows[level - 1][row];
        if (level == 1) {
            square_row upper = pixel_row_of(b, 2 * row), lower = pixel_row_of(b, 2 * row + 1);
            join_rows(&upper, &lower, level, to);
        } else {
            const square_row *from = &all->rows[level - 2][2 * row];
            join_rows(from, from + 1, level, to);
        }
        int first = row * TILE_SIZE_PX << level;
        uint32_t row_close;
        similar |= (uint64_t)similar_lanes(b, to, level, &row_close, all->fade[level] + first)
                   << first;
        close |= (uint64_t)row_close << first;
    }
    uint64_t full = similar & starts_of_four(whole, level);
    for (uint64_t left = starts & close; left; left &= left - 1) {
        int i = __builtin_ctzll(left);
        uint64_t bit = left & -left;
        const square_row *s = &all->rows[level - 1][i / TILE_SIZE_PX >> level];
        float fade = coverage_fade(b, i, level);
        if (full & bit && fade >= 1.0f) {
            if (take_square(b, all, s, i, level)) all->merged[level] |= bit;
            continue;
        }
        if (b->f->paper_rule) continue;
        fade = smaller_float(fade, smaller_float(all->fade[level][i], part_fade(all, i, level)));
        all->fade[level][i] = fade;
        if (fade > 0.0f) all->fading[level] |= bit;
    }
}

/* Merges a block as far as its kernels and `highest` allow. */
INLINE void merge_squares(const block *b, int highest, block_squares *all) {
    memset(all->merged, 0, sizeof all->merged);
    memset(all->fading, 0, sizeof all->fading);
    if (highest > 0) merge_level(b, all, 1);
    if (highest > 1) merge_level(b, all, 2);
    if (highest > 2) merge_level(b, all, 3);
}
