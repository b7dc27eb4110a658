/* Addition of fragments to the pixels of a bin, cluster by cluster: a small convolution. */

#include "frame.h"
#include "vectors.h"

INLINE const level_image *image_of(const frame *f, uint32_t state) {
    return f->kernels[state & KERNEL_MASK].level + (state >> LEVEL_SHIFT & 3);
}

/* Item: one row of blocks.  Replaces the fraction of fragments by the shares of both ends of
 * their kernels, in 15 bits. */
static void set_factors(void *argument, int row, int thread) {
    const frame *f = argument;
    const block_info *blocks = f->blocks + row * f->block_columns;
    (void)thread;
    for (uint32_t at = blocks->first_cluster; at < blocks[f->block_columns - 1].end_cluster; ++at) {
        const cluster *own = f->clusters + at;
        const level_image *image = image_of(f, own->state);
        float per_step = image->far_ratio * (1.0f / 65535.0f);
        float near_per_step = image->near_ratio * (1.0f / 65535.0f);
        for (fragment *one = f->fragments + own->first; one < f->fragments + own->first + own->count;
             ++one) {
            int near = (int)((float)(65535 - (int)one->fraction) * near_per_step + 0.5f);
            int far = (int)((float)(int)one->fraction * per_step + 0.5f);
            if (f->has_fine_kernels) {
                near = (int)STEPS_15_BITS;
                far = 1;
            }
            one->fraction = (uint32_t)near | (uint32_t)far << 16;
        }
    }
}

/* Clusters and fragments of the hidden surface follow those of the visible one. */
INLINE int is_hidden(const frame *f, uint32_t index) {
    return index >= (uint32_t)(f->block_rows * f->block_columns * f->block_slots);
}

INLINE i32x8 all_ints8(int32_t value) {
    return (i32x8){value, value, value, value, value, value, value, value};
}

INLINE i32x8 read_pairs(const uint32_t *from) {
    i32x8 pairs;
    memcpy(&pairs, from, sizeof pairs);
    return pairs;
}

/* A fragment as it is added to a raster. */
typedef struct {
    f32x4 color;              /* per step of weight; the fourth lane is the strength of an edge */
    int32_t factors;          /* shares of both ends of its kernel */
    int32_t from;             /* texel of its kernel at the first pixel of the raster, from the
                               * first one of the kernel */
    int32_t top;              /* of its kernel in the raster */
    int32_t left;
} member;

/* Fragments of a cluster that are added to a raster. */
typedef struct {
    int count;
    int is_plain;             /* full coverage, no strength and no excess: without `scales` */
    member of[BLOCK_PIXELS];
    f32x4 scales[BLOCK_PIXELS]; /* coverage per step; the fourth lane is the excess light */
} members;

#define ALL_GROUPS INT32_MIN

/* Share of a fragment that belongs to a group of depths. */
INLINE float share_of_group(const frame *f, uint32_t at, int32_t group) {
    float place = group_place(f, f->lights[at].depth);
    int32_t own = group_of(place);
    if (own == group) return 1.0f - share_behind(place);
    return own == group - 1 ? share_behind(place) : 0.0f;
}

INLINE member member_of(const frame *f, uint32_t at, const level_image *image,
                        const raster *own) {
    const fragment *one = f->fragments + at;
    int r = image->resolution;
    int left = (one->x >> r) - image->left - own->x0, top = (one->y >> r) - image->up - own->y0;
    /* light of up to 1e38 must not be multiplied by whole steps of weight */
    f32x4 color = load4((const float *)(f->lights + at))
                  * (f32x4){image->scale, image->scale, image->scale, 0.0f};
    return (member){color, (int32_t)one->fraction,
                    -left - top * row_texels(image), top, left};
}

/* Returns whether all depths of a cluster belong to one group alone. */
INLINE int is_in_one_group(const frame *f, const cluster *from) {
    float farthest = group_place(f, from->farthest);
    return group_of(group_place(f, from->nearest)) == group_of(farthest)
           && share_behind(farthest) <= 0.0f;
}

/* Lists the fragments of a cluster with a share in a group of depths. */
INLINE void list_members(const frame *f, const cluster *from, int32_t group,
                         const level_image *image, const raster *own, members *all) {
    if (group != ALL_GROUPS && is_in_one_group(f, from)) group = ALL_GROUPS;
    all->is_plain =
        !(from->state & SPECIAL_BIT) && group == ALL_GROUPS && f->blend_shares == NULL;
    if (all->is_plain) {
        all->count = (int)from->count;
        for (int i = 0; i < all->count; ++i)
            all->of[i] = member_of(f, from->first + (uint32_t)i, image, own);
        return;
    }
    all->count = 0;
    for (uint32_t at = from->first; at < from->first + from->count; ++at) {
        float share = group == ALL_GROUPS ? 1.0f : share_of_group(f, at, group);
        if (share <= 0.0f) continue;
        if (f->blend_shares != NULL) share *= f->blend_shares[at];
        member one = member_of(f, at, image, own);
        one.color *= all4(share);
        float weight = share * image->scale;
        f32x4 scales = {weight, weight, weight, 0.0f};
        if (f->fragments[at].state & SPECIAL_BIT) {
            const fragment_extra *extra = f->extras + at;
            float coverage = weight * extra->coverage;
            one.color += (f32x4){0.0f, 0.0f, 0.0f, weight * extra->strength};
            scales = (f32x4){coverage, coverage, coverage, weight * extra->excess};
        }
        all->scales[all->count] = scales;
        all->of[all->count++] = one;
    }
}

/* Keeps the members that touch columns of a raster; returns their number. */
static int keep_touching(const members *all, int first, int end, int width, members *to) {
    int count = 0;
    for (int i = 0; i < all->count; ++i) {
        to->of[count] = all->of[i];
        if (!all->is_plain) to->scales[count] = all->scales[i];
        count += all->of[i].left < end && all->of[i].left + width > first;
    }
    return count;
}

#define COLUMN_PAIRS 4
#define PREFETCHED_ROWS 3

/* Prefetches what a member reads in a row of a kernel: three cache lines at most. */
INLINE void prefetch_row(const uint32_t *texels) {
    const char *from = (const char *)texels;
    for (int n = 0; n < 3; ++n) __builtin_prefetch(from + 64 * n);
}

/* What members add besides light: coverage without or with `scales`. */
enum { PLAIN_COVERAGE, SCALED_COVERAGE };

/* Adds members to `pairs` adjacent pairs of pixels, row by row: the sums of a row stay in
 * registers.  The compiler generates a loop for each number of pairs. */
INLINE void add_columns(const frame *f, const members *all, int count, const level_image *image,
                        raster *own, int pair, int pairs, int kind) {
    ptrdiff_t stride = 4 * (ptrdiff_t)row_texels(image);
    const member *one = all->of, *end = all->of, *last = all->of + count;
    int row = larger_int(one->top, 0);
    int last_row = smaller_int(last[-1].top + image->height, own->height);
    const uint32_t *texels =
        f->kernel_texels + 4 * (size_t)image->first_texel + row * stride + 8 * pair;
    pixel_pair *to = own->pairs + row * own->stride + pair;
    f32x8 scales = twice4((f32x4){image->scale, image->scale, image->scale, 0.0f});
    for (; row < last_row; ++row, texels += stride, to += own->stride) {
        while (end < last && end->top <= row) ++end;
        while (one < end && one->top + image->height <= row) ++one;
        f32x8 light[COLUMN_PAIRS], coverage[COLUMN_PAIRS];
        for (int p = 0; p < pairs; ++p) light[p] = coverage[p] = all8(0.0f);
        if (one < end) {
            prefetch_row(texels + PREFETCHED_ROWS * stride + 4 * (ptrdiff_t)one->from);
            prefetch_row(texels + PREFETCHED_ROWS * stride + 4 * (ptrdiff_t)end[-1].from);
        }
        for (const member *next = one; next < end; ++next) {
            const uint32_t *from = texels + 4 * (ptrdiff_t)next->from;
            f32x8 color = load_twice4((const float *)&next->color);
            i32x8 factors = all_ints8(next->factors);
            for (int p = 0; p < pairs; ++p) {
                f32x8 weight = __builtin_convertvector(
                    pair_sums(read_pairs(from + 8 * p), factors), f32x8);
                light[p] += weight * color;
                if (kind == PLAIN_COVERAGE) coverage[p] += weight;
                if (kind == SCALED_COVERAGE) coverage[p] +=
                    weight * load_twice4((const float *)(all->scales + (next - all->of)));
            }
        }
        for (int p = 0; p < pairs; ++p) {
            to[p].light += light[p];
            if (kind == PLAIN_COVERAGE) to[p].coverage += coverage[p] * scales;
            if (kind == SCALED_COVERAGE) to[p].coverage += coverage[p];
        }
    }
}

/* Adds a cluster to a group of depths; fragments without a share in it are left out. */
static void add_cluster(const frame *f, uint32_t at, int32_t number, depth_group *group) {
    const cluster *from = f->clusters + at;
    const level_image *image = image_of(f, from->state);
    raster *own = group->sizes + image->resolution;
    members all, some;        /* are not cleared */
    list_members(f, from, number, image, own, &all);
    if (all.count == 0) return;
    light_rows(own, all.of[0].top, all.of[all.count - 1].top + image->height);
    int r = image->resolution;
    int leftmost = (from->left >> r) - image->left - own->x0;
    int extent = (1 << (from->state >> LEVEL_SHIFT & 3)) - 1;
    int rightmost = ((from->right - extent) >> r) - image->left - own->x0;
    int left = larger_int(leftmost, 0) / 2;
    int right = smaller_int((rightmost + image->width + 1) / 2, own->width / 2);
    int columns = (right - left + COLUMN_PAIRS - 1) / COLUMN_PAIRS;
    for (int pair = left, pairs; pair < right; pair += pairs, --columns) {
        pairs = (right - pair + columns - 1) / columns;
        int first = 2 * pair, end = first + 2 * pairs, count = all.count;
        const members *touch = &all;
        if (rightmost >= end || leftmost + image->width <= first) {
            count = keep_touching(&all, first, end, image->width, &some);
            touch = &some;
            if (count == 0) continue;
        }
#define CASE(n)                                                                    \
    case n:                                                                        \
        if (all.is_plain)                                                     \
            add_columns(f, touch, count, image, own, pair, n, PLAIN_COVERAGE);     \
        else                                                                       \
            add_columns(f, touch, count, image, own, pair, n, SCALED_COVERAGE);    \
        break;
        switch (pairs) { CASE(1) CASE(2) CASE(3) CASE(4) default: break; }
#undef CASE
    }
}

/* Pairs and rows of a raster that a kernel's box overlaps. */
typedef struct {
    int pair, pairs;          /* first, and count */
    int row, rows;            /* of the kernel */
} meeting;

INLINE meeting meet(const member *one, const level_image *image, const raster *own) {
    int pair = larger_int(one->left, 0) / 2;
    int row = larger_int(-one->top, 0);
    return (meeting){pair, (smaller_int(one->left + image->width, own->width) + 1) / 2 - pair,
                     row, smaller_int(own->height - one->top, image->height) - row};
}

/* The paper's rule: a weight is an opacity; merging has one level, of four pixels. */
INLINE void cover_with_fragment(const frame *f, uint32_t index, const window *w) {
    const fragment *one = f->fragments + index;
    const float *rgb = f->lights[index].rgb;
    const level_image *image = image_of(f, one->state);
    member own = member_of(f, index, image, w->open.sizes);
    meeting m = meet(&own, image, w->open.sizes);
    i32x8 factors = all_ints8(own.factors);
    f32x8 color = {rgb[0], rgb[1], rgb[2], 0.0f, rgb[0], rgb[1], rgb[2], 0.0f};
    int merged = (one->state >> LEVEL_SHIFT & 3) != 0;
    for (int row = m.row; row < m.row + m.rows; ++row) {
        ptrdiff_t texel = (ptrdiff_t)image->first_texel + row * row_texels(image);
        const uint32_t *from = f->kernel_texels + 4 * (texel - own.left + 2 * m.pair);
        pixel_pair *to = w->near + (row + own.top) * PAIRS_ACROSS + m.pair;
        for (int pair = 0; pair < m.pairs; ++pair) {
            f32x8 weight = __builtin_convertvector(
                pair_sums(read_pairs(from + 8 * pair), factors), f32x8);
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
