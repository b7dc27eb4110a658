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

/* Lit part of a kernel's row in the raster: first pair and the last plus one. */
INLINE int lit_pairs(const frame *f, const reading *r, const raster *own, int row, int *end) {
    span lit = f->spans[r->image->first_span + (uint32_t)row];
    int first = larger_int(r->left + lit.first, 0);
    int last = smaller_int(r->left + lit.end, own->width);
    *end = (last + 1) / 2;
    return first < last ? first / 2 : *end;
}

INLINE const uint32_t *row_texels(const frame *f, const reading *r, int row) {
    ptrdiff_t texel = (ptrdiff_t)r->image->first_texel + (ptrdiff_t)row * (r->image->width + 1);
    return f->kernel_texels + 4 * (texel - r->left);
}

/* Adds a fragment's light and coverage to the depth that is open. */
INLINE void add_fragment(const frame *f, const fragment *one, window *w) {
    const level_image *image = image_of(f, one);
    raster *own = w->open + image->resolution;
    reading r = start_reading(one, image, own);
    float scale = image->scale;
    float red = scale * one->rgb[0], green = scale * one->rgb[1], blue = scale * one->rgb[2];
    f32x8 color = {red, green, blue, 0.0f, red, green, blue, 0.0f};
    f32x8 scales = all8(scale);
    int row = larger_int(-r.top, 0);
    int last = smaller_int(own->height - r.top, image->height);
    own->is_lit = 1;
    for (; row < last; ++row) {
        int end;
        int pair = lit_pairs(f, &r, own, row, &end);
        const uint32_t *from = row_texels(f, &r, row);
        pixel_pair *to = own->pairs + (row + r.top) * own->stride;
        for (; pair < end; ++pair) {
            f32x8 weight = __builtin_convertvector(
                pair_sums(read_pairs(from + 8 * pair), r.factors), f32x8);
            to[pair].light += weight * color;
            to[pair].coverage += weight * scales;
        }
    }
}

/* The paper's rule: a weight is an opacity; it merges once, four pixels. */
INLINE void cover_with_fragment(const frame *f, const fragment *one, const window *w) {
    const level_image *image = image_of(f, one);
    const raster *own = w->open;
    reading r = start_reading(one, image, own);
    f32x8 color = {one->rgb[0], one->rgb[1], one->rgb[2], 0.0f,
                   one->rgb[0], one->rgb[1], one->rgb[2], 0.0f};
    int merged = (one->state >> LEVEL_SHIFT & 3) != 0;
    int row = larger_int(-r.top, 0);
    int last = smaller_int(own->height - r.top, image->height);
    for (; row < last; ++row) {
        int end;
        int pair = lit_pairs(f, &r, own, row, &end);
        const uint32_t *from = row_texels(f, &r, row);
        pixel_pair *to = w->near + (row + r.top) * PAIRS_ACROSS;
        for (; pair < end; ++pair) {
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
    float open_depth = f->fragments[list->entries[0].fragment].depth;
    for (int i = 0; i < list->count; ++i) {
        if (!(list->entries[i].tiles & tile)) continue;
        const fragment *one = f->fragments + list->entries[i].fragment;
        if (f->paper_rule) {
            cover_with_fragment(f, one, w);
            continue;
        }
        if (is_beyond(f, one->depth, open_depth)) {
            if (!close_depth(w)) return;
            open_depth = one->depth;
        }
        add_fragment(f, one, w);
    }
    if (!f->paper_rule) close_depth(w);
}

static void splat_unordered(const frame *f, const bin_list *list, uint32_t tiles,
                            window *w) {
    for (int i = 0; i < list->count; ++i)
        if (list->entries[i].tiles & tiles)
            add_fragment(f, f->fragments + list->entries[i].fragment, w);
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

/* Writes the pixels of a window: light over coverage, or their own colour where hardly
 * any light arrives. */
static void write_window(const frame *f, const window *w, const pixel_pair *sums) {
    int right = smaller_int(w->x0 + w->width, f->border_px + f->image_width);
    int bottom = smaller_int(w->y0 + w->height, f->border_px + f->image_height);
    for (int y = larger_int(w->y0, f->border_px); y < bottom; ++y) {
        for (int x = larger_int(w->x0, f->border_px); x < right; ++x) {
            int at = x - w->x0;
            const pixel_pair *pair = sums + (y - w->y0) * PAIRS_ACROSS + at / 2;
            float rgb[RGB];
            int lacks = 0;
            for (int c = 0; c < RGB; ++c) {
                float coverage = pair->coverage[4 * (at & 1) + c];
                lacks |= !(coverage >= MIN_COVERAGE);
                rgb[c] = pair->light[4 * (at & 1) + c]
                       / (coverage > MIN_COVERAGE ? coverage : MIN_COVERAGE);
            }
            if (lacks) {
                f32x4 own = pixel_color(f, 0, (size_t)y * (size_t)f->width + (size_t)x);
                for (int c = 0; c < RGB; ++c)
                    if (!(pair->coverage[4 * (at & 1) + c] >= MIN_COVERAGE)) rgb[c] = own[c];
            }
            size_t to = (size_t)(y - f->border_px) * (size_t)f->image_width
                      + (size_t)(x - f->border_px);
            write_pixel(f, to, rgb);
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
        if (f->paper_rule) list->ordered = (1u << BIN_TILES) - 1u;
        if (list->ordered) sort_list(f, list);
    }
    if (list->ordered == 0) {
        window w = open_window(list->x0, list->y0, BIN_WIDTH, BIN_HEIGHT, &s);
        splat_unordered(f, list, ~0u, &w);
        write_window(f, &w, w.open[0].pairs);
        return;
    }
    for (int tile = 0; tile < BIN_TILES; ++tile) splat_tile(f, list, tile, &s);
}
