/* Which elements of the pupil's edge see a source.  On its way to a point of the pupil, a ray
 * has the position of its source plus a displacement in proportion to its vergence relative to
 * the source.  A surface blocks it where both have the same vergence. */
#ifndef OCU_VISIBILITY_H
#define OCU_VISIBILITY_H

#include <math.h>

#include "edge_job.h"
#include "bounds.h"
#include "constants.h"

/* Largest number of steps along a ray, about a pixel each. */
#define MAX_RAY_STEPS 256
#define INFINITY_BITS 0x7F800000u
/* Points of a source whose rays to an edge element are averaged, and rows from each to the
 * point in the next column. */
#define SOURCE_SAMPLES 25
#define SAMPLE_STEP 7
/* If every third element sees the corners of a source, all elements see it. */
#define PROBE_STEP 3
/* Displacement of rays up to which a source is seen by all elements. */
#define LEAST_MOVED_PX 0.1

typedef struct {
    const uint32_t *bits;      /* depth (height, width), as integers */
    int64_t height, width;
    uint32_t *least;           /* of squares (rows, columns) */
} least_job;

/* Item: a row of squares.  Positive floats are ordered as their bits; less one, they are
 * smaller than those of other values. */
static void least_row(void *argument, int row, int thread) {
    (void)thread;
    const least_job *job = argument;
    int64_t columns = (job->width + DEPTH_SQUARE_PX - 1) / DEPTH_SQUARE_PX;
    uint32_t *least = job->least + row * columns;
    int64_t first = (int64_t)row * DEPTH_SQUARE_PX;
    int64_t last = smaller_index(first + DEPTH_SQUARE_PX, job->height);
    for (int64_t column = 0; column < columns; ++column) {
        int64_t left = column * DEPTH_SQUARE_PX;
        int64_t right = smaller_index(left + DEPTH_SQUARE_PX, job->width);
        uint32_t found = INFINITY_BITS - 1u;
        for (int64_t y = first; y < last; ++y) {
            const uint32_t *bits = job->bits + y * job->width;
            for (int64_t x = left; x < right; ++x)
                found = bits[x] - 1u < found ? bits[x] - 1u : found;
        }
        least[column] = found + 1u;
    }
}

/* Writes the least positive depth in squares, infinity if there is none; bits of floats. */
static void least_in_squares(pool *threads, const uint32_t *bits, int64_t height,
                             int64_t width, uint32_t *least) {
    least_job job = {bits, height, width, least};
    int64_t rows = (height + DEPTH_SQUARE_PX - 1) / DEPTH_SQUARE_PX;
    pool_run(threads, (int)rows, least_row, &job);
}

typedef struct {
    double own_dpt, step_dpt;
    int64_t steps;
    int is_hidden;
} ray_steps;

INLINE int64_t clamped_place(double place, int64_t count) {
    if (!(place > 0.0)) return 0;
    return place < (double)(count - 1) ? (int64_t)place : count - 1;
}

/* Returns the object distance of a pixel; 0 where depth is missing. */
INLINE double pixel_dpt(const visibility_job *job, int64_t x, int64_t y) {
    double depth = (double)job->depth_m[y * job->width + x];
    const double *tangents = job->tangents;
    if (!(depth > 0.0)) return 0.0;
    if (isnan(tangents[0])) return 1.0 / depth;
    double a = tangents[0] + (tangents[1] - tangents[0]) * ((double)x + 0.5) / (double)job->width;
    double b = tangents[2]
               + (tangents[3] - tangents[2]) * ((double)y + 0.5) / (double)job->height;
    return 1.0 / (depth * sqrt(1.0 + a * a + b * b));
}

/* Returns whether the visible surface blocks a ray from a point. */
static int is_blocked(const visibility_job *job, double x_px, double y_px,
                      const double *shift_px, const ray_steps *ray) {
    double own = ray->own_dpt, step = ray->step_dpt;
    /* The source itself must not block its rays where its surface is slanted. */
    double least = ray->is_hidden ? own : own + 0.3 * step + 0.01 * own;
    for (int64_t i = 0; i <= ray->steps; ++i) {
        double low = at_least(own + ((double)i - 0.5) * step, least);
        double high = own + ((double)i + 1.0) * step;
        double surface = own + at_most((double)i + 0.5, (double)ray->steps) * step;
        int within = 1;
        for (int turn = 0; turn < 2 && within; ++turn) {
            /* within the step, and where it meets the surface found */
            double at = surface - own;
            int64_t x = clamped_place(floor(x_px + shift_px[0] * at + 0.5), job->width);
            int64_t y = clamped_place(floor(y_px + shift_px[1] * at + 0.5), job->height);
            surface = pixel_dpt(job, x, y);
            within = low < surface && surface <= high;
        }
        if (within) return 1;
    }
    return 0;
}

/* Returns an upper bound on the distance of surfaces that rays from a source may meet. */
static double nearest_around(const visibility_job *job, int64_t source, double longest_px) {
    int64_t row = job->y_px[source] / DEPTH_SQUARE_PX;
    int64_t column = job->x_px[source] / DEPTH_SQUARE_PX;
    double own = job->object_dpt[source], found = own;
    double reach_px = longest_px * (job->largest_dpt - own);
    int64_t around = MAX_RAY_STEPS;
    if (reach_px < MAX_RAY_STEPS - 1) around = (int64_t)reach_px + 1;
    around = around < 0 ? 0 : around / DEPTH_SQUARE_PX + 1;
    for (int64_t i = row - around; i <= row + around; ++i) {
        if (i < 0 || i >= job->rows) continue;
        for (int64_t j = column - around; j <= column + around; ++j) {
            if (j < 0 || j >= job->columns) continue;
            int64_t down = i < row ? row - i : i - row;
            int64_t right = j < column ? column - j : j - column;
            int64_t away_px = DEPTH_SQUARE_PX * ((down > right ? down : right) - 1);
            double nearest = job->nearest_dpt[i * job->columns + j];
            if ((double)away_px <= longest_px * (nearest - own)) found = at_least(nearest, found);
        }
    }
    return found;
}

/* Returns whether an element sees a point of a source; x and y are from 0 to 1. */
INLINE int sees_point(const visibility_job *job, int64_t source, double x, double y,
                      const double *shift_px, const ray_steps *ray) {
    return !is_blocked(job, (double)job->x_px[source] + x - 0.5,
                       (double)job->y_px[source] + y - 0.5, shift_px, ray);
}

/* Returns how many of its corners an element sees. */
INLINE int corners_seen(const visibility_job *job, int64_t source, const double *shift_px,
                        const ray_steps *ray) {
    int seen = 0;
    for (int i = 0; i < 4; ++i)
        seen += sees_point(job, source, i % 2 ? 0.99 : 0.01, i / 2 ? 0.99 : 0.01, shift_px, ray);
    return seen;
}

/* Returns the share of a source's area that an element sees; corners that agree suffice.  The
 * points are a lattice of different columns and rows, so that edges pass them one by one. */
static float seen_share(const visibility_job *job, int64_t source, const double *shift_px,
                        const ray_steps *ray) {
    int corners = corners_seen(job, source, shift_px, ray), total = 0;
    if (corners % 4 == 0) return (float)(corners / 4);
    for (int i = 0; i < SOURCE_SAMPLES; ++i)
        total += sees_point(job, source, (i + 0.5) / SOURCE_SAMPLES,
                            (SAMPLE_STEP * i % SOURCE_SAMPLES + 0.5) / SOURCE_SAMPLES, shift_px,
                            ray);
    return (float)total / (float)SOURCE_SAMPLES;
}

/* Item: a source. */
static void see_source(void *argument, int source, int thread) {
    (void)thread;
    const visibility_job *job = argument;
    const double *shift_px = job->shift_px + 2 * N_EDGE * job->kinds[source];
    float *seen = job->seen + N_EDGE * source;
    double own = job->object_dpt[source], longest_px = 0.0;
    for (int m = 0; m < N_EDGE; ++m) {
        longest_px = at_least(hypot(shift_px[2 * m], shift_px[2 * m + 1]), longest_px);
        seen[m] = 1.0f;
    }
    double nearest = nearest_around(job, source, longest_px);
    double moved_px = longest_px * (nearest - own);
    if (nearest <= own || (moved_px < LEAST_MOVED_PX && !job->is_hidden[source])) return;
    int64_t steps = (int64_t)clipped(ceil(moved_px), 1.0, MAX_RAY_STEPS);
    ray_steps ray = {own, (nearest - own) / (double)steps, steps, job->is_hidden[source]};
    int hidden = 0;
    for (int m = 0; m < N_EDGE && !hidden; m += PROBE_STEP)
        hidden = corners_seen(job, source, shift_px + 2 * m, &ray) < 4;
    for (int m = 0; m < N_EDGE && hidden; ++m)
        seen[m] = seen_share(job, source, shift_px + 2 * m, &ray);
}

/* Writes which elements (N_EDGE,) of the pupil's edge see each source. */
static void see_sources(visibility_job *job) {
    pool_run(job->threads, (int)job->count, see_source, job);
}

#endif
