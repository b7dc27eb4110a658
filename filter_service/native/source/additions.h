/* Accumulation of fragments in the pixels of a window. */

#include "frame.h"
#include "vectors.h"

/* Read access of a fragment to its kernel. */
typedef struct {
    const level_image *image;
    i32x8 factors;            /* near and far share of each pair */
    int left, top;            /* first column and row of the kernel in the raster */
} reading;

/* Fragments of the hidden surface follow those of the visible one. */
INLINE int is_hidden(const frame *f, uint32_t index) {
    return index >= (uint32_t)(f->block_rows * f->block_columns * f->block_slots);
}

INLINE const level_image *image_of(const frame *f, const fragment *one) {
    return f->kernels[one->state & KERNEL_MASK].level + (one->state >> LEVEL_SHIFT & 3);
}

INLINE reading start_reading(const fragment *one, const level_image *image,
                             const raster *own) {
    float fraction = (float)one->fraction * (1.0f / 65535.0f);
    int near = (int)((1.0f - fraction) * image->near_ratio + 0.5f);
    int far = (int)(fraction * image->far_ratio + 0.5f);
    int32_t factor = (int32_t)((uint32_t)near | (uint32_t)far << 16);
    return (reading){image,
                     {factor, factor, factor, factor, factor, factor, factor, factor},
                     (one->x >> image->resolution) - image->left - own->x0,
                     (one->y >> image->resolution) - image->up - own->y0};
}

INLINE i32x8 read_pairs(const uint32_t *from) {
    i32x8 pairs;
    memcpy(&pairs, from, sizeof pairs);
    return pairs;
}

INLINE const uint32_t *row_texels(const frame *f, const reading *r, int row) {
    ptrdiff_t texel = (ptrdiff_t)r->image->first_texel + (ptrdiff_t)row * (r->image->width + 1);
    return f->kernel_texels + 4 * (texel - r->left);
}

/* Pairs and rows of a raster that a kernel's box overlaps. */
typedef struct {
    int pair, pairs;          /* first, and count */
    int row, rows;            /* of the kernel */
} meeting;

INLINE meeting meet(const reading *r, const raster *own) {
    int pair = larger_int(r->left, 0) / 2;
    int row = larger_int(-r->top, 0);
    return (meeting){pair, (smaller_int(r->left + r->image->width, own->width) + 1) / 2 - pair,
                     row, smaller_int(own->height - r->top, r->image->height) - row};
}

/* Rows of a raster that a fragment is added to, and the data to add. */
typedef struct {
    pixel_pair *to;
    int to_stride, rows, pairs;
    const uint32_t *from;
    int from_stride;
    i32x8 factors;
    f32x8 color, scales;
} addition;

INLINE f32x8 weights_of(const addition *a, const uint32_t *from) {
    return __builtin_convertvector(pair_sums(read_pairs(from), a->factors), f32x8);
}

/* Adds one fragment; the compiler generates a loop for each number of pairs. */
INLINE void add_rows(const addition *a, int pairs) {
    pixel_pair *to = a->to;
    const uint32_t *from = a->from;
    for (int row = 0; row < a->rows; ++row, to += a->to_stride, from += a->from_stride) {
        for (int pair = 0; pair < pairs; ++pair) {
            f32x8 weight = weights_of(a, from + 8 * pair);
            to[pair].light += weight * a->color;
            to[pair].coverage += weight * a->scales;
        }
    }
}

/* Adds two fragments to the same rows: sums are read and written once for both. */
INLINE void add_both_rows(const addition *a, const addition *b, int pairs) {
    pixel_pair *to = a->to;
    const uint32_t *from_a = a->from;
    const uint32_t *from_b = b->from;
    for (int row = 0; row < a->rows; ++row) {
        for (int pair = 0; pair < pairs; ++pair) {
            f32x8 weight_a = weights_of(a, from_a + 8 * pair);
            f32x8 weight_b = weights_of(b, from_b + 8 * pair);
            f32x8 light = to[pair].light + weight_a * a->color;
            f32x8 coverage = to[pair].coverage + weight_a * a->scales;
            to[pair].light = light + weight_b * b->color;
            to[pair].coverage = coverage + weight_b * b->scales;
        }
        to += a->to_stride;
        from_a += a->from_stride;
        from_b += b->from_stride;
    }
}

#define FOR_EACH_WIDTH(CASE) CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7) CASE(8)

static void add_one(const addition *a) {
#define CASE(pairs) case pairs: add_rows(a, pairs); return;
    switch (a->pairs) { FOR_EACH_WIDTH(CASE) default: return; }
#undef CASE
}

static void add_both(const addition *a, const addition *b) {
#define CASE(pairs) case pairs: add_both_rows(a, b, pairs); return;
    switch (a->pairs) { FOR_EACH_WIDTH(CASE) default: return; }
#undef CASE
}

/* Prepares the addition of a share of a fragment to a group; false if it lights only other
 * parts of the bin.  A plain fragment has no extra values and no share of a cell, and its
 * raster is clear: many bins have no others, and take a twelfth less time without the checks. */
INLINE int prepare_addition(const frame *f, uint32_t index, float share, int is_plain,
                            depth_group *group, addition *a) {
    const fragment *one = f->fragments + index;
    const float *light = (const float *)(f->lights + index);
    const level_image *image = image_of(f, one);
    raster *own = group->sizes + image->resolution;
    reading r = start_reading(one, image, own);
    meeting m = meet(&r, own);
    if (m.pairs <= 0 || m.rows <= 0) return 0;
    if (!is_plain && f->blend_shares != NULL) share *= f->blend_shares[index];
    float scale = image->scale * share;
    f32x4 colors = load4(light) * (f32x4){scale, scale, scale, 0.0f}; /* without the depth */
    f32x4 scales = {scale, scale, scale, 0.0f};
    if (!is_plain && one->state & SPECIAL_BIT) {
        const fragment_extra *extra = f->extras + index;
        float coverage = scale * extra->coverage;
        colors[3] = scale * extra->strength;
        scales = (f32x4){coverage, coverage, coverage, scale * extra->excess};
    }
    if (is_plain) own->is_lit = 1;
    else light_raster(own);
    a->to = own->pairs + (m.row + r.top) * own->stride + m.pair;
    a->to_stride = own->stride;
    a->rows = m.rows;
    a->pairs = m.pairs;
    a->from = row_texels(f, &r, m.row) + 8 * m.pair;
    a->from_stride = 4 * (image->width + 1);
    a->factors = r.factors;
    a->color = twice4(colors);
    a->scales = twice4(scales);
    return 1;
}

/* Pending additions: one waits for another to the same rows. */
typedef struct {
    addition two[2];
    int waiting;              /* 0 or 1 */
} additions;

INLINE void flush_additions(additions *all) {
    if (all->waiting) add_one(all->two);
    all->waiting = 0;
}

INLINE void add_fragment(const frame *f, uint32_t index, float share, int is_plain,
                         depth_group *group, additions *all) {
    addition *newest = all->two + all->waiting;
    if (!prepare_addition(f, index, share, is_plain, group, newest)) return;
    if (!all->waiting) {
        all->waiting = 1;
        return;
    }
    const addition *first = all->two;
    if (first->to == newest->to && first->pairs == newest->pairs
        && first->rows == newest->rows) {
        add_both(first, newest);
        all->waiting = 0;
        return;
    }
    add_one(first);
    all->two[0] = *newest;
}

/* The paper's rule: a weight is an opacity; merging has one level, of four pixels. */
INLINE void cover_with_fragment(const frame *f, uint32_t index, const window *w) {
    const fragment *one = f->fragments + index;
    const float *rgb = f->lights[index].rgb;
    const level_image *image = image_of(f, one);
    const raster *own = w->open[0].sizes;
    reading r = start_reading(one, image, own);
    meeting m = meet(&r, own);
    f32x8 color = {rgb[0], rgb[1], rgb[2], 0.0f, rgb[0], rgb[1], rgb[2], 0.0f};
    int merged = (one->state >> LEVEL_SHIFT & 3) != 0;
    for (int row = m.row; row < m.row + m.rows; ++row) {
        const uint32_t *from = row_texels(f, &r, row) + 8 * m.pair;
        pixel_pair *to = w->near + (row + r.top) * PAIRS_ACROSS + m.pair;
        for (int pair = 0; pair < m.pairs; ++pair) {
            f32x8 weight = __builtin_convertvector(
                pair_sums(read_pairs(from + 8 * pair), r.factors), f32x8);
            weight *= all8(image->scale);
            if (merged) {
                f32x8 through = all8(1.0f) - smaller8(weight * all8(0.25f), all8(1.0f));
                through *= through;
                weight = all8(1.0f) - through * through;
            }
            weight *= all8(1.0f) - to[pair].coverage;
            to[pair].light += weight * color;
            to[pair].coverage += weight;
        }
    }
}
