/* Adds up the light that fragments send to the pixels of a bin, and writes the picture.
 * Twin: splat_tiles, encode_srgb and encode_half of shaders/passes. */

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

/* How a fragment reads its kernel. */
typedef struct {
    const level_image *image;
    i32x8 factors;            /* near and far share of each pair */
    int left, top;            /* first column and row of the kernel in the raster */
} reading;

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

/* Pairs and rows of a raster that a kernel's box meets. */
typedef struct {
    int pair, pairs;          /* first, and how many */
    int row, rows;            /* of the kernel */
} meeting;

INLINE meeting meet(const reading *r, const raster *own) {
    int pair = larger_int(r->left, 0) / 2;
    int row = larger_int(-r->top, 0);
    return (meeting){pair, (smaller_int(r->left + r->image->width, own->width) + 1) / 2 - pair,
                     row, smaller_int(own->height - r->top, r->image->height) - row};
}

/* What a fragment adds to: rows of a raster, and what it adds. */
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

/* Adds one fragment; the compiler makes a loop for each number of pairs. */
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

/* Says what a fragment adds to a window; false where it lights another part of the bin. */
INLINE int prepare_addition(const frame *f, uint32_t index, window *w, addition *a) {
    const fragment *one = f->fragments + index;
    const float *rgb = f->lights[index].rgb;
    const level_image *image = image_of(f, one);
    raster *own = w->open + image->resolution;
    reading r = start_reading(one, image, own);
    meeting m = meet(&r, own);
    if (m.pairs <= 0 || m.rows <= 0) return 0;
    float scale = image->scale;
    float red = scale * rgb[0], green = scale * rgb[1], blue = scale * rgb[2];
    own->is_lit = 1;
    a->to = own->pairs + (m.row + r.top) * own->stride + m.pair;
    a->to_stride = own->stride;
    a->rows = m.rows;
    a->pairs = m.pairs;
    a->from = row_texels(f, &r, m.row) + 8 * m.pair;
    a->from_stride = 4 * (image->width + 1);
    a->factors = r.factors;
    a->color = (f32x8){red, green, blue, 0.0f, red, green, blue, 0.0f};
    a->scales = all8(scale);
    return 1;
}

/* Additions on their way: one waits for another to the same rows. */
typedef struct {
    addition two[2];
    int waiting;              /* 0 or 1 */
} additions;

INLINE void flush_additions(additions *all) {
    if (all->waiting) add_one(all->two);
    all->waiting = 0;
}

INLINE void add_fragment(const frame *f, uint32_t index, window *w, additions *all) {
    addition *newest = all->two + all->waiting;
    if (!prepare_addition(f, index, w, newest)) return;
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

/* The paper's rule: a weight is an opacity; it merges once, four pixels. */
INLINE void cover_with_fragment(const frame *f, uint32_t index, const window *w) {
    const fragment *one = f->fragments + index;
    const float *rgb = f->lights[index].rgb;
    const level_image *image = image_of(f, one);
    reading r = start_reading(one, image, w->open);
    meeting m = meet(&r, w->open);
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

/* Adds the light of pixels of 2^r px to those of 1 px, between the middles of four. */
INLINE void add_coarse(window *w, int r) {
    raster *coarse = w->open + r;
    raster *fine = w->open;
    pixel_pair line[PAIRS_ACROSS / 2 + 1];
    float size = (float)(1 << r);
    for (int y = 0; y < w->height; ++y) {
        float down = ((float)y + 0.5f) / size + 0.5f;
        int row = (int)down;
        f32x8 share = all8(down - (float)row);
        const pixel_pair *above = coarse->pairs + row * coarse->stride;
        const pixel_pair *below = above + coarse->stride;
        for (int x = 0; x < coarse->width / 2; ++x) {
            line[x].light = above[x].light + share * (below[x].light - above[x].light);
            line[x].coverage =
                above[x].coverage + share * (below[x].coverage - above[x].coverage);
        }
        pixel_pair *to = fine->pairs + y * fine->stride;
        for (int x = 0; x < w->width; ++x) {
            float across = ((float)x + 0.5f) / size + 0.5f;
            int column = (int)across;
            f32x4 part = all4(across - (float)column);
            /* light of a pixel, then its neighbour's; coverage lies behind both */
            const float *left = (const float *)(line + column / 2) + 4 * (column & 1);
            const float *right = (const float *)(line + (column + 1) / 2) + 4 * ((column + 1) & 1);
            float *own = (float *)(to + x / 2) + 4 * (x & 1);
            f32x4 light = load4(left), cover = load4(left + 8);
            store4(own, load4(own) + light + part * (load4(right) - light));
            store4(own + 8, load4(own + 8) + cover + part * (load4(right + 8) - cover));
        }
    }
    clear_raster(coarse);
}

/* Brings all light of the open depth to pixels of 1 px. */
static void gather_sizes(window *w) {
    if (w->open[1].is_lit) add_coarse(w, 1);
    if (w->open[2].is_lit) add_coarse(w, 2);
}

/* Adds up a depth; its fragments share what nearer ones leave free.  Returns whether
 * anything is left free. */
static int close_depth(window *w) {
    gather_sizes(w);
    f32x8 least = all8(1.0f);
    for (int y = 0; y < w->height; ++y) {
        pixel_pair *open = w->open[0].pairs + y * PAIRS_ACROSS;
        pixel_pair *near = w->near + y * PAIRS_ACROSS;
        for (int x = 0; x < w->width / 2; ++x) {
            f32x8 most = larger8(open[x].coverage, all8(MIN_COVERAGE));
            f32x8 share = smaller8((all8(1.0f) - near[x].coverage) / most, all8(1.0f));
            near[x].light += share * open[x].light;
            near[x].coverage += share * open[x].coverage;
            least = smaller8(near[x].coverage, least);
            open[x].light = all8(0.0f);
            open[x].coverage = all8(0.0f);
        }
    }
    float lowest = 1.0f;
    for (int i = 0; i < 8; ++i)
        if (i % 4 != 3) lowest = least[i] < lowest ? least[i] : lowest;
    return lowest < 1.0f;
}

INLINE int is_beyond(const frame *f, float depth, float open_depth) {
    return (depth - open_depth) * f->blur_px_per_dpt > DISCONTINUITY_PX;
}

/* Light of a tile where order matters: one depth after the other. */
static void splat_ordered(const frame *f, const bin_list *list, uint32_t tile, window *w) {
    float open_depth = f->lights[list->entries[0].fragment].depth;
    additions all = {.waiting = 0};
    for (int i = 0; i < list->count; ++i) {
        if (!(list->entries[i].tiles & tile)) continue;
        uint32_t index = list->entries[i].fragment;
        if (f->paper_rule) {
            cover_with_fragment(f, index, w);
            continue;
        }
        float depth = f->lights[index].depth;
        if (is_beyond(f, depth, open_depth)) {
            flush_additions(&all);
            if (!close_depth(w)) return;
            open_depth = depth;
        }
        add_fragment(f, index, w, &all);
    }
    flush_additions(&all);
    if (!f->paper_rule) close_depth(w);
}

static void splat_unordered(const frame *f, const bin_list *list, uint32_t tiles,
                            window *w) {
    additions all = {.waiting = 0};
    for (int i = 0; i < list->count; ++i)
        if (list->entries[i].tiles & tiles) add_fragment(f, list->entries[i].fragment, w, &all);
    flush_additions(&all);
    gather_sizes(w);
}

INLINE void write_pixel(const frame *f, size_t at, const float *rgb) {
    for (size_t c = 0; c < RGB; ++c) {
        if (f->output_kind == COLOR_SRGB8)
            ((uint8_t *)f->picture)[3 * at + c] = byte_of_linear(rgb[c]);
        else if (f->output_kind == COLOR_LINEAR)
            ((float *)f->picture)[3 * at + c] = rgb[c];
        else
            ((uint16_t *)f->picture)[3 * at + c] = half_of_float(rgb[c]);
    }
}

/* Light of a pixel that has hardly any: where a colour lacks it, the pixel's own. */
static void fill_in_own(const frame *f, int x, int y, const float *coverage, float *rgb) {
    f32x4 own = pixel_color(f, 0, (size_t)y * (size_t)f->width + (size_t)x);
    for (int c = 0; c < RGB; ++c)
        if (!(coverage[c] >= MIN_COVERAGE)) rgb[c] = own[c];
}

/* Writes the pixels of a window: light over coverage. */
static void write_window(const frame *f, const window *w, const pixel_pair *sums) {
    int left = larger_int(w->x0, f->border_px);
    int right = smaller_int(w->x0 + w->width, f->border_px + f->image_width);
    int bottom = smaller_int(w->y0 + w->height, f->border_px + f->image_height);
    for (int y = larger_int(w->y0, f->border_px); y < bottom; ++y) {
        const pixel_pair *row = sums + (y - w->y0) * PAIRS_ACROSS;
        size_t to = (size_t)(y - f->border_px) * (size_t)f->image_width;
        for (int x = left; x < right; ++x) {
            const float *light = (const float *)(row + (x - w->x0) / 2) + 4 * ((x - w->x0) & 1);
            f32x4 coverage = load4(light + 8);
            f32x4 least = all4(MIN_COVERAGE);
            float rgb[4];
            store4(rgb, load4(light) / larger4(coverage, least));
            i32x4 lacks = coverage < least;
            if (lacks[0] | lacks[1] | lacks[2]) fill_in_own(f, x, y, light + 8, rgb);
            write_pixel(f, to + (size_t)(x - f->border_px), rgb);
        }
    }
}

typedef struct {
    frame *f;
    int columns, rows;        /* of bins */
    bin_list *lists;          /* one a thread */
} splat_job;

/* Sums of a bin in all sizes; a tile uses the first of each. */
typedef struct {
    pixel_pair near[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair open[BIN_HEIGHT * PAIRS_ACROSS];
    pixel_pair half[(BIN_HEIGHT / 2 + 2) * (PAIRS_ACROSS / 2 + 1)];
    pixel_pair quarter[(BIN_HEIGHT / 4 + 2) * (PAIRS_ACROSS / 4 + 1)];
} sums;

INLINE window open_window(int x0, int y0, int width, int height, sums *s) {
    window w = {x0, y0, width, height, {{x0, y0, width, height, PAIRS_ACROSS, 0, s->open}}, s->near};
    pixel_pair *coarse[RESOLUTIONS] = {s->open, s->half, s->quarter};
    for (int r = 1; r < RESOLUTIONS; ++r)
        w.open[r] = (raster){(x0 >> r) - 1, (y0 >> r) - 1, (width >> r) + 2, (height >> r) + 2,
                             ((width >> r) + 2) / 2, 0, coarse[r]};
    for (int r = 0; r < RESOLUTIONS; ++r) clear_raster(w.open + r);
    return w;
}

static void splat_tile(const frame *f, const bin_list *list, int tile, sums *s) {
    int x0 = list->x0 + tile % BIN_TILES_X * TILE_SIZE_PX;
    int y0 = list->y0 + tile / BIN_TILES_X * TILE_SIZE_PX;
    if (x0 >= f->width || y0 >= f->height) return;
    window w = open_window(x0, y0, TILE_SIZE_PX, TILE_SIZE_PX, s);
    uint32_t bit = 1u << tile;
    if (list->ordered & bit) {
        clear_pairs(w.near, PAIRS_ACROSS, w.width, w.height);
        splat_ordered(f, list, bit, &w);
        write_window(f, &w, w.near);
    } else {
        splat_unordered(f, list, bit, &w);
        write_window(f, &w, w.open[0].pairs);
    }
}

/* Item: one bin. */
static void splat_bin(void *argument, int item, int thread) {
    splat_job *job = argument;
    frame *f = job->f;
    bin_list *list = job->lists + thread;
    sums s;
    list->x0 = item % job->columns * BIN_WIDTH;
    list->y0 = item / job->columns * BIN_HEIGHT;
    if (!list_fragments(f, list)) {
        __atomic_store_n(&f->failed, 1, __ATOMIC_RELAXED);
        return;
    }
    __atomic_fetch_add(&f->entry_count, (int64_t)list->count, __ATOMIC_RELAXED);
    list->ordered = 0;
    if (list->count > 0 && (f->paper_rule || list->any_edge)) {
        mark_tiles(f, list);
        if (f->paper_rule) list->ordered = ALL_TILES;
        if (list->ordered) sort_list(f, list);
    }
    if (list->ordered == 0) {
        window w = open_window(list->x0, list->y0, BIN_WIDTH, BIN_HEIGHT, &s);
        splat_unordered(f, list, ~0u, &w);
        write_window(f, &w, w.open[0].pairs);
        return;
    }
    if (list->ordered == ALL_TILES) {
        window w = open_window(list->x0, list->y0, BIN_WIDTH, BIN_HEIGHT, &s);
        clear_pairs(w.near, PAIRS_ACROSS, w.width, w.height);
        splat_ordered(f, list, ALL_TILES, &w);
        write_window(f, &w, w.near);
        return;
    }
    for (int tile = 0; tile < BIN_TILES; ++tile) splat_tile(f, list, tile, &s);
}
