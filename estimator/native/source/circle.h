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

/* Traces rays (n_groups,) from the retinal point to the plane of the wavefront. */
static void through(const light *l, int n_groups, const aims *to, const flags *active, rays *r,
                    samples *found) {
    back_to_stop(l, n_groups, to, active, r);
    leave_eye(l, n_groups, r, found);
}

INLINE samples chosen_samples(flags yes, const samples *a, const samples *b) {
    return (samples){chosen(yes, a->x, b->x), chosen(yes, a->y, b->y), chosen(yes, a->w, b->w),
                     chosen(yes, a->slope_x, b->slope_x), chosen(yes, a->slope_y, b->slope_y)};
}

/* Takes the lanes of a trial whose rays pass, and halves the step of the others; returns whether
 * there are any. */
INLINE int take_outside(search *s, const rays *r, const samples *trial, samples *found,
                        flags *status) {
    *found = chosen_samples(r->status == TRACED, trial, found);
    s->searching &= r->status != TRACED;
    if (!any_lane(s->searching)) return 0;
    flags lost = s->searching & ~(s->share > CIRCLE_SMALLEST_SHARE);
    *status = chosen_flags(lost, r->status, *status);
    s->searching &= ~lost;
    s->pending &= ~lost;
    s->share = chosen(s->searching, 0.5 * s->share, s->share);
    return any_lane(s->searching);
}

/* Aims rays (n_groups,) at the circle by Broyden's method, and extrapolates W to the targets.
 * `to` holds the initial directions and receives the solutions; `m` is updated.  Writes the
 * status, IDLE in other lanes. */
static void aim_outside(const light *l, int n_groups, const targets *t, aims *to, responses *m,
                        samples *found, flags *status) {
    search s[N_GROUPS];
    rays r[N_GROUPS];
    samples trials[N_GROUPS];
    aims next[N_GROUPS];
    flags active[N_GROUPS];
    for (int g = 0; g < n_groups; ++g) active[g] = t[g].active;
    through(l, n_groups, to, active, r, found);
    for (int g = 0; g < n_groups; ++g) {
        status[g] = r[g].status;
        s[g] = (search){.now = to[g], .pending = status[g] == TRACED};
    }
    for (int step = 0; step < CIRCLE_STEPS; ++step) {
        int searches = 0;
        for (int g = 0; g < n_groups; ++g) {
            s[g].mx = found[g].x - t[g].x;
            s[g].my = found[g].y - t[g].y;
            searches |= begin_step(s + g, m + g, CIRCLE_TOLERANCE_MM);
        }
        if (!searches) break;
        while (searches) {
            for (int g = 0; g < n_groups; ++g) {
                next[g] = shared_step(s + g);
                active[g] = s[g].searching;
            }
            through(l, n_groups, next, active, r, trials);
            searches = 0;
            for (int g = 0; g < n_groups; ++g)
                searches |= take_outside(s + g, r + g, trials + g, found + g, status + g);
        }
        for (int g = 0; g < n_groups; ++g) {
            s[g].nx = found[g].x - t[g].x;
            s[g].ny = found[g].y - t[g].y;
            end_step(s + g, m + g);
        }
    }
    for (int g = 0; g < n_groups; ++g) {
        samples *f = found + g;
        lanes mx = f->x - t[g].x, my = f->y - t[g].y;
        status[g] = chosen_flags(s[g].pending, all_flags(NOT_CONVERGED), status[g]);
        f->w -= mx * f->slope_x + my * f->slope_y;
        f->x = t[g].x;
        f->y = t[g].y;
        aims rest = newton_step(m + g, mx, my);
        to[g] = (aims){s[g].now.a + rest.a, s[g].now.b + rest.b};
    }
}

/* Samples some spokes (n_groups,) of a circle; returns the worst status. */
static int sample_circle_spokes(const light *l, const pupil_nodes *nodes, double radius_mm,
                                inverse2 response, int n_groups, const spokes *s,
                                const sample_table *table) {
    responses m[N_GROUPS];
    targets t[N_GROUPS];
    int64_t worst = TRACED;
    for (int g = 0; g < n_groups; ++g) {
        m[g] = all_responses(response);
        t[g].active = s[g].active;
    }
    for (int ring = 1; ring <= nodes->n_rings; ++ring) {
        double own = radius_mm * ring_radius(nodes, ring);
        double weight = nodes->weights[ring - 1] / nodes->n_azimuths;
        aims to[N_GROUPS];
        samples found[N_GROUPS];
        flags status[N_GROUPS];
        for (int g = 0; g < n_groups; ++g) {
            t[g].x = own * s[g].cosine;
            t[g].y = own * s[g].sine;
            to[g] = extrapolated(nodes, s[g].known, ring);
            to[g] = (aims){own * to[g].a, own * to[g].b};
        }
        aim_outside(l, n_groups, t, to, m, found, status);
        for (int g = 0; g < n_groups; ++g) {
            flags passes = t[g].active & (status[g] == TRACED);
            for (int lane = 0; lane < N_LANES; ++lane)
                if (t[g].active[lane] && status[g][lane] > worst) worst = status[g][lane];
            s[g].known[ring] = (aims){to[g].a / own, to[g].b / own};
            keep_samples(nodes, s + g, ring, passes, found + g, table);
            keep_lanes(table->weight + (ring - 1) * nodes->n_padded + s[g].first, passes,
                       all_lanes(weight));
            t[g].active = passes;
        }
    }
    return (int)worst;
}

/* Fills the table, whose weights are 0 where a ray or one nearer to the center fails; returns the
 * worst status. */
static int sample_circle(const light *l, const pupil_nodes *nodes, double radius_mm, aims *known,
                         spokes *s, const sample_table *table) {
    const aims displaced = {{DIFFERENCE_COSINE}, {0.0, DIFFERENCE_COSINE}};
    const flags active = first_lanes(2);
    rays r;
    samples found;
    through(l, 1, &displaced, &active, &r, &found);
    for (int lane = 0; lane < 2; ++lane)
        if (r.status[lane] != TRACED) return (int)r.status[lane];
    double xa = found.x[0] / DIFFERENCE_COSINE, ya = found.y[0] / DIFFERENCE_COSINE;
    double xb = found.x[1] / DIFFERENCE_COSINE, yb = found.y[1] / DIFFERENCE_COSINE;
    double determinant = xa * yb - xb * ya;
    const inverse2 response = {yb / determinant, -xb / determinant, -ya / determinant,
                               xa / determinant};
    prepare_spokes(nodes, response, known, s);
    int worst = TRACED, count = nodes->n_padded / N_LANES;
    for (int first = 0; first < count; first += N_GROUPS) {
        int n_groups = count - first < N_GROUPS ? count - first : N_GROUPS;
        int own = sample_circle_spokes(l, nodes, radius_mm, response, n_groups, s + first, table);
        if (own > worst) worst = own;
    }
    return worst;
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
