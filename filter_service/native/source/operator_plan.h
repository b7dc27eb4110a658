/* Plan of the splat of a frame as a linear operator of its colors; see operator.h.
 *
 * Distances, kernels and shares of depths do not change, so that the image is a sum over the
 * parts of each bin: the light of some clusters, times a factor of each pixel.  A bin in which
 * order does not matter has one part, whose factor is the reciprocal of the coverage.
 * Otherwise each group of depths is a part.  The factors are computed once, with the functions
 * of depths.h and picture.h that a frame uses. */

#include <math.h>

#include "frame.h"
#include "vectors.h"

/* Rows of a bin in vectors of eight: red, green and blue of its pixels, one after another. */
#define ROW_FLOATS (RGB * BIN_WIDTH)

/* Vectors of a row whose sums are kept in registers, and the texels of zeros that the rows of
 * a kernel need, which may only touch them. */
#define COLUMN_VECTORS 6
#define PACKED_GAP_TEXELS (8 * COLUMN_VECTORS / RGB)

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
    float *factors;           /* of the rows of all parts: ROW_FLOATS in each */
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
    size_t *first_word;       /* of each kernel */
    uint32_t *words;          /* of kernels: those of colors, without the means */
    int failed;               /* out of memory */
} operator_plan;

/* Words from one row of a kernel to the next. */
INLINE ptrdiff_t packed_row(const level_image *image) {
    return RGB * (ptrdiff_t)(image->width + PACKED_GAP_TEXELS);
}

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
    size_t needed = (size_t)(bottom - top) * ROW_FLOATS;
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

/* Writes the colors of two pixels. */
INLINE void store_pair(float *to, f32x8 pair) {
    for (int c = 0; c < RGB; ++c) {
        to[c] = pair[c];
        to[RGB + c] = pair[4 + c];
    }
}

INLINE f32x8 load_pair(const float *from) {
    return (f32x8){from[0], from[1], from[2], 0.0f, from[3], from[4], from[5], 0.0f};
}

/* Writes the shares that nearer depths leave of the open group, before it is closed. */
static void write_shares(const window *w, const bin_part *part, float *to) {
    for (int i = part->top * PAIRS_ACROSS; i < part->bottom * PAIRS_ACROSS; ++i) {
        f32x8 most = larger8(w->open.sizes[0].pairs[i].coverage, all8(MIN_COVERAGE));
        f32x8 room = all8(1.0f) - w->near[i].coverage;
        store_pair(to, smaller8(room / most, all8(1.0f)));
        to += 2 * RGB;
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
        for (int x = 0; x < BIN_WIDTH; x += 2, shares += 2 * RGB) {
            int pair = y * PAIRS_ACROSS + x / 2;
            f32x8 by_depth, all, factor = all8(0.0f);
            mixed_shares(result, x, y, &by_depth, &all);
            if (result->near != NULL)
                factor = by_depth * load_pair(shares) * per_coverage(result->near[pair].coverage);
            if (!is_hidden) factor += all * per_coverage(result->total[pair].coverage);
            store_pair(to + (y - top) * ROW_FLOATS + x * RGB, factor);
            if (is_dark8(factor)) continue;
            first_row = smaller_int(first_row, y);
            last_row = y + 1;
        }
    }
    if (first_row >= last_row) return;
    size_t floats = (size_t)(last_row - first_row) * ROW_FLOATS;
    memmove(to, to + (size_t)(first_row - top) * ROW_FLOATS, floats * sizeof *to);
    part.top = first_row;
    part.bottom = last_row;
    part.first_factor = *count;
    bin->parts[bin->part_count++] = part;
    *count += floats;
}

/* Writes the shares of pixels' own color, where coverage is missing; false if memory ran
 * out. */
static int write_own(const bin_result *result, bin_plan *bin) {
    float own[BIN_HEIGHT * ROW_FLOATS];
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
            store_pair(own + y * ROW_FLOATS + x * RGB, share);
            any |= !is_dark8(share);
        }
    if (!any) return 1;
    bin->own = malloc(sizeof own);
    if (bin->own == NULL) return 0;
    memcpy(bin->own, own, sizeof own);
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
    bin->weighted = aligned_alloc(32, sizeof *factors * (count + 8));
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

/* Copies the kernels of fragments, which are not merged, without the means; false if memory
 * ran out. */
static int pack_kernels(const frame *f, operator_plan *plan) {
    size_t count = RGB * PACKED_GAP_TEXELS;
    plan->first_word = malloc(sizeof *plan->first_word * (size_t)(f->kernel_count + 1));
    if (plan->first_word == NULL) return 0;
    for (int k = 0; k < f->kernel_count; ++k) {
        plan->first_word[k] = count;
        const level_image *image = f->kernels[k].level;
        if (f->shapes[k].levels_used & 1) count += (size_t)(packed_row(image) * image->height);
    }
    plan->words = calloc(count + 8, sizeof *plan->words);
    if (plan->words == NULL) return 0;
    for (int k = 0; k < f->kernel_count; ++k) {
        if (!(f->shapes[k].levels_used & 1)) continue;
        const level_image *image = f->kernels[k].level;
        const uint32_t *from = f->kernel_texels + 4 * (size_t)image->first_texel;
        uint32_t *to = plan->words + plan->first_word[k];
        for (int y = 0; y < image->height; ++y) {
            for (int x = 0; x < image->width; ++x)
                memcpy(to + RGB * x, from + 4 * x, RGB * sizeof *to);
            from += 4 * row_texels(image);
            to += packed_row(image);
        }
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
    free(plan->first_word);
    free(plan->words);
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
        failed = plan->failed || !list_places(f, plan) || !pack_kernels(f, plan);
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
