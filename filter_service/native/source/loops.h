/* All loops of a frame, compiled once for each processor variant (loops_any.c, ...). */

#include "frame.h"
#include "psf_job.h"

typedef struct {
    const char *name;
    void (*pixels)(frame *f);
    void (*merge)(frame *f);
    void (*place)(frame *f);
    void (*blend)(frame *f);
    void (*splat)(frame *f);
    void (*shrink)(shrink_job *job);
    int (*psfs)(psf_job *job);
    void (*take_psfs)(psf_job *job, uint16_t *words);
} loops;

#ifdef OCU_VARIANT

#include "vectors.h"

#include "color.h"
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
#include "shrink.h"
#include "psf_pupils.h"
#include "psf_tails.h"
#include "psf_rays.h"
#include "psf_fft.h"
#include "psf_waves.h"
#include "psfs.h"

static void all_pixels(frame *f) {
    f->missing_count = f->clamped_count = f->bad_color_count = 0;
    pool_run(f->threads, f->height, pixel_row, f);
}

static void all_merges(frame *f) {
    f->fragment_count = f->merged_count = 0;
    f->farthest_px = 0;
    for (int surface = 0; surface < f->surface_count; ++surface) {
        merge_job job = {f, surface};
        pool_run(f->threads, f->block_rows, merge_row, &job);
    }
}

static void all_places(frame *f) {
    place_recipes(f);
    place_kernels(f);
}

static void all_blends(frame *f) {
    pool_run(f->threads, RESOLUTIONS * f->recipe_count, blend_recipe, f);
    int items = (f->kernel_count + KERNELS_AN_ITEM - 1) / KERNELS_AN_ITEM;
    pool_run(f->threads, items, blend_kernels, f);
}

static void all_splats(frame *f) {
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
    pool_run(f->threads, job.columns * job.rows, splat_bin, &job);
    for (int thread = 0; thread < n_threads; ++thread) free_list(job.lists + thread);
    free(job.lists);
}

static void all_shrinks(shrink_job *job) {
    int items = (job->count + SHRUNK_AN_ITEM - 1) / SHRUNK_AN_ITEM;
    pool_run(job->threads, items, shrink_some, job);
}

/* Computes the PSFs of a job; 0 if out of memory.  `take_all_psfs` must follow. */
static int all_psfs(psf_job *job) {
    size_t n_threads = (size_t)pool_size(job->threads), count = (size_t)job->count;
    psf_results *results = calloc(1, sizeof *results);
    if (results == NULL) return 0;
    job->results = results;
    results->work = calloc(n_threads, sizeof *results->work);
    results->first = calloc(count + 1, sizeof *results->first);
    results->thread = calloc(count + 1, sizeof *results->thread);
    if (results->work == NULL || results->first == NULL || results->thread == NULL) return 0;
    int items = (job->count + PSFS_AN_ITEM - 1) / PSFS_AN_ITEM;
    pool_run(job->threads, items, compute_psf_item, job);
    return 1;
}

/* Copies the kernels, concatenated, and frees the job's memory; with NULL, only frees. */
static void take_all_psfs(psf_job *job, uint16_t *words) {
    psf_results *results = job->results;
    job->results = NULL;
    if (results == NULL) return;
    for (int psf = 0; words != NULL && psf < job->count; ++psf) {
        size_t size = (size_t)job->sizes[psf];
        if (size == 0) continue; // refused: its thread may hold no words at all
        memcpy(words, results->work[results->thread[psf]].words + results->first[psf],
               sizeof *words * size);
        words += size;
    }
    int n_threads = results->work == NULL ? 0 : pool_size(job->threads);
    for (int thread = 0; thread < n_threads; ++thread) {
        psf_work *w = results->work + thread;
        free_wave_work(&w->waves);
        free(w->plane.at);
        free(w->part.at);
        free(w->kept.at);
        free(w->words);
    }
    free(results->work);
    free(results->first);
    free(results->thread);
    free(results);
}

const loops OCU_VARIANT = {OCU_NAME,    all_pixels, all_merges,  all_places, all_blends,
                           all_splats,  all_shrinks, all_psfs,   take_all_psfs};

#endif
