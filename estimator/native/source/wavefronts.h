/* Wavefronts of many fields and eyes, over the stop or over a circle; and chief rays. */
#ifndef OCU_WAVEFRONTS_H
#define OCU_WAVEFRONTS_H

#include "circle.h"
#include "wavefront_job.h"

#define SHIFT_TOLERANCE_MM 1e-10 /* at the center of the stop: 1e-8 mrad of the shift */

enum { FEWEST_SPOKES = 6 };

/* Columns of a result, after the coefficients. */
enum {
    RADIUS = 0,
    ELLIPSE = 1,
    RMS = ELLIPSE + N_ELLIPSE,
    OPEN_SHARE = RMS + 1, /* unvignetted fraction of the stop's area */
    CHIEF_STATUS = OPEN_SHARE + 1,
    WORST_STATUS = CHIEF_STATUS + 1,
    RETINA_POINT = WORST_STATUS + 1,
    PLANE_POINT = RETINA_POINT + 3,
    N_OTHER_RESULTS = PLANE_POINT + 3
};

/* Memory of a thread. */
typedef struct {
    spokes *spokes;
    aims *known;
    sample_table samples;
    double *edge, *rim_x, *rim_y, *series, *ordered;
    fit_work fit;
} pupil_work;

typedef struct {
    const wavefront_job *job;
    pupil_nodes nodes;
    zernike_terms terms;
    size_t work_size; /* of a thread, in doubles */
    double *memory;
} wavefront_run;

/* Takes numbers from `memory` on, and counts them; NULL if there is no memory yet. */
static double *take_doubles(double *memory, size_t *used, int count) {
    double *own = memory == NULL ? NULL : memory + *used;
    *used += (size_t)padded_count(count);
    return own;
}

/* Divides the memory of a thread; returns its size, in doubles. */
static size_t divide_memory(const wavefront_run *run, double *memory, pupil_work *work) {
    size_t used = 0;
    const pupil_nodes *nodes = &run->nodes;
    int count = nodes->n_rings * nodes->n_padded, n_terms = run->terms.n_terms;
    int n_groups = nodes->n_padded / N_LANES;
    work->spokes = (spokes *)take_doubles(memory, &used,
                                          n_groups * (int)(sizeof(spokes) / sizeof(double)));
    work->known = (aims *)take_doubles(memory, &used,
                                       2 * N_LANES * n_groups * (nodes->n_rings + 1));
    work->samples.count = count;
    double **columns[] = {&work->samples.x,       &work->samples.y,
                          &work->samples.w,       &work->samples.slope_x,
                          &work->samples.slope_y, &work->samples.weight};
    for (int i = 0; i < 6; ++i) *columns[i] = take_doubles(memory, &used, count);
    work->edge = take_doubles(memory, &used, nodes->n_padded);
    work->rim_x = take_doubles(memory, &used, nodes->n_azimuths);
    work->rim_y = take_doubles(memory, &used, nodes->n_azimuths);
    work->series = take_doubles(memory, &used, 3 * nodes->n_azimuths);
    work->ordered = take_doubles(memory, &used, count);
    work->fit.basis = take_doubles(memory, &used, n_terms * count);
    work->fit.matrix = take_doubles(memory, &used, n_terms * row_length(n_terms));
    work->fit.row = take_doubles(memory, &used, count);
    return used;
}

static pupil_work work_of(const wavefront_run *run, int thread) {
    pupil_work work;
    divide_memory(run, run->memory + run->work_size * (size_t)thread, &work);
    return work;
}

static eye eye_of(const wavefront_job *job, const int64_t *index_rows, int item) {
    return eye_at(job->packed + job->eyes[item] * job->n_rows * N_COLUMNS, (int)job->n_rows,
                  job->indices + index_rows[item] * job->n_indices);
}

/* Subtracts the spherical wave of a source `distance_mm` in front of the plane. */
static void subtract_object_wave(const sample_table *s, double distance_mm) {
    for (int i = 0; i < s->count; ++i) {
        double squared = s->x[i] * s->x[i] + s->y[i] * s->y[i];
        double root = sqrt(1.0 + squared / (distance_mm * distance_mm));
        s->w[i] -= UM_PER_MM * squared / (distance_mm * (1.0 + root));
        double slope = UM_PER_MM / (distance_mm * root);
        s->slope_x[i] -= slope * s->x[i];
        s->slope_y[i] -= slope * s->y[i];
    }
}

/* Computes coefficients, radius, ellipse and residual from the samples of a stop. */
static void analyze_pupil(const wavefront_run *run, pupil_work *work, double distance_mm,
                          double *result) {
    const pupil_nodes *nodes = &run->nodes;
    const sample_table *s = &work->samples;
    double *other = result + run->terms.n_terms, share = 0.0;
    int n_rim = 0, is_whole = 1, rim = (nodes->n_rings - 1) * nodes->n_padded;
    for (int k = 0; k < nodes->n_azimuths; ++k) {
        double edge = work->edge[k], area = edge * edge / nodes->n_azimuths;
        share += area;
        is_whole &= edge == 1.0;
        for (int ring = 0; ring < nodes->n_rings; ++ring) {
            int at = ring * nodes->n_padded + k;
            s->weight[at] = area * nodes->weights[ring];
            if (edge == 0.0)
                s->x[at] = s->y[at] = s->w[at] = s->slope_x[at] = s->slope_y[at] = 0.0;
        }
        if (edge == 0.0) continue;
        work->rim_x[n_rim] = s->x[rim + k];
        work->rim_y[n_rim++] = s->y[rim + k];
    }
    other[OPEN_SHARE] = share;
    if (n_rim < FEWEST_SPOKES) return;
    double radius = rim_radius(work->rim_x, work->rim_y, n_rim, nodes->azimuths, is_whole,
                               work->series);
    other[RADIUS] = radius;
    fit_ellipse(work->rim_x, work->rim_y, n_rim, radius, other + ELLIPSE);
    if (distance_mm < INFINITY) subtract_object_wave(s, distance_mm);
    other[RMS] = fit_zernike(&run->terms, s, radius, run->job->by_slopes != 0, &work->fit,
                             result);
}

/* Analyzes a field for each stop; an item of a pool's loop. */
static void analyze_field(void *argument, int item, int thread) {
    const wavefront_run *run = argument;
    const wavefront_job *job = run->job;
    pupil_work work = work_of(run, thread);
    int n_results = run->terms.n_terms + N_OTHER_RESULTS, n_radii = (int)job->n_radii;
    double *results = job->results + (ptrdiff_t)item * n_radii * n_results;
    light l = {.e = eye_of(job, job->index_rows, item)};
    int status = prepare_light(&l, job->fields_rad + 2 * item);
    for (int i = 0; i < n_radii * n_results; ++i) results[i] = NAN;
    for (int i = 0; i < n_radii; ++i) {
        double *other = results + i * n_results + run->terms.n_terms;
        other[OPEN_SHARE] = 0.0;
        other[CHIEF_STATUS] = other[WORST_STATUS] = status;
    }
    if (status != TRACED) return;
    double pupil_z = job->pupil_z_mm[item], along = distance_along(&l, pupil_z);
    if (job->at_pupil && !isnan(pupil_z)) {
        move_plane_inward(&l, along);
        along = 0.0;
    }
    double distance_mm = INFINITY;
    if (job->object_dpt != 0.0) distance_mm = UM_PER_MM / job->object_dpt - along;
    /* Directions that are known for a stop serve for smaller ones, which come before it. */
    double known_mm = 0.0;
    for (int i = n_radii - 1; i >= 0; --i) {
        double *result = results + i * n_results, *other = result + run->terms.n_terms;
        double radius_mm = job->radii_mm[item * n_radii + i];
        memset(work.samples.x, 0, sizeof(double) * 6 * (size_t)work.samples.count);
        if (known_mm < radius_mm) prepare_spokes(&run->nodes, l.response, work.known, work.spokes);
        double reuse = known_mm < radius_mm ? 0.0 : known_mm / radius_mm;
        int only_whole = job->only_whole != 0;
        status = sample_pupil(&l, &run->nodes, radius_mm, reuse, only_whole, work.spokes,
                              &work.samples, work.edge);
        if (reuse == 0.0) known_mm = status == TRACED ? radius_mm : 0.0;
        other[WORST_STATUS] = status;
        memcpy(other + RETINA_POINT, l.retina, sizeof l.retina);
        memcpy(other + PLANE_POINT, l.plane, sizeof l.plane);
        if (status == TRACED || !only_whole) analyze_pupil(run, &work, distance_mm, result);
    }
}

/* Fits a field on its circle; an item of a pool's loop. */
static void analyze_circle(void *argument, int item, int thread) {
    const wavefront_run *run = argument;
    const wavefront_job *job = run->job;
    const pupil_nodes *nodes = &run->nodes;
    int n_terms = run->terms.n_terms;
    pupil_work work = work_of(run, thread);
    double *result = job->results + (ptrdiff_t)item * (n_terms + 1);
    light l = {.e = eye_of(job, job->index_rows, item)};
    for (int j = 0; j < n_terms; ++j) result[j] = NAN;
    int status = prepare_light(&l, job->fields_rad + 2 * item);
    result[n_terms] = status;
    if (status != TRACED) return;
    double pupil_z = job->pupil_z_mm[item];
    if (!isnan(pupil_z)) move_plane_inward(&l, distance_along(&l, pupil_z));
    memset(work.samples.x, 0, sizeof(double) * 6 * (size_t)work.samples.count);
    double radius_mm = job->radii_mm[item];
    status = sample_circle(&l, nodes, radius_mm, work.known, work.spokes, &work.samples);
    result[n_terms] = status;
    if (status == TRACED) {
        project_circle(nodes, &work.samples, job->projection, n_terms, work.ordered, result);
    } else if (used_samples(&work.samples) >= 2 * n_terms) {
        fit_zernike(&run->terms, &work.samples, radius_mm, 0, &work.fit, result);
    }
}

/* Finds the apparent direction of a chief ray: that whose chief ray at the reference wavelength
 * meets the same point of the retina.  Writes direction cosines along ex and ey of the field. */
static void shift_chief(void *argument, int item, int thread) {
    (void)thread;
    const wavefront_job *job = argument;
    double *shift = job->results + 2 * (ptrdiff_t)item, start[2];
    light l = {.e = eye_of(job, job->index_rows, item)};
    rays r;
    shift[0] = shift[1] = NAN;
    if (chief_ray(&l.e, job->fields_rad + 2 * item, &l.outside, start, &r) != TRACED) return;
    start_from(&l, &r);
    l.e = eye_of(job, job->reference_rows, item);
    if (respond(&l, &r) != TRACED) return;
    aims to = {{0.0}, {0.0}};
    responses m = all_responses(l.response);
    const targets center = {{0.0}, {0.0}, first_lanes(1)};
    samples found;
    aim(&l, 1, &center, SHIFT_TOLERANCE_MM, &to, &m, &r);
    leave_eye(&l, 1, &r, &found);
    if (r.status[0] != TRACED) return;
    /* The slope of the wavefront is opposite to that of the outgoing ray. */
    shift[0] = -found.slope_x[0] / UM_PER_MM;
    shift[1] = -found.slope_y[0] / UM_PER_MM;
}

static int run_wavefronts(const wavefront_job *job, pool_item analyze) {
    wavefront_run *run = calloc(1, sizeof *run);
    if (run == NULL) return WAVEFRONTS_NO_MEMORY;
    run->job = job;
    run->nodes = (pupil_nodes){(int)job->n_rings, (int)job->n_azimuths,
                               padded_count((int)job->n_azimuths), job->rings,
                               job->ring_weights, job->azimuths};
    read_terms(&run->terms, job->monomials, (int)job->n_terms);
    pupil_work unused;
    run->work_size = divide_memory(run, NULL, &unused);
    size_t size = sizeof(double) * run->work_size * (size_t)pool_size(job->threads);
    size_t unit = sizeof(lanes);
    run->memory = aligned_alloc(unit, (size + unit - 1) / unit * unit);
    if (run->memory != NULL) pool_run(job->threads, (int)job->count, analyze, run);
    int code = run->memory == NULL ? WAVEFRONTS_NO_MEMORY : WAVEFRONTS_DONE;
    free(run->memory);
    free(run);
    return code;
}

static int trace_pupils(wavefront_job *job) { return run_wavefronts(job, analyze_field); }

static int trace_circles(wavefront_job *job) { return run_wavefronts(job, analyze_circle); }

static int trace_shifts(wavefront_job *job) {
    pool_run(job->threads, (int)job->count, shift_chief, job);
    return WAVEFRONTS_DONE;
}

#endif
