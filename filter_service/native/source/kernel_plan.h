/* Plan of a frame's kernels: a list of them, the recipes of node kernels, and the sizes of
 * kernels.  Computed for a few thousand kernels whenever pupil, focus or gaze changes. */
#ifndef OCU_KERNEL_PLAN_H
#define OCU_KERNEL_PLAN_H

#include "cell_maps.h"
#include "frame.h"
#include "kernel_job.h"
#include "store_reads.h"

/* Lists the used pairs; their parts are places in the table of marks. */
INLINE void list_pairs(list_job *job) {
    int64_t n = 0, width = job->n_intervals;
    for (int64_t cell = 0; cell < job->n_cells; ++cell) {
        const uint8_t *used = job->used + cell * width, *end = used + width;
        const uint8_t *at = memchr(used, 1, (size_t)width);
        for (; at != NULL; at = memchr(at + 1, 1, (size_t)(end - at - 1)), ++n) {
            job->kernel_of[at - job->used] = (uint32_t)n;
            job->cells[n] = cell;
            job->intervals[n] = at - used;
            for (int j = 0; j < FIELD_CORNERS; ++j) {
                int64_t node = job->cell_nodes[FIELD_CORNERS * cell + j];
                int64_t place = node * width + (at - used);
                job->parts[FIELD_CORNERS * n + j] = place;
                job->marks[place] = 1;
            }
        }
    }
    job->count = n;
}

/* Numbers the marked places of a table (n_fields, width) in order, and lists their rows and
 * columns; returns their number. */
INLINE int64_t number_marks(int64_t *marks, int64_t n_fields, int64_t width, int64_t *rows,
                            int64_t *columns) {
    int64_t found = 0;
    for (int64_t row = 0; row < n_fields; ++row)
        for (int64_t column = 0; column < width; ++column, ++marks) {
            if (!*marks) continue;
            rows[found] = row;
            columns[found] = column;
            *marks = found++;
        }
    return found;
}

/* Lists kernels, node kernels and recipes, each by cell or field, then by distance. */
static void list_kernels(list_job *job) {
    int64_t *marks = job->marks, n_layers = job->n_layers;
    list_pairs(job);
    job->node_count = number_marks(marks, job->n_fields, job->n_intervals, job->fields,
                                   job->node_intervals);
    for (int64_t i = 0; i < FIELD_CORNERS * job->count; ++i)
        job->parts[i] = marks[job->parts[i]];
    memset(marks, 0, sizeof *marks * (size_t)(job->n_fields * n_layers));
    for (int64_t m = 0; m < job->node_count; ++m) {
        int64_t first = job->fields[m] * n_layers, interval = job->node_intervals[m];
        job->near[m] = first + smaller_index(interval, n_layers - 1);
        job->far[m] = first + smaller_index(interval + 1, n_layers - 1);
        marks[job->near[m]] = marks[job->far[m]] = 1;
    }
    job->recipe_count = number_marks(marks, job->n_fields, n_layers, job->recipe_fields,
                                     job->recipe_layers);
    for (int64_t m = 0; m < job->node_count; ++m) {
        job->near[m] = marks[job->near[m]];
        job->far[m] = marks[job->far[m]];
    }
}

/* Sizes of recipes, or of node kernels. */
typedef struct {
    int64_t reach_px[4], radius_px;
    double peak_ratio, spread_px;
} node_size;

/* Adds a PSF with its weight to a channel of a recipe; returns whether it is missing and was
 * not counted before. */
INLINE int add_tap(const recipe_job *job, int64_t psf, double weight, uint32_t *word,
                   node_size *size) {
    const store_tables *tables = &job->tables;
    if (weight > 0.0) {
        int is_new = tables->last_used[psf] != job->frame_number;
        tables->last_used[psf] = job->frame_number;
        if (!tables->is_computed[psf]) return is_new;
    }
    uint32_t sides_px = tables->reach_words[psf];
    double per_peak = weight * (double)tables->peak_ratio[psf];
    float factor = (float)(per_peak / WEIGHT_MAX);
    size->peak_ratio += per_peak;
    size->spread_px += weight * (double)tables->spread_px[psf];
    word[0] = tables->offsets[psf];
    word[RECIPE_TAPS] = sides_px;
    memcpy(word + 2 * RECIPE_TAPS, &factor, sizeof factor);
    if (weight > 0.0) {
        if (tables->radius_px[psf] > size->radius_px) size->radius_px = tables->radius_px[psf];
        for (int side = 0; side < 4; ++side) {
            int64_t reach_px = (sides_px >> 8 * side) & 255u;
            if (reach_px > size->reach_px[side]) size->reach_px[side] = reach_px;
        }
    }
    return 0;
}

/* Writes the sizes of node kernels: the larger ones of both ends. */
INLINE void fill_node_sizes(recipe_job *job) {
    for (int64_t m = 0; m < job->node_count; ++m) {
        int64_t near = job->near[m], far = job->far[m];
        for (int side = 0; side < 4; ++side)
            job->node_reach_px[4 * m + side] = larger_index(job->reach_px[4 * near + side],
                                                            job->reach_px[4 * far + side]);
        job->node_radius_px[m] = larger_index(job->radius_px[near], job->radius_px[far]);
        job->node_peak_ratio[m] = at_least(job->peak_ratio[near], job->peak_ratio[far]);
    }
}

/* Writes recipes, and the sizes of the resulting kernels.  Returns the number of missing PSFs;
 * if it is not zero, the recipes are not valid. */
static int64_t fill_recipes(recipe_job *job) {
    const state_reads *reads = &job->reads;
    int64_t n_missing = 0, psfs[RECIPE_TAPS];
    int64_t uppers[RGB][RECIPE_TAPS / 2];
    double weights[RECIPE_TAPS];
    for (int64_t n = 0; n < job->count; ++n) {
        int64_t field = job->fields[n];
        int is_other = n == 0 || field != job->fields[n - 1];
        for (int64_t corner = 0; is_other && corner < reads->count; ++corner) {
            int64_t first = job->tables.starts[reads->groups[corner] + field];
            for (int channel = 0; channel < RGB; ++channel) uppers[channel][corner] = first;
        }
        double layer_dpt = job->layer_dpt[job->layers[n]];
        node_size found = {.spread_px = INFINITY};
        for (int channel = 0; channel < RGB; ++channel) {
            double total_dpt = layer_dpt + job->layer_zero_dpt[RGB * field + channel];
            channel_taps(&job->tables, reads, field, channel, total_dpt, uppers[channel], psfs,
                         weights);
            uint32_t *words = job->words + 3 * RECIPE_TAPS * (RGB * n + channel);
            double highest = found.peak_ratio, narrowest_px = found.spread_px;
            found.peak_ratio = found.spread_px = 0.0;
            for (int64_t tap = 0; tap < 2 * reads->count; ++tap)
                if (add_tap(job, psfs[tap], weights[tap], words + tap, &found))
                    job->missing[n_missing++] = psfs[tap];
            found.peak_ratio = at_least(found.peak_ratio, highest);
            found.spread_px = at_most(found.spread_px, narrowest_px);
        }
        memcpy(job->reach_px + 4 * n, found.reach_px, sizeof found.reach_px);
        job->radius_px[n] = found.radius_px;
        job->peak_ratio[n] = found.peak_ratio;
        job->spread_px[n] = found.spread_px;
    }
    fill_node_sizes(job);
    return n_missing;
}

/* Writes the map and weight of part j of kernel k at one end of its interval, and widens the
 * kernel.  Returns the area ratio of the map. */
INLINE double fill_end(const size_job *job, int64_t k, int64_t j, int end) {
    int64_t part = job->parts[FIELD_CORNERS * k + j];
    int64_t corner = FIELD_CORNERS * job->cells[k] + j;
    int64_t at = FIELD_CORNERS * (2 * k + end) + j;
    double weight = job->cell_weight_ratio[corner];
    double spread_px = job->recipe_spread_px[(end ? job->far : job->near)[part]];
    cell_map own = needed_map(&job->cell_maps, corner, spread_px);
    memcpy(job->maps + 4 * at, own.out, sizeof own.out);
    job->weight_ratio[at] = weight * own.box_ratio;
    job->spread_px[2 * k + end] += spread_px * weight / sqrt(own.area_ratio);
    if (!(weight > 0.0)) return own.area_ratio;
    int64_t side_px[4], widest_px = job->node_radius_px[part];
    memcpy(side_px, job->node_reach_px + 4 * part, sizeof side_px);
    if (!is_unmoved(own.out)) {
        map_reach(own.back, side_px);
        double wider_px = own.stretch_ratio * ((double)widest_px + 1.0);
        widest_px = (int64_t)at_most(ceil(wider_px), MAX_REACH_PX);
    }
    if (widest_px > job->radius_px[k]) job->radius_px[k] = widest_px;
    for (int side = 0; side < 4; ++side)
        if (side_px[side] > job->reach_px[4 * k + side])
            job->reach_px[4 * k + side] = side_px[side];
    return own.area_ratio;
}

/* Adds part j to kernel k. */
INLINE void fill_part(const size_job *job, int64_t k, int64_t j) {
    double area = at_least(fill_end(job, k, j, 0), fill_end(job, k, j, 1));
    double weight = job->cell_weight_ratio[FIELD_CORNERS * job->cells[k] + j];
    int64_t part = job->parts[FIELD_CORNERS * k + j];
    job->peak_ratio[k] += job->node_peak_ratio[part] * weight * area;
}

/* Writes the maps, weights and sizes of kernels; these arrays are zero before. */
static void fill_sizes(size_job *job) {
    for (int64_t k = 0; k < job->count; ++k)
        for (int64_t j = 0; j < FIELD_CORNERS; ++j) fill_part(job, k, j);
}

/* Writes the shapes of kernels, which allow merging from a spread on; returns the number of
 * texels of all of them. */
static int64_t fill_shapes(const double *spread_px, const int64_t *radius_px,
                           const int64_t *reach_px, int64_t count, double merge_spread_px,
                           uint8_t *shapes) {
    double least_px = (1.0 - (double)MERGE_FADE_RATIO) * merge_spread_px;
    int64_t n_texels = 0;
    for (int64_t k = 0; k < count; ++k, spread_px += 2, reach_px += 4) {
        kernel_shape shape = {{(float)spread_px[0], (float)spread_px[1]},
                              .radius_px = (uint16_t)radius_px[k]};
        for (int side = 0; side < 4; ++side) shape.reach_px[side] = (uint8_t)reach_px[side];
        double widest_px = at_least(spread_px[0], spread_px[1]), limit_px = least_px;
        for (; shape.highest_level < MAX_LEVEL && widest_px >= limit_px; limit_px *= 2.0)
            ++shape.highest_level;
        memcpy(shapes + sizeof shape * (size_t)k, &shape, sizeof shape);
        n_texels += (reach_px[0] + reach_px[1] + 1) * (reach_px[2] + reach_px[3] + 1);
    }
    return n_texels;
}

#endif
