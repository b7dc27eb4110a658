/* From fragments to the output image, bin by bin: list, sort, splat, encode.  Twin:
 * splat_tiles of shaders/passes. */

#include "frame.h"
#include "vectors.h"

typedef struct {
    frame *f;
    int columns, rows;        /* of bins */
    bin_list *lists;          /* one per thread */
} splat_job;

/* Returns whether some pixel of a window takes less than all of its light by depths. */
static int is_mixed(const window *w) {
    for (int y = 0; y < w->height; ++y)
        for (int x = 0; x < w->width / 2; ++x) {
            f32x8 light = w->total[y * PAIRS_ACROSS + x].light;
            if (smaller_float(light[3], light[7]) < EDGE_MIX_COVERAGE) return 1;
        }
    return 0;
}

/* Splats a bin, or one tile of it, in which order matters everywhere or nowhere. */
static void splat_window(const frame *f, const bin_list *list, uint32_t tiles, int x0, int y0,
                         int width, int height, bin_sums *s) {
    window w = open_window(x0, y0, width, height, s);
    if (!(list->ordered & tiles)) {
        if (list->any_special || f->blend_shares != NULL)
            splat_unordered(f, list, tiles, 1, &w);
        else splat_plain(f, list, tiles, &w);
        write_window(f, &w, w.open[0].sizes[0].pairs, NULL);
        return;
    }
    open_order(&w, s);
    if (f->paper_rule) {
        splat_in_order(f, list, tiles, &w);
        write_window(f, &w, w.near, NULL);
        return;
    }
    splat_ordered(f, list, tiles, &w);
    if (w.has_hidden && is_mixed(&w)) {
        /* Without order, the light of the hidden surface must not count. */
        w.open[0] = open_group(x0, y0, width, height, s->open);
        splat_unordered(f, list, tiles, 0, &w);
        w.total = w.open[0].sizes[0].pairs;
    }
    write_window(f, &w, w.near, w.total);
}

/* Item: one bin. */
static void splat_bin(void *argument, int item, int thread) {
    splat_job *job = argument;
    frame *f = job->f;
    bin_list *list = job->lists + thread;
    bin_sums s;
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
    if (list->ordered == 0 || list->ordered == ALL_TILES) {
        splat_window(f, list, ALL_TILES, list->x0, list->y0, BIN_WIDTH, BIN_HEIGHT, &s);
        return;
    }
    for (int tile = 0; tile < BIN_TILES; ++tile) {
        int x0 = list->x0 + tile % BIN_TILES_X * TILE_SIZE_PX;
        int y0 = list->y0 + tile / BIN_TILES_X * TILE_SIZE_PX;
        if (x0 < f->width && y0 < f->height)
            splat_window(f, list, 1u << tile, x0, y0, TILE_SIZE_PX, TILE_SIZE_PX, &s);
    }
}
