/* Rays through the surfaces, media and stop of an eye. */
#ifndef OCU_TRACE_H
#define OCU_TRACE_H

#include "gradients.h"
#include "pool.h"

/* Traces rays to surface `i`, from the medium behind surface `from` to that behind surface `to`;
 * -1 is air. */
static void cross(const eye *e, int i, int from, int to, rays *r) {
    const double *row = row_of(e, i);
    if (row[NEAR_GRADIENT] == 0.0) {
        cross_surface(row, r, all_lanes(e->indices[from + 1]), all_lanes(e->indices[to + 1]));
        return;
    }
    if (from >= 0 && row_of(e, from)[GRADIENT] != 0.0) {
        travel(e, from, i, r);
    } else {
        lanes n = all_lanes(e->indices[from + 1]);
        cross_surface(row, r, n, n);
    }
    cross_surface(row, r, index_at(e, from, r), index_at(e, to, r));
}

/* Traces rays to the stop plane, backward if the lens extends through it. */
INLINE void to_stop(const eye *e, rays *r) {
    lanes t = (stop_z(e) - r->at.z) / r->along.z;
    r->at = moved(r->at, t, r->along);
    r->at.z = all_lanes(stop_z(e));
    r->path += e->indices[e->n_before] * t;
    r->since += t;
}

/* Traces rays forward through surfaces first to last - 1. */
static void inward(const eye *e, int first, int last, rays *r) {
    for (int i = first; i < last && any_lane(r->status == TRACED); ++i) cross(e, i, i - 1, i, r);
}

/* Traces rays (n_groups,) in reverse through surfaces last - 1 to first. */
static void outward(const eye *e, int first, int last, int n_groups, rays *r) {
    for (int i = last - 1; i >= first; --i)
        for (int g = 0; g < n_groups; ++g)
            if (any_lane(r[g].status == TRACED)) cross(e, i, i, i - 1, r + g);
}

/* Traces rays from the last surface straight to the retina. */
static void to_retina(const eye *e, rays *r) {
    lanes n = all_lanes(e->indices[e->n_surfaces]);
    cross_surface(row_of(e, e->n_surfaces), r, n, n);
}

/* Rays through every element of an eye: surfaces, stop and retina, from air inward. */
typedef struct {
    eye e;
    const double *starts; /* (count, 6): points, mm, and direction cosines */
    int64_t count, is_reverse;
    double *points;       /* (count, n_elements, 3), mm: results, NaN from a failure on */
    double *directions;   /* (count, n_elements, 3) */
    double *paths;        /* (count, n_elements), mm */
    int64_t *status;      /* (count,) */
} trace_job;

static void record_rays(const trace_job *job, int64_t first, int element, const rays *r) {
    int n_elements = job->e.n_surfaces + 2;
    for (int lane = 0; lane < N_LANES && first + lane < job->count; ++lane) {
        int64_t at = (first + lane) * n_elements + element;
        int is_traced = r->status[lane] == TRACED;
        const vector3 *vectors[] = {&r->at, &r->along};
        double *targets[] = {job->points + 3 * at, job->directions + 3 * at};
        for (int k = 0; k < 2; ++k) {
            targets[k][0] = is_traced ? vectors[k]->x[lane] : NAN;
            targets[k][1] = is_traced ? vectors[k]->y[lane] : NAN;
            targets[k][2] = is_traced ? vectors[k]->z[lane] : NAN;
        }
        job->paths[at] = is_traced ? r->path[lane] : NAN;
    }
}

/* Traces N_LANES rays; an item of a pool's loop. */
static void trace_some(void *argument, int item, int thread) {
    (void)thread;
    const trace_job *job = argument;
    const eye *e = &job->e;
    int64_t first = (int64_t)item * N_LANES;
    rays r = {.status = ~first_lanes((int)(job->count - first)) & IDLE};
    for (int lane = 0; lane < N_LANES; ++lane) {
        int64_t own = first + lane < job->count ? first + lane : first;
        const double *start = job->starts + 6 * own;
        r.at.x[lane] = start[0];
        r.at.y[lane] = start[1];
        r.at.z[lane] = start[2];
        r.along.x[lane] = start[3];
        r.along.y[lane] = start[4];
        r.along.z[lane] = start[5];
    }
    int n_elements = e->n_surfaces + 2;
    for (int step = 0; step < n_elements; ++step) {
        int element = job->is_reverse ? n_elements - 1 - step : step;
        int i = element < e->n_before ? element : element - 1;
        if (job->is_reverse && step == 0) {
            /* the rays start on the retina */
        } else if (element == e->n_before) {
            to_stop(e, &r);
        } else if (element == n_elements - 1) {
            to_retina(e, &r);
        } else if (job->is_reverse) {
            cross(e, i, i, i - 1, &r);
        } else {
            cross(e, i, i - 1, i, &r);
        }
        record_rays(job, first, element, &r);
    }
    for (int lane = 0; lane < N_LANES && first + lane < job->count; ++lane)
        job->status[first + lane] = r.status[lane];
}

/* Traces rays (count, 6) through every element of an eye, whose geometry has n_rows rows. */
static void trace_rays(pool *threads, const double *packed, int64_t n_rows,
                       const double *indices, const double *starts, int64_t count,
                       int64_t is_reverse, double *points, double *directions, double *paths,
                       int64_t *status) {
    trace_job job = {eye_at(packed, (int)n_rows, indices), starts,     count, is_reverse,
                     points,                               directions, paths, status};
    pool_run(threads, (int)((count + N_LANES - 1) / N_LANES), trace_some, &job);
}

/* Writes n² and n times the gradient of n (count, 4) at points (count, 3), in the axes of the
 * surface in front, of the medium whose parameters start at column `first`. */
static void gradient_indices(const double *indices, int64_t first, const double *points,
                             int64_t count, double *values) {
    const double *medium = indices + first;
    index_function index = index_of(medium);
    for (int64_t i = 0; i < count; ++i) {
        const double *at = points + 3 * i;
        vector3 p = {all_lanes(at[0]), all_lanes(at[1]), all_lanes(at[2])};
        index_value n = index(medium + GRADIENT_NUMBERS, p);
        double found[] = {n.squared[0], n.slope.x[0], n.slope.y[0], n.slope.z[0]};
        memcpy(values + 4 * i, found, sizeof found);
    }
}

#endif
