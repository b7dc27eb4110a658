/* Light of a window, one depth after the other where surfaces meet, else all at once. */

#include "frame.h"
#include "vectors.h"

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
