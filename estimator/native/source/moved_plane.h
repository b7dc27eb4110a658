/* Transfer of wavefronts to another plane along the chief ray. */
#ifndef OCU_MOVED_PLANE_H
#define OCU_MOVED_PLANE_H

#include "pool.h"
#include "pupil_fit.h"

/* Lengths are relative to the radius of the circle. */
typedef struct {
    const double *tables_um; /* (count, order + 1, order + 1): coefficients of x^a y^b, a first */
    const double *reach;     /* (count,): rays move by it times the gradient of W */
    const double *rays;      /* (n_rays, 3): x, y and weight */
    int n_rays, n_padded, order;
    zernike_terms terms;
    double *moved_um;        /* (count, n_terms): monomials */
    double *memory;          /* of the threads */
    size_t work_size;
} moved_run;

/* Moves the rays of a wavefront; x, y and weight (n_padded,) come from `rays`. */
static void move_rays(const moved_run *run, const double *table, double reach,
                      const sample_table *s) {
    int n = run->order + 1;
    for (int k = 0; k < run->n_padded; k += N_LANES) {
        lanes x = load_lanes(s->x + k), y = load_lanes(s->y + k);
        lanes value = {0.0}, slope_x = {0.0}, slope_y = {0.0};
        for (int a = run->order; a >= 0; --a) {
            lanes row = {0.0}, row_y = {0.0};
            for (int b = run->order - a; b >= 0; --b) {
                row_y = row_y * y + row;
                row = row * y + table[a * n + b];
            }
            slope_x = slope_x * x + value;
            value = value * x + row;
            slope_y = slope_y * x + row_y;
        }
        store_lanes(s->x + k, x + reach * slope_x);
        store_lanes(s->y + k, y + reach * slope_y);
        store_lanes(s->w + k,
                    value + 0.5 * reach * (slope_x * slope_x + slope_y * slope_y));
    }
}

static double farthest_ray(const sample_table *s) {
    double farthest2 = 0.0;
    for (int k = 0; k < s->count; ++k)
        farthest2 = fmax(farthest2, s->x[k] * s->x[k] + s->y[k] * s->y[k]);
    return sqrt(farthest2);
}

/* Moves one wavefront and fits it; an item of a pool's loop. */
static void move_wavefront(void *argument, int item, int thread) {
    const moved_run *run = argument;
    int count = run->n_padded, n_terms = run->terms.n_terms, n = run->order + 1;
    double *at = run->memory + run->work_size * (size_t)thread;
    sample_table s = {.x = at, .y = at + count, .w = at + 2 * count, .weight = at + 3 * count,
                      .count = count};
    fit_work fit = {.row = at + 4 * count, .basis = at + 5 * count,
                    .matrix = at + (5 + n_terms) * count};
    memset(at, 0, sizeof(double) * 4 * (size_t)count);
    for (int k = 0; k < run->n_rays; ++k) {
        s.x[k] = run->rays[3 * k];
        s.y[k] = run->rays[3 * k + 1];
        s.weight[k] = run->rays[3 * k + 2];
    }
    move_rays(run, run->tables_um + (ptrdiff_t)item * n * n, run->reach[item], &s);
    double zernike_um[MOST_TERMS], *moved_um = run->moved_um + (ptrdiff_t)item * n_terms;
    /* Near a focus, the rays fill a small part of the unit circle, where terms would be alike. */
    double radius = farthest_ray(&s);
    if (radius > 0.5 && radius < 2.0) radius = 1.0;
    fit_zernike(&run->terms, &s, radius, 0, &fit, zernike_um);
    add_monomials(&run->terms, zernike_um, moved_um);
    if (radius == 1.0) return;
    double scale = 1.0;
    for (int degree = 0, k = 0; k < n_terms; ++degree, scale /= radius)
        for (int b = 0; b <= degree && k < n_terms; ++b, ++k) moved_um[k] *= scale;
}

/* Moves wavefronts and adds the monomials (count, n_terms) of fits to their rays; NaN if a fit is
 * singular.  `monomials` is (n_terms, n_terms), row j those of Zernike term j.  Returns 1 if out
 * of memory. */
static int moved_fits(pool *threads, const double *tables_um, const double *reach,
                      const double *rays, const double *monomials, int64_t count,
                      int64_t n_rays, int64_t order, int64_t n_terms, double *moved_um) {
    moved_run *run = calloc(1, sizeof *run);
    if (run == NULL) return 1;
    run->tables_um = tables_um;
    run->reach = reach;
    run->rays = rays;
    run->n_rays = (int)n_rays;
    run->n_padded = row_length((int)n_rays);
    run->order = (int)order;
    run->moved_um = moved_um;
    read_terms(&run->terms, monomials, (int)n_terms);
    size_t columns = (size_t)(5 + n_terms) * (size_t)run->n_padded;
    run->work_size = columns + (size_t)n_terms * (size_t)row_length((int)n_terms);
    run->memory = calloc(run->work_size * (size_t)pool_size(threads), sizeof(double));
    int is_done = run->memory != NULL;
    if (is_done) pool_run(threads, (int)count, move_wavefront, run);
    free(run->memory);
    free(run);
    return !is_done;
}

#endif
