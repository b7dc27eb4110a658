/* All functions of the library, compiled once for each variant (loops_any.c, loops_avx2.c). */
#include "variant.h"
#include "vectors.h"

#include "color.h"
#include "frame.h"
#include "pixels.h"
#include "reach.h"
#include "recipes.h"
#include "kernel_ends.h"
#include "kernels.h"
#include "block.h"
#include "squares.h"
#include "merge.h"
#include "lists.h"
#include "rasters.h"
#include "additions.h"
#include "depths.h"
#include "picture.h"
#include "splat.h"
#include "operator_plan.h"
#include "operator.h"
#include "shrink.h"
#include "kernel_plan.h"
#include "haze.h"
#include "spectacles.h"
#include "bands.h"
#include "defocus_nodes.h"
#include "layers.h"
#include "bright_pixels.h"
#include "planes.h"
#include "visibility.h"
#include "edge_light.h"
#include "tails.h"

static void pixels(frame *f) {
    f->missing_count = f->clamped_count = f->bad_color_count = 0;
    pool_run(f->threads, f->height, pixel_row, f);
}

static void merge(frame *f) {
    f->fragment_count = f->merged_count = 0;
    f->farthest_px = 0;
    pool_run(f->threads, f->block_rows, sum_block_row, f);
    for (int surface = 0; surface < f->surface_count; ++surface) {
        merge_job job = {f, surface};
        pool_run(f->threads, f->block_rows, merge_row, &job);
    }
}

static void place(frame *f) {
    place_recipes(f);
    place_kernels(f);
}

static void blend(frame *f) {
    pool_run(f->threads, RESOLUTIONS * f->recipe_count, blend_recipe, f);
    int items = (f->kernel_count + KERNELS_AN_ITEM - 1) / KERNELS_AN_ITEM;
    pool_run(f->threads, items, blend_kernels, f);
}

static void splat(frame *f) {
    f->entry_count = 0;
    f->failed = 0;
    int n_threads = pool_size(f->threads);
    splat_job job = {f, (f->width + BIN_WIDTH - 1) / BIN_WIDTH,
                     (f->height + BIN_HEIGHT - 1) / BIN_HEIGHT,
                     calloc((size_t)n_threads, sizeof(bin_list))};
    if (job.lists == NULL) {
        f->failed = 1;
        return;
    }
    pool_run(f->threads, f->surface_count * f->block_rows, set_factors, f);
    pool_run(f->threads, job.columns * job.rows, splat_bin, &job);
    for (int thread = 0; thread < n_threads; ++thread) free_list(job.lists + thread);
    free(job.lists);
}

static void shrink(shrink_job *job) {
    int items = (job->count + SHRUNK_AN_ITEM - 1) / SHRUNK_AN_ITEM;
    pool_run(job->threads, items, shrink_some, job);
}

static const named_function functions[] = {
    FUNCTION(pixels),
    FUNCTION(merge),
    FUNCTION(place),
    FUNCTION(blend),
    FUNCTION(splat),
    FUNCTION(new_operator),
    FUNCTION(end_operator),
    FUNCTION(apply_operator),
    FUNCTION(apply_adjoint),
    FUNCTION(shrink),
    FUNCTION(map_ratios),
    FUNCTION(list_kernels),
    FUNCTION(fill_recipes),
    FUNCTION(fill_sizes),
    FUNCTION(fill_shapes),
    FUNCTION(cell_means),
    FUNCTION(add_scattered),
    FUNCTION(resample),
    FUNCTION(resample_adjoint),
    FUNCTION(split_bands),
    FUNCTION(join_bands),
    FUNCTION(needed_intervals),
    FUNCTION(spread_nodes),
    FUNCTION(node_blur),
    FUNCTION(layer_blur),
    FUNCTION(step_curve),
    FUNCTION(layers_of_state),
    FUNCTION(count_bright),
    FUNCTION(list_bright),
    FUNCTION(fade_light),
    FUNCTION(merge_pixels),
    FUNCTION(dim_pixels),
    FUNCTION(least_in_squares),
    FUNCTION(see_sources),
    FUNCTION(fill_polar),
    FUNCTION(fill_light),
    FUNCTION(fill_omitted),
    FUNCTION(gather_points),
    FUNCTION(add_sources),
    FUNCTION(add_plane),
    FUNCTION(add_and_encode),
    FUNCTION(fill_tails),
    FUNCTION(square_means),
    FUNCTION(spread_tails),
    FUNCTION(add_tails),
    {NULL, NULL},
};

const variant OCU_VARIANT = {OCU_NAME, functions};
