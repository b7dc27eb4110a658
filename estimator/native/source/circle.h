/* Wavefront on a given circle outside the eye.
 *
 * Measurements, with which the estimation compares eyes, are given on a circle about the chief
 * ray.  Rays are therefore aimed at fixed points of this circle instead of the stop, and the fit
 * is a product with a constant matrix.  Aiming errors are corrected to first order: the slope at
 * the ray extrapolates W to the point. */
#ifndef OCU_CIRCLE_H
#define OCU_CIRCLE_H

#include "bundle.h"

/* Aiming error that the slope corrects: with W'' = 20 um/mm², to 4e-9 um. */
#define CIRCLE_TOLERANCE_MM 2e-5
#define CIRCLE_SMALLEST_SHARE 1e-2

enum { CIRCLE_STEPS = 20 };

/* Traces rays from the retinal point to the plane of the wavefront. */
static samples through(const light *l, aims to, flags active, flags *status) {
    rays r = back_to_stop(l, to, active);
    samples found = leave_eye(l, &r);
    *status = r.status;
    return found;
}

INLINE samples chosen_samples(flags yes, const samples *a, const samples *b) {
    return (samples){chosen(yes, a->x, b->x), chosen(yes, a->y, b->y), chosen(yes, a->w, b->w),
                     chosen(yes, a->slope_x, b->slope_x), chosen(yes, a->slope_y, b->slope_y)};
}

/* Aims rays at (x, y) of the circle by Broyden's method, in the lanes of `active`, and
 * extrapolates W to it.  `to` holds the initial directions and receives the solutions; `m` is
 * updated.  Returns the status, IDLE in the other lanes. */
static flags aim_outside(const light *l, lanes x, lanes y, flags active, aims *to, responses *m,
                         samples *found) {
    flags status;
    aims now = *to;
    *found = through(l, now, active, &status);
    flags pending = status == TRACED;
    for (int step = 0; step < CIRCLE_STEPS; ++step) {
        lanes mx = found->x - x, my = found->y - y;
        pending &= ~(mx * mx + my * my < CIRCLE_TOLERANCE_MM * CIRCLE_TOLERANCE_MM);
        if (!any_lane(pending)) break;
        lanes da = -(m->aa * mx + m->ab * my), db = -(m->ba * mx + m->bb * my);
        lanes share = all_lanes(1.0);
        flags searching = pending;
        while (any_lane(searching)) {
            flags own;
            aims next = {now.a + share * da, now.b + share * db};
            samples trial = through(l, next, searching, &own);
            *found = chosen_samples(own == TRACED, &trial, found);
            searching &= own != TRACED;
            flags lost = searching & ~(share > CIRCLE_SMALLEST_SHARE);
            status = chosen_flags(lost, own, status);
            searching &= ~lost;
            pending &= ~lost;
            share = chosen(searching, 0.5 * share, share);
        }
        da *= share;
        db *= share;
        update_responses(m, pending, da, db, found->x - x - mx, found->y - y - my);
        now.a = chosen(pending, now.a + da, now.a);
        now.b = chosen(pending, now.b + db, now.b);
    }
    status = chosen_flags(pending, all_flags(NOT_CONVERGED), status);
    found->w -= (found->x - x) * found->slope_x + (found->y - y) * found->slope_y;
    found->x = x;
    found->y = y;
    *to = now;
    return status;
}

/* Fills the table, whose weights are 0 where a ray or one nearer to the center fails; returns the
 * worst status. */
static int sample_circle(const light *l, const pupil_nodes *nodes, double radius_mm, aims *known,
                         const sample_table *table) {
    const aims displaced = {{DIFFERENCE_COSINE}, {0.0, DIFFERENCE_COSINE}};
    flags status;
    samples found = through(l, displaced, first_lanes(2), &status);
    for (int lane = 0; lane < 2; ++lane)
        if (status[lane] != TRACED) return (int)status[lane];
    double xa = found.x[0] / DIFFERENCE_COSINE, ya = found.y[0] / DIFFERENCE_COSINE;
    double xb = found.x[1] / DIFFERENCE_COSINE, yb = found.y[1] / DIFFERENCE_COSINE;
    double determinant = xa * yb - xb * ya;
    const inverse2 response = {yb / determinant, -xb / determinant, -ya / determinant,
                               xa / determinant};
    int64_t worst = TRACED;
    for (int first = 0; first < nodes->n_azimuths; first += N_LANES) {
        spokes s = spokes_from(nodes, first, known);
        responses m = all_responses(response);
        flags active = s.active;
        for (int ring = 1; ring <= nodes->n_rings && any_lane(active); ++ring) {
            double own = radius_mm * ring_radius(nodes, ring);
            lanes x = own * s.cosine, y = own * s.sine;
            aims to = ring == 1 ? first_aim(&m, x, y) : extrapolated(nodes, known, ring);
            status = aim_outside(l, x, y, active, &to, &m, &found);
            flags passes = active & (status == TRACED);
            for (int lane = 0; lane < N_LANES; ++lane)
                if (active[lane] && status[lane] > worst) worst = status[lane];
            known[ring] = to;
            keep_samples(nodes, &s, ring, passes, &found, table);
            keep_lanes(table->weight + (ring - 1) * nodes->n_padded + first, passes,
                       all_lanes(nodes->weights[ring - 1] / nodes->n_azimuths));
            active = passes;
        }
    }
    return (int)worst;
}

/* Multiplies W by the matrix (n_terms, n_azimuths, n_rings); piston is zero. */
static void project_circle(const pupil_nodes *nodes, const sample_table *table,
                           const double *projection, int n_terms, double *ordered,
                           double *zernike_um) {
    int count = nodes->n_azimuths * nodes->n_rings;
    for (int k = 0; k < nodes->n_azimuths; ++k)
        for (int ring = 0; ring < nodes->n_rings; ++ring)
            ordered[k * nodes->n_rings + ring] = table->w[ring * nodes->n_padded + k];
    zernike_um[0] = 0.0;
    for (int j = 1; j < n_terms; ++j) {
        const double *row = projection + (ptrdiff_t)j * count;
        lanes sum = {0.0};
        int r = 0;
        for (; r + N_LANES <= count; r += N_LANES)
            sum += load_lanes(row + r) * load_lanes(ordered + r);
        zernike_um[j] = sum_of_lanes(sum);
        for (; r < count; ++r) zernike_um[j] += row[r] * ordered[r];
    }
}

static int used_samples(const sample_table *table) {
    int count = 0;
    for (int i = 0; i < table->count; ++i) count += table->weight[i] > 0.0;
    return count;
}

#endif
