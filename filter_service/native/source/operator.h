/* The splat of a frame as a linear operator of its colors, and the adjoint of that operator.
 *
 * Distances, kernels and shares of depths do not change, so that the image is a sum over the
 * parts of each bin: the light of some clusters, times a factor of each pixel.  A bin in which
 * order does not matter has one part, whose factor is the reciprocal of the coverage.
 * Otherwise each group of depths is a part.  The factors are computed once, with the functions
 * of depths.h and picture.h that a frame uses.
 *
 * The adjoint gathers: each pixel of the input sums the parts' pixels that it lights, times
 * the same weights.  A single thread sums a row of blocks, in the order of its clusters and of
 * their bins.  Twin: tests/numerical/test_operator.py, which compares whole matrices. */

#include <math.h>

#include "frame.h"
#include "vectors.h"

#define PAIR_FLOATS 8

/* Clusters of a bin whose light is multiplied by common factors. */
typedef struct {
    int first, end;           /* in the clusters of the bin */
    int32_t group;            /* of depths, or ALL_GROUPS */
    int top, bottom;          /* rows of the bin with factors */
    size_t first_factor;      /* floats */
} bin_part;

typedef struct {
    uint32_t *clusters;
    bin_part *parts;
    float *factors;           /* of the rows of all parts: PAIRS_ACROSS pairs in each */
    float *weighted;          /* in the adjoint: the image times the factors */
    float *own;               /* share of each pixel's own color; NULL if there is none */
    int part_count;
} bin_plan;

typedef struct { uint32_t bin, part; } part_place;

typedef struct {
    int columns, rows;        /* of bins */
    bin_plan *bins;
    uint32_t *first_place;    /* of each cluster, and the end of the last */
    part_place *places;       /* of the parts that clusters light */
    int failed;               /* out of memory */
} operator_plan;

/* Scratch of one thread: the parts of a bin before their factors are known. */
typedef struct {
    bin_list list;
    bin_part *parts;
    int part_count, part_room;
    float *shares;            /* as factors: what nearer depths leave of a group's light */
    size_t share_count, share_room;
} bin_draft;

typedef struct {
    const frame *f;
    operator_plan *plan;
    bin_draft *drafts;        /* one per thread */
    const float *color;       /* (surface_count, image_height, image_width, 3) */
    const float *image;       /* (image_height, image_width, 3) */
    float *to;                /* image or color */
    float *lights;            /* color with the border of the frame */
} operator_job;

/* Appends a part with room for its shares; NULL if memory ran out. */
static bin_part *new_part(bin_draft *draft, int top, int bottom) {
    if (draft->part_count == draft->part_room) {
        int room = 2 * draft->part_room + 16;
        bin_part *grown = realloc(draft->parts, sizeof *grown * (size_t)room);
        if (grown == NULL) return NULL;
        draft->parts = grown;
        draft->part_room = room;
    }
    size_t needed = (size_t)(bottom - top) * PAIRS_ACROSS * PAIR_FLOATS;
    if (draft->share_count + needed > draft->share_room) {
        size_t room = 2 * (draft->share_count + needed);
        float *grown = realloc(draft->shares, sizeof *grown * room);
        if (grown == NULL) return NULL;
        draft->shares = grown;
        draft->share_room = room;
    }
    bin_part *part = draft->parts + draft->part_count++;
    *part = (bin_part){.top = top, .bottom = bottom, .first_factor = draft->share_count};
    draft->share_count += needed;
    return part;
}

/* Writes the shares that nearer depths leave of the open group, before it is closed. */
static void write_shares(const window *w, const bin_part *part, float *to) {
    for (int i = part->top * PAIRS_ACROSS; i < part->bottom * PAIRS_ACROSS; ++i) {
        f32x8 most = larger8(w->open.sizes[0].pairs[i].coverage, all8(MIN_COVERAGE));
        f32x8 room = all8(1.0f) - w->near[i].coverage;
        store8(to, smaller8(room / most, all8(1.0f)));
        to += PAIR_FLOATS;
    }
}

/* Drafts a part for each group of depths of a bin in which order matters, as splat_ordered;
 * false if memory ran out. */
static int draft_groups(const frame *f, bin_draft *draft, window *w) {
    bin_list *list = &draft->list;
    if (!list_groups(f, list)) return 0;
    sort_list(list);
    open_order(w);
    int state = SEEN;
    for (int i = 0; i < list->count && state != UNSEEN;) {
        int first = i;
        uint32_t key = list->keys[i];
        int32_t group = list->first_group + (int32_t)key;
        for (; i < list->count && list->keys[i] == key; ++i)
            add_cluster(f, list->entries[i], group, &w->open);
        const raster *open = w->open.sizes;
        if (open->top >= open->bottom) continue;
        bin_part *part = new_part(draft, open->top, open->bottom);
        if (part == NULL) return 0;
        part->first = first;
        part->end = i;
        part->group = group;
        float *shares = draft->shares + part->first_factor;
        if (state == SEEN) {
            write_shares(w, part, shares);
            state = close_group(w, &w->open);
        } else {
            memset(shares, 0, (draft->share_count - part->first_factor) * sizeof *shares);
            add_total(w, &w->open);
        }
    }
    return 1;
}

/* Reciprocals of coverage, and 0 without coverage. */
INLINE f32x8 per_coverage(f32x8 coverage) {
    f32x8 least = all8(MIN_COVERAGE);
    i32x8 counts = (coverage >= least) & (i32x8){-1, -1, -1, 0, -1, -1, -1, 0};
    return (f32x8)((i32x8)(all8(1.0f) / larger8(coverage, least)) & counts);
}

/* Sums of a bin from which the factors of its parts follow. */
typedef struct {
    const pixel_pair *near, *total;   /* near is NULL if order does not matter */
    int left, right, top, bottom;     /* pixels of the bin within the image */
} bin_result;

/* Parts of the light by depths and of the light of all depths, as in mixed_light; 0 outside
 * the image. */
INLINE void mixed_shares(const bin_result *result, int x, int y, f32x8 *by_depth, f32x8 *all) {
    const pixel_pair *total = result->total + y * PAIRS_ACROSS + x / 2;
    float share[2], rest[2];
    for (int pixel = 0; pixel < 2; ++pixel) {
        int column = x + pixel;
        int is_inside = column >= result->left && column < result->right && y >= result->top
                        && y < result->bottom;
        share[pixel] = rest[pixel] = 0.0f;
        if (!is_inside) continue;
        if (result->near != NULL)
            share[pixel] = smaller_float(
                total->light[3 + 4 * pixel] * (1.0f / EDGE_MIX_COVERAGE), 1.0f);
        rest[pixel] = 1.0f - share[pixel];
    }
    *by_depth = (f32x8){share[0], share[0], share[0], share[0],
                        share[1], share[1], share[1], share[1]};
    *all = (f32x8){rest[0], rest[0], rest[0], rest[0], rest[1], rest[1], rest[1], rest[1]};
}

INLINE int is_dark8(f32x8 value) { return !any8(value != all8(0.0f)); }

/* Writes the factors of a drafted part, or of those of its clusters that are hidden, which
 * only count by depth; leaves out rows in which all are 0. */
static void write_factors(const bin_result *result, const bin_draft *draft, bin_part part,
                          int is_hidden, bin_plan *bin, size_t *count) {
    const float *shares = draft->shares + part.first_factor;
    int top = part.top, first_row = part.bottom, last_row = part.top;
    float *to = bin->factors + *count;
    for (int y = part.top; y < part.bottom; ++y) {
        for (int x = 0; x < BIN_WIDTH; x += 2, shares += PAIR_FLOATS) {
            int pair = y * PAIRS_ACROSS + x / 2;
            f32x8 by_depth, all, factor = all8(0.0f);
            mixed_shares(result, x, y, &by_depth, &all);
            if (result->near != NULL)
                factor = by_depth * load8(shares) * per_coverage(result->near[pair].coverage);
            if (!is_hidden) factor += all * per_coverage(result->total[pair].coverage);
            store8(to + ((y - top) * PAIRS_ACROSS + x / 2) * PAIR_FLOATS, factor);
            if (is_dark8(factor)) continue;
            first_row = smaller_int(first_row, y);
            last_row = y + 1;
        }
    }
    if (first_row >= last_row) return;
    size_t row_floats = PAIRS_ACROSS * PAIR_FLOATS;
    size_t floats = (size_t)(last_row - first_row) * row_floats;
    memmove(to, to + (size_t)(first_row - top) * row_floats, floats * sizeof *to);
    part.top = first_row;
    part.bottom = last_row;
    part.first_factor = *count;
    bin->parts[bin->part_count++] = part;
    *count += floats;
}

/* Writes the shares of pixels' own color, where coverage is missing; false if memory ran
 * out. */
static int write_own(const bin_result *result, bin_plan *bin) {
    size_t count = BIN_HEIGHT * PAIRS_ACROSS * PAIR_FLOATS;
    float own[BIN_HEIGHT * PAIRS_ACROSS * PAIR_FLOATS];
    int any = 0;
    for (int y = 0; y < BIN_HEIGHT; ++y)
        for (int x = 0; x < BIN_WIDTH; x += 2) {
            int pair = y * PAIRS_ACROSS + x / 2;
            i32x8 is_color = {-1, -1, -1, 0, -1, -1, -1, 0};
            f32x8 by_depth, all, least = all8(MIN_COVERAGE);
            mixed_shares(result, x, y, &by_depth, &all);
            i32x8 lacks = (result->total[pair].coverage < least) & is_color;
            f32x8 share = (f32x8)((i32x8)all & lacks);
            if (result->near != NULL) {
                lacks = (result->near[pair].coverage < least) & is_color;
                share += (f32x8)((i32x8)by_depth & lacks);
            }
            store8(own + pair * PAIR_FLOATS, share);
            any |= !is_dark8(share);
        }
    if (!any) return 1;
    bin->own = malloc(sizeof own);
    if (bin->own == NULL) return 0;
    memcpy(bin->own, own, count * sizeof *own);
    return 1;
}

/* Writes the parts of a bin; if hidden clusters only count by depth, they get parts of their
 * own.  False if memory ran out. */
static int write_parts(const frame *f, const bin_result *result, const bin_draft *draft,
                       const uint32_t *entries, int entry_count, int splits_hidden,
                       bin_plan *bin) {
    size_t ways = splits_hidden ? 2 : 1, parts = ways * (size_t)draft->part_count, count = 0;
    bin->clusters = malloc(sizeof *entries * (size_t)(entry_count + 1));
    bin->parts = malloc(sizeof *bin->parts * (parts + 1));
    bin->factors = malloc(sizeof *bin->factors * (ways * draft->share_count + 1));
    if (bin->clusters == NULL || bin->parts == NULL || bin->factors == NULL) return 0;
    memcpy(bin->clusters, entries, sizeof *entries * (size_t)entry_count);
    for (int i = 0; i < draft->part_count; ++i) {
        bin_part part = draft->parts[i], hidden = part;
        if (splits_hidden) {
            while (hidden.first < hidden.end && !is_hidden(f, entries[hidden.first]))
                ++hidden.first;
            part.end = hidden.first;
        }
        if (part.first < part.end) write_factors(result, draft, part, 0, bin, &count);
        if (splits_hidden && hidden.first < hidden.end)
            write_factors(result, draft, hidden, 1, bin, &count);
    }
    float *factors = realloc(bin->factors, sizeof *factors * (count + 1));
    if (factors != NULL) bin->factors = factors;
    /* Aligned, as loads of pairs across cache lines take twice as long. */
    bin->weighted = aligned_alloc(32, sizeof *factors * (count + PAIR_FLOATS));
    return bin->weighted != NULL && write_own(result, bin);
}

/* Plans a bin; false if memory ran out. */
static int plan_bin(const frame *f, bin_draft *draft, const bin_result *inside, bin_plan *bin) {
    bin_list *list = &draft->list;
    bin_result result = *inside;
    bin_sums s;
    window w = open_window(list->x0, list->y0, &s);
    draft->part_count = 0;
    draft->share_count = 0;
    int64_t fragments = list_clusters(f, list);
    if (fragments < 0) return 0;
    if (fragments > 0 && list->any_edge) {
        if (!draft_groups(f, draft, &w)) return 0;
        int splits_hidden = list->any_hidden && is_mixed(&w);
        if (splits_hidden) {
            splat_unordered(f, list, 0, &w);
            w.total = w.open.sizes[0].pairs;
        }
        result.near = w.near;
        result.total = w.total;
        return write_parts(f, &result, draft, list->entries, list->count, splits_hidden, bin);
    }
    splat_unordered(f, list, 1, &w);
    result.total = w.open.sizes[0].pairs;
    bin_part *part = new_part(draft, 0, BIN_HEIGHT);
    if (part == NULL) return 0;
    part->end = list->cluster_count;
    part->group = ALL_GROUPS;
    return write_parts(f, &result, draft, list->clusters, list->cluster_count, 0, bin);
}

/* Pixels of a bin within the image. */
INLINE bin_result inside_of(const frame *f, int x0, int y0) {
    return (bin_result){
        .left = larger_int(f->border_px - x0, 0),
        .right = smaller_int(f->border_px + f->image_width - x0, BIN_WIDTH),
        .top = larger_int(f->border_px - y0, 0),
        .bottom = smaller_int(f->border_px + f->image_height - y0, BIN_HEIGHT)};
}

/* Item: one bin. */
static void plan_bin_item(void *argument, int item, int thread) {
    operator_job *job = argument;
    operator_plan *plan = job->plan;
    bin_draft *draft = job->drafts + thread;
    draft->list.x0 = item % plan->columns * BIN_WIDTH;
    draft->list.y0 = item / plan->columns * BIN_HEIGHT;
    bin_result inside = inside_of(job->f, draft->list.x0, draft->list.y0);
    if (inside.left >= inside.right || inside.top >= inside.bottom) return;
    if (!plan_bin(job->f, draft, &inside, plan->bins + item))
        __atomic_store_n(&plan->failed, 1, __ATOMIC_RELAXED);
}

/* Lists the parts that each cluster lights, in the order of bins; false if memory ran out. */
static int list_places(const frame *f, operator_plan *plan) {
    size_t clusters = (size_t)f->surface_count * (size_t)f->block_rows
                      * (size_t)f->block_columns * (size_t)f->block_slots;
    int bins = plan->columns * plan->rows;
    uint32_t *first = plan->first_place = calloc(clusters + 2, sizeof *first);
    if (first == NULL) return 0;
    for (int pass = 0; pass < 2; ++pass) {
        for (int item = 0; item < bins; ++item) {
            const bin_plan *bin = plan->bins + item;
            for (int k = 0; k < bin->part_count; ++k)
                for (int i = bin->parts[k].first; i < bin->parts[k].end; ++i) {
                    uint32_t at = bin->clusters[i];
                    if (pass == 0) ++first[at + 2];
                    else plan->places[first[at + 1]++] =
                             (part_place){(uint32_t)item, (uint32_t)k};
                }
        }
        if (pass == 1) break;
        for (size_t at = 2; at < clusters + 2; ++at) first[at] += first[at - 1];
        plan->places = malloc(sizeof *plan->places * ((size_t)first[clusters + 1] + 1));
        if (plan->places == NULL) return 0;
    }
    return 1;
}

/* Frees a plan. */
static void end_operator(int64_t address) {
    operator_plan *plan = (operator_plan *)(intptr_t)address;
    for (int item = 0; plan->bins != NULL && item < plan->columns * plan->rows; ++item) {
        bin_plan *bin = plan->bins + item;
        free(bin->clusters);
        free(bin->parts);
        free(bin->factors);
        free(bin->weighted);
        free(bin->own);
    }
    free(plan->bins);
    free(plan->first_place);
    free(plan->places);
    free(plan);
}

/* Plans the operator of a frame whose fragments are not merged and whose kernels are blended;
 * returns the address of the plan, which end_operator frees, or 0 if memory ran out. */
static int64_t new_operator(frame *f) {
    int n_threads = pool_size(f->threads);
    operator_plan *plan = calloc(1, sizeof *plan);
    bin_draft *drafts = calloc((size_t)n_threads, sizeof *drafts);
    if (plan != NULL) {
        plan->columns = (f->width + BIN_WIDTH - 1) / BIN_WIDTH;
        plan->rows = (f->height + BIN_HEIGHT - 1) / BIN_HEIGHT;
        plan->bins = calloc((size_t)(plan->columns * plan->rows), sizeof *plan->bins);
    }
    int failed = plan == NULL || drafts == NULL || plan->bins == NULL;
    if (!failed) {
        operator_job job = {.f = f, .plan = plan, .drafts = drafts};
        pool_run(f->threads, f->surface_count * f->block_rows, set_factors, f);
        pool_run(f->threads, plan->columns * plan->rows, plan_bin_item, &job);
        failed = plan->failed || !list_places(f, plan);
        for (int thread = 0; thread < n_threads; ++thread) {
            free_list(&drafts[thread].list);
            free(drafts[thread].parts);
            free(drafts[thread].shares);
        }
    }
    free(drafts);
    if (failed && plan != NULL) end_operator((int64_t)(intptr_t)plan);
    return failed ? 0 : (int64_t)(intptr_t)plan;
}

INLINE float finite_or_0(float value) { return isfinite(value) ? value : 0.0f; }

/* Item: a row of blocks.  Sets the light of fragments to their color, or to 1 if there is none,
 * times their coverage. */
static void set_lights(void *argument, int row, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const block_info *blocks = f->blocks + row * f->block_columns;
    int64_t first_row = (int64_t)(row / f->block_rows) * f->image_height;
    for (uint32_t at = blocks->first; at < blocks[f->block_columns - 1].end; ++at) {
        const fragment *one = f->fragments + at;
        float coverage = one->state & SPECIAL_BIT ? f->extras[at].coverage : 1.0f;
        float *rgb = f->lights[at].rgb;
        if (job->color == NULL) {
            for (int c = 0; c < RGB; ++c) rgb[c] = coverage;
            continue;
        }
        int x = clamped_int(one->x - f->border_px, 0, f->image_width - 1);
        int y = clamped_int(one->y - f->border_px, 0, f->image_height - 1);
        const float *color = job->color + RGB * ((first_row + y) * f->image_width + x);
        for (int c = 0; c < RGB; ++c) rgb[c] = coverage * finite_or_0(color[c]);
    }
}

/* Pixels of a bin within the image, with the first pixel of a row of them. */
INLINE size_t first_pixel(const frame *f, const bin_result *inside, int x0, int y0, int y) {
    return RGB * ((size_t)(y0 + y - f->border_px) * (size_t)f->image_width
                  + (size_t)(x0 + inside->left - f->border_px));
}

/* Pixels of a part that a member lights. */
typedef struct {
    int rows;                 /* their number; none if not positive */
    int first, last;          /* pairs, the last plus one */
    size_t start;             /* floats of the part before the first row */
    const uint32_t *texels;   /* of the first row at pair 0, which may be outside the kernel */
    ptrdiff_t stride;         /* words */
} footprint;

INLINE footprint footprint_of(const frame *f, const member *one, const level_image *image,
                              const bin_part *part) {
    int row = larger_int(one->top, part->top);
    ptrdiff_t stride = 4 * (ptrdiff_t)row_texels(image);
    return (footprint){
        .rows = smaller_int(one->top + image->height, part->bottom) - row,
        .first = larger_int(one->left, 0) / 2,
        .last = smaller_int((one->left + image->width + 1) / 2, PAIRS_ACROSS),
        .start = (size_t)(row - part->top) * PAIRS_ACROSS * PAIR_FLOATS,
        .texels = f->kernel_texels + 4 * (size_t)image->first_texel + row * stride
                  + 4 * (ptrdiff_t)one->from,
        .stride = stride};
}

/* The compiler generates a loop for each number of pairs: CASE(n), up to PAIRS_ACROSS. */
#define EACH_WIDTH                                                                           \
    CASE(1) CASE(2) CASE(3) CASE(4) CASE(5) CASE(6) CASE(7) CASE(8) CASE(9) CASE(10)         \
    CASE(11) CASE(12) CASE(13) CASE(14) CASE(15) CASE(16)

/* Weights of a kernel at a pair of pixels, in steps. */
INLINE f32x8 weight_of(const uint32_t *texels, i32x8 factors) {
    return __builtin_convertvector(pair_sums(read_pairs(texels), factors), f32x8);
}

/* Adds a color to rows of `pairs` adjacent pairs of pixels, times the weights of a kernel. */
INLINE void scatter_columns(const uint32_t *texels, ptrdiff_t stride, float *light, int rows,
                            i32x8 factors, f32x8 color, int pairs) {
    for (int row = 0; row < rows; ++row) {
        for (int p = 0; p < pairs; ++p) {
            float *to = light + PAIR_FLOATS * p;
            store8(to, load8(to) + weight_of(texels + 8 * p, factors) * color);
        }
        texels += stride;
        light += PAIRS_ACROSS * PAIR_FLOATS;
    }
}

/* Adds the light of a member to a part.  In contrast to add_columns, no pairs beyond the
 * kernel are processed: without coverage, this is faster. */
INLINE void scatter_member(const frame *f, const member *one, const level_image *image,
                           const bin_part *part, float *light) {
    footprint own = footprint_of(f, one, image, part);
    if (own.rows <= 0 || own.first >= own.last) return;
    light += own.start;
    i32x8 factors = all_ints8(one->factors);
    f32x8 color = twice4(one->color);
    const uint32_t *from = own.texels + 8 * own.first;
    light += PAIR_FLOATS * own.first;
#define CASE(n) \
    case n: scatter_columns(from, own.stride, light, own.rows, factors, color, n); break;
    switch (own.last - own.first) { EACH_WIDTH default: break; }
#undef CASE
}

/* Adds the light of a part's clusters to its rows. */
static void scatter_part(const frame *f, const bin_plan *bin, const bin_part *part, int x0,
                         int y0, float *light) {
    raster window_of = {.x0 = x0, .y0 = y0};
    for (int i = part->first; i < part->end; ++i) {
        const cluster *own = f->clusters + bin->clusters[i];
        const level_image *image = image_of(f, own->state);
        members all;          /* is not cleared */
        list_members(f, own, part->group, image, &window_of, &all);
        for (const member *one = all.of; one < all.of + all.count; ++one)
            scatter_member(f, one, image, part, light);
    }
}

/* Item: one bin of the image. */
static void apply_bin(void *argument, int item, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const bin_plan *bin = job->plan->bins + item;
    int x0 = item % job->plan->columns * BIN_WIDTH, y0 = item / job->plan->columns * BIN_HEIGHT;
    bin_result inside = inside_of(f, x0, y0);
    if (inside.left >= inside.right || inside.top >= inside.bottom) return;
    float sums[BIN_HEIGHT * PAIRS_ACROSS * PAIR_FLOATS] = {0};
    _Alignas(32) float light[BIN_HEIGHT * PAIRS_ACROSS * PAIR_FLOATS];
    for (const bin_part *part = bin->parts; part < bin->parts + bin->part_count; ++part) {
        size_t count = (size_t)(part->bottom - part->top) * PAIRS_ACROSS * PAIR_FLOATS;
        const float *factors = bin->factors + part->first_factor;
        float *sum = sums + part->top * PAIRS_ACROSS * PAIR_FLOATS;
        memset(light, 0, count * sizeof *light);
        scatter_part(f, bin, part, x0, y0, light);
        for (size_t i = 0; i < count; i += PAIR_FLOATS)
            store8(sum + i, load8(sum + i) + load8(factors + i) * load8(light + i));
    }
    for (int y = inside.top; y < inside.bottom; ++y) {
        size_t first = first_pixel(f, &inside, x0, y0, y);
        for (int x = inside.left; x < inside.right; ++x)
            for (int c = 0; c < RGB; ++c) {
                size_t at = first + RGB * (size_t)(x - inside.left) + (size_t)c;
                int from = (y * BIN_WIDTH + x) * 4 + c;
                job->to[at] = sums[from];
                if (bin->own != NULL) job->to[at] += bin->own[from] * finite_or_0(job->color[at]);
            }
    }
}

/* Writes the image (image_height, image_width, 3) of colors (surface_count, image_height,
 * image_width, 3). */
static void apply_operator(frame *f, int64_t address, const float *color, float *image) {
    operator_plan *plan = (operator_plan *)(intptr_t)address;
    operator_job job = {.f = f, .plan = plan, .color = color, .to = image};
    pool_run(f->threads, f->surface_count * f->block_rows, set_lights, &job);
    pool_run(f->threads, plan->columns * plan->rows, apply_bin, &job);
}

/* Item: one bin.  Multiplies the image by the factors of the parts. */
static void weigh_bin(void *argument, int item, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const bin_plan *bin = job->plan->bins + item;
    if (bin->part_count == 0) return;
    int x0 = item % job->plan->columns * BIN_WIDTH, y0 = item / job->plan->columns * BIN_HEIGHT;
    bin_result inside = inside_of(f, x0, y0);
    float seen[BIN_HEIGHT * PAIRS_ACROSS * PAIR_FLOATS] = {0};
    for (int y = inside.top; y < inside.bottom; ++y) {
        const float *from = job->image + first_pixel(f, &inside, x0, y0, y);
        float *to = seen + (y * BIN_WIDTH + inside.left) * 4;
        for (int x = inside.left; x < inside.right; ++x, from += RGB, to += 4)
            for (int c = 0; c < RGB; ++c) to[c] = finite_or_0(from[c]);
    }
    for (const bin_part *part = bin->parts; part < bin->parts + bin->part_count; ++part) {
        const float *factors = bin->factors + part->first_factor;
        float *to = bin->weighted + part->first_factor;
        for (int i = part->top * PAIRS_ACROSS; i < part->bottom * PAIRS_ACROSS; ++i) {
            store8(to, load8(factors) * load8(seen + i * PAIR_FLOATS));
            factors += PAIR_FLOATS;
            to += PAIR_FLOATS;
        }
    }
}

/* Sums rows of `pairs` adjacent pairs of pixels, times the weights of a kernel. */
INLINE f32x8 gather_columns(const uint32_t *texels, ptrdiff_t stride, const float *weighted,
                            int rows, i32x8 factors, int pairs) {
    /* Several sums, because additions wait for those before them. */
    f32x8 sums[4] = {all8(0.0f), all8(0.0f), all8(0.0f), all8(0.0f)};
    int row = 0;
    for (int step = pairs > 2 ? 1 : 2; row + step <= rows; row += step)
        for (int n = 0; n < step; ++n) {
            for (int p = 0; p < pairs; ++p)
                sums[(n * pairs + p) % 4] += weight_of(texels + 8 * p, factors)
                                             * load8(weighted + PAIR_FLOATS * p);
            texels += stride;
            weighted += PAIRS_ACROSS * PAIR_FLOATS;
        }
    if (row < rows)
        for (int p = 0; p < pairs; ++p)
            sums[p % 4] += weight_of(texels + 8 * p, factors) * load8(weighted + PAIR_FLOATS * p);
    sums[0] += sums[1];
    sums[2] += sums[3];
    sums[0] += sums[2];
    return sums[0];
}

/* Returns the light of a part that a member receives, of each color. */
INLINE f32x4 gather_member(const frame *f, const member *one, const level_image *image,
                           const bin_part *part, const float *weighted) {
    footprint own = footprint_of(f, one, image, part);
    f32x8 sum = all8(0.0f);
    if (own.rows <= 0 || own.first >= own.last) return all4(0.0f);
    weighted += own.start;
    i32x8 factors = all_ints8(one->factors);
    const uint32_t *from = own.texels + 8 * own.first;
    weighted += PAIR_FLOATS * own.first;
#define CASE(n) \
    case n: sum = gather_columns(from, own.stride, weighted, own.rows, factors, n); break;
    switch (own.last - own.first) { EACH_WIDTH default: break; }
#undef CASE
    f32x4 low = {sum[0], sum[1], sum[2], sum[3]}, high = {sum[4], sum[5], sum[6], sum[7]};
    return (low + high) * one->color;
}

/* Item: a row of blocks.  Sums the light of all parts that its fragments light. */
static void gather_row(void *argument, int row, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    const operator_plan *plan = job->plan;
    const block_info *blocks = f->blocks + row * f->block_columns;
    int surface = row / f->block_rows, y0 = row % f->block_rows * TILE_SIZE_PX;
    int height = smaller_int(TILE_SIZE_PX, f->height - y0);
    float *lights = job->lights + RGB * (size_t)surface * (size_t)f->width * (size_t)f->height;
    memset(lights + RGB * (size_t)y0 * (size_t)f->width, 0,
           RGB * (size_t)height * (size_t)f->width * sizeof *lights);
    uint32_t end = blocks[f->block_columns - 1].end_cluster;
    for (uint32_t at = blocks->first_cluster; at < end; ++at) {
        const cluster *own = f->clusters + at;
        const level_image *image = image_of(f, own->state);
        for (uint32_t k = plan->first_place[at]; k < plan->first_place[at + 1]; ++k) {
            part_place place = plan->places[k];
            const bin_plan *bin = plan->bins + place.bin;
            const bin_part *part = bin->parts + place.part;
            raster window_of = {.x0 = (int)place.bin % plan->columns * BIN_WIDTH,
                                .y0 = (int)place.bin / plan->columns * BIN_HEIGHT};
            members all;      /* is not cleared */
            list_members(f, own, part->group, image, &window_of, &all);
            for (const member *one = all.of; one < all.of + all.count; ++one) {
                int x = one->left + image->left + window_of.x0;
                int y = one->top + image->up + window_of.y0;
                f32x4 sum = gather_member(f, one, image, part,
                                          bin->weighted + part->first_factor);
                float *to = lights + RGB * ((size_t)y * (size_t)f->width + (size_t)x);
                for (int c = 0; c < RGB; ++c) to[c] += sum[c];
            }
        }
    }
}

/* Item: a row of a surface's colors.  Sums the pixels of the frame that have its color: also
 * those of the border. */
static void fold_row(void *argument, int row, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const frame *f = job->f;
    int surface = row / f->image_height, y = row % f->image_height, border = f->border_px;
    int top = y == 0 ? 0 : y + border;
    int bottom = y == f->image_height - 1 ? f->height : y + border + 1;
    float *to = job->to + RGB * (size_t)row * (size_t)f->image_width;
    memset(to, 0, RGB * (size_t)f->image_width * sizeof *to);
    for (int from_y = top; from_y < bottom; ++from_y) {
        const float *from = job->lights
                            + RGB * ((size_t)surface * (size_t)f->height + (size_t)from_y)
                                  * (size_t)f->width;
        for (int x = 0; x < f->width; ++x, from += RGB) {
            int own = clamped_int(x - border, 0, f->image_width - 1);
            for (int c = 0; c < RGB; ++c) to[RGB * own + c] += from[c];
        }
    }
}

/* Item: one bin.  Adds the image of pixels that show their own color. */
static void add_own(void *argument, int item, int thread) {
    (void)thread;
    const operator_job *job = argument;
    const float *own = job->plan->bins[item].own;
    if (own == NULL) return;
    int x0 = item % job->plan->columns * BIN_WIDTH, y0 = item / job->plan->columns * BIN_HEIGHT;
    bin_result inside = inside_of(job->f, x0, y0);
    for (int y = inside.top; y < inside.bottom; ++y) {
        size_t first = first_pixel(job->f, &inside, x0, y0, y);
        for (int x = inside.left; x < inside.right; ++x)
            for (int c = 0; c < RGB; ++c) {
                size_t at = first + RGB * (size_t)(x - inside.left) + (size_t)c;
                job->to[at] += own[(y * BIN_WIDTH + x) * 4 + c] * finite_or_0(job->image[at]);
            }
    }
}

/* Writes the adjoint of an image: colors as those of apply_operator.  bordered
 * (surface_count, height, width, 3) is scratch, NULL if the frame has no border. */
static void apply_adjoint(frame *f, int64_t address, const float *image, float *bordered,
                          float *color) {
    operator_plan *plan = (operator_plan *)(intptr_t)address;
    operator_job job = {.f = f, .plan = plan, .image = image, .to = color,
                        .lights = bordered == NULL ? color : bordered};
    int bins = plan->columns * plan->rows;
    pool_run(f->threads, f->surface_count * f->block_rows, set_lights, &job);
    pool_run(f->threads, bins, weigh_bin, &job);
    pool_run(f->threads, f->surface_count * f->block_rows, gather_row, &job);
    if (bordered != NULL)
        pool_run(f->threads, f->surface_count * f->image_height, fold_row, &job);
    pool_run(f->threads, bins, add_own, &job);
}
