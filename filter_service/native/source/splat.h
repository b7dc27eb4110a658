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

/* Splats a bin in which order matters; false if memory ran out. */
static int splat_by_depth(const frame *f, bin_list *list, int64_t fragments, window *w) {
    if (!(f->paper_rule ? list_fragments(f, list, fragments) : list_groups(f, list))) return 0;
    sort_list(list);
    open_order(w);
    if (f->paper_rule) {
        splat_in_order(f, list, w);
        write_window(f, w, w->near, NULL);
        return 1;
    }
    splat_ordered(f, list, w);
    if (list->any_hidden && is_mixed(w)) {
        /* Without order, the light of the hidden surface must not count. */
        splat_unordered(f, list, 0, w);
        w->total = w->open.sizes[0].pairs;
    }
    write_window(f, w, w->near, w->total);
    return 1;
}

/* Item: one bin. */
static void splat_bin(void *argument, int item, int thread) {
    splat_job *job = argument;
    frame *f = job->f;
    bin_list *list = job->lists + thread;
    bin_sums s;
    list->x0 = item % job->columns * BIN_WIDTH;
    list->y0 = item / job->columns * BIN_HEIGHT;
    int64_t fragments = list_clusters(f, list);
    __atomic_fetch_add(&f->entry_count, fragments, __ATOMIC_RELAXED);
    window w = open_window(list->x0, list->y0, &s);
    if (fragments > 0 && (f->paper_rule || list->any_edge)) {
        if (splat_by_depth(f, list, fragments, &w)) return;
        fragments = -1;
    }
    if (fragments < 0) {
        __atomic_store_n(&f->failed, 1, __ATOMIC_RELAXED);
        return;
    }
    splat_unordered(f, list, 1, &w);
    write_window(f, &w, w.open.sizes[0].pairs, NULL);
}
