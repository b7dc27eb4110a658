/* Light of a window: depth by depth where surfaces meet, otherwise all at once. */

#include "frame.h"
#include "vectors.h"

/* Sums of a row of coarse pixels, not in pairs. */
typedef struct {
    float light[4 * (PAIRS_ACROSS + 2)], coverage[4 * (PAIRS_ACROSS + 2)];
} coarse_row;

/* Interpolates a row of coarse pixels, `share` of the way from one row to the next. */
INLINE void row_between(const raster *coarse, const pixel_pair *above, float share,
                        coarse_row *row) {
    const pixel_pair *below = above + coarse->stride;
    f32x8 part = all8(share);
    for (int x = 0; x < coarse->width / 2; ++x) {
        store8(row->light + 8 * x, above[x].light + part * (below[x].light - above[x].light));
        store8(row->coverage + 8 * x,
               above[x].coverage + part * (below[x].coverage - above[x].coverage));
    }
}

INLINE f32x8 between(const float *left, const float *right, f32x8 part) {
    f32x8 first = load8(left);
    return first + part * (load8(right) - first);
}

/* The same for two pixels that lie between the same coarse pixels. */
INLINE f32x8 between_twice(const float *left, const float *right, f32x8 part) {
    f32x4 a = load4(left), b = load4(right);
    f32x8 first = {a[0], a[1], a[2], a[3], a[0], a[1], a[2], a[3]};
    f32x8 last = {b[0], b[1], b[2], b[3], b[0], b[1], b[2], b[3]};
    return first + part * (last - first);
}

/* Adds a row of pixels of 2 px to one of pixels of 1 px: each pair lies between three
 * coarse pixels. */
INLINE void add_halves(const coarse_row *row, pixel_pair *to, int pairs) {
    f32x8 part = {0.75f, 0.75f, 0.75f, 0.75f, 0.25f, 0.25f, 0.25f, 0.25f};
    for (int pair = 0; pair < pairs; ++pair) {
        int at = 4 * pair;
        to[pair].light += between(row->light + at, row->light + at + 4, part);
        to[pair].coverage += between(row->coverage + at, row->coverage + at + 4, part);
    }
}

/* Adds a row of pixels of 4 px: two pairs per coarse pixel, left and right of its center. */
INLINE void add_quarters(const coarse_row *row, pixel_pair *to, int pairs) {
    f32x8 before = {0.625f, 0.625f, 0.625f, 0.625f, 0.875f, 0.875f, 0.875f, 0.875f};
    f32x8 behind = {0.125f, 0.125f, 0.125f, 0.125f, 0.375f, 0.375f, 0.375f, 0.375f};
    for (int pair = 0; pair < pairs; ++pair) {
        int at = 4 * ((pair + 1) / 2);
        f32x8 part = pair & 1 ? behind : before;
        to[pair].light += between_twice(row->light + at, row->light + at + 4, part);
        to[pair].coverage += between_twice(row->coverage + at, row->coverage + at + 4, part);
    }
}

/* Adds the light of pixels of 2^r px to those of 1 px, interpolated between the centers of
 * four. */
INLINE void add_coarse(window *w, int r) {
    raster *coarse = w->open + r;
    const raster *fine = w->open;
    coarse_row row;
    for (int y = 0; y < w->height; ++y) {
        float down = ((float)y + 0.5f) / (float)(1 << r) + 0.5f;
        row_between(coarse, coarse->pairs + (int)down * coarse->stride, down - (float)(int)down,
                    &row);
        if (r == 1) add_halves(&row, fine->pairs + y * fine->stride, w->width / 2);
        else add_quarters(&row, fine->pairs + y * fine->stride, w->width / 2);
    }
    clear_raster(coarse);
}

/* Converts all light of the open depth to pixels of 1 px. */
static void gather_sizes(window *w) {
    if (w->open[1].is_lit) add_coarse(w, 1);
    if (w->open[2].is_lit) add_coarse(w, 2);
}

/* Composites a depth; its fragments share the coverage that nearer ones leave.  Returns
 * whether any coverage is left. */
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

/* Light of a tile in which order matters: depth by depth. */
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
