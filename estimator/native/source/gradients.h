/* Rays through gradient-index media.
 *
 * With dt = ds / n, a ray obeys r'' = n grad n, where r' is n times its direction (Sharma, Kumar
 * & Ghatak 1982), and its optical path S obeys S' = n².  Albrecht's Runge-Kutta-Nystrom method
 * integrates these equations to order 6 with five evaluations per step.
 *
 * The number of steps per medium is fixed, so that results change smoothly from ray to ray.  The
 * length of a step is the straight distance to the next surface, divided by the number of
 * remaining steps.  Newton's method ends the last step on the surface. */
#ifndef OCU_GRADIENTS_H
#define OCU_GRADIENTS_H

#include "gradient_polynomial.h"
#include "surfaces.h"

/* By GRADIENT_FORM; in the order of INDEX_FUNCTIONS in estimator/optics/gradients. */
static const index_function INDEX_FUNCTIONS[] = {polynomial_index, squared_polynomial_index};

static index_value unknown_index(const double *numbers, vector3 p) {
    (void)numbers;
    lanes none = all_lanes(NAN) * p.x;
    return (index_value){none, {none, none, none}};
}

INLINE index_function index_of(const double *medium) {
    int form = (int)medium[GRADIENT_FORM];
    int count = sizeof INDEX_FUNCTIONS / sizeof *INDEX_FUNCTIONS;
    return form < count ? INDEX_FUNCTIONS[form] : unknown_index;
}

enum { MOST_LAST_STEPS = 12 };

/* Largest distance to the surface that a Taylor step of order 2 covers to 1e-14 mm. */
#define TAYLOR_MM 1e-4

/* Points, and n times the directions, in the axes of the surface in front of a medium. */
typedef struct {
    vector3 at, along;
} wavelet;

INLINE vector3 weighted(double a, vector3 u, double b, vector3 v) {
    return (vector3){a * u.x + b * v.x, a * u.y + b * v.y, a * u.z + b * v.z};
}

INLINE vector3 sum_of(vector3 u, vector3 v) {
    return (vector3){u.x + v.x, u.y + v.y, u.z + v.z};
}

/* at + h (share * along + g * bend) */
INLINE vector3 ahead(const wavelet *w, lanes h, double share, lanes g, vector3 bend) {
    return (vector3){w->at.x + h * (share * w->along.x + g * bend.x),
                     w->at.y + h * (share * w->along.y + g * bend.y),
                     w->at.z + h * (share * w->along.z + g * bend.z)};
}

/* Returns the state after a step, and adds its optical path; `a` is the index at the start. */
static wavelet after_step(index_function index, const double *numbers, lanes h,
                          const wavelet *w, const index_value *a, lanes *path) {
    index_value b = index(numbers, ahead(w, h, 0.25, h / 32.0, a->slope));
    vector3 bend = weighted(4.0, b.slope, -1.0, a->slope);
    index_value c = index(numbers, ahead(w, h, 0.5, h / 24.0, bend));
    bend = sum_of(weighted(3.0, a->slope, 4.0, b.slope), weighted(2.0, c.slope, 0.0, c.slope));
    index_value d = index(numbers, ahead(w, h, 0.75, h / 32.0, bend));
    bend = sum_of(weighted(6.0, b.slope, -1.0, c.slope), weighted(2.0, d.slope, 0.0, d.slope));
    index_value e = index(numbers, ahead(w, h, 1.0, h / 14.0, bend));
    lanes g = h / 90.0;
    bend = sum_of(weighted(7.0, a->slope, 24.0, b.slope), weighted(6.0, c.slope, 8.0, d.slope));
    wavelet after = {.at = ahead(w, h, 1.0, g, bend)};
    bend = sum_of(weighted(7.0, sum_of(a->slope, e.slope), 32.0, sum_of(b.slope, d.slope)),
                  weighted(12.0, c.slope, 0.0, c.slope));
    after.along = moved(w->along, g, bend);
    *path += g
             * (7.0 * (a->squared + e.squared) + 32.0 * (b.squared + d.squared)
                + 12.0 * c.squared);
    return after;
}

/* The same for a small step. */
INLINE wavelet after_taylor(lanes h, const wavelet *w, const index_value *a, lanes *path) {
    lanes bend = a->slope.x * w->along.x + a->slope.y * w->along.y + a->slope.z * w->along.z;
    *path += h * (a->squared + h * bend);
    return (wavelet){ahead(w, h, 1.0, 0.5 * h, a->slope), moved(w->along, h, a->slope)};
}

/* Writes point and direction in the eye's axes to the rays.  Returns the straight distance to
 * surface `target` divided by the index: to the plane through its vertex where the straight line
 * misses it. */
static lanes step_left(const double *row, const double *target, const wavelet *w, rays *r,
                       lanes *distance) {
    vector3 p = w->at, d = w->along;
    if (row[IS_TURNED] != 0.0) {
        p = to_eye_axes(row, p);
        d = to_eye_axes(row, d);
    }
    lanes n = root_of_lanes(d.x * d.x + d.y * d.y + d.z * d.z);
    r->at = (vector3){p.x + row[VERTEX], p.y + row[VERTEX + 1], p.z + row[VERTEX + 2]};
    r->along = (vector3){d.x / n, d.y / n, d.z / n};
    lanes straight = straight_distance(target, r);
    lanes to_plane = (target[VERTEX + 2] - r->at.z) / r->along.z;
    *distance = chosen(size_of_lanes(straight) < INFINITY, straight, to_plane);
    return *distance / n;
}

INLINE vector3 chosen3(flags yes, vector3 a, vector3 b) {
    return (vector3){chosen(yes, a.x, b.x), chosen(yes, a.y, b.y), chosen(yes, a.z, b.z)};
}

/* Traces rays through the medium behind surface `i` to surface `target`, where they are not yet
 * refracted. */
static void travel(const eye *e, int i, int target, rays *r) {
    const double *row = row_of(e, i), *end = row_of(e, target);
    const double *medium = e->indices + (int)row[GRADIENT], *numbers = medium + GRADIENT_NUMBERS;
    index_function index = index_of(medium);
    int n_steps = (int)medium[GRADIENT_STEPS];
    wavelet w;
    in_surface_axes(row, r, &w.at, &w.along);
    index_value here = index(numbers, w.at);
    lanes n = root_of_lanes(here.squared), distance;
    w.along = (vector3){n * w.along.x, n * w.along.y, n * w.along.z};
    lanes left = step_left(row, end, &w, r, &distance);
    for (int step = 0; step < n_steps - 1; ++step) {
        end_rays(r, distance < -ORDER_TOLERANCE_MM, OUT_OF_ORDER);
        if (!any_lane(r->status == TRACED)) return;
        lanes h = left / (double)(n_steps - step);
        w = after_step(index, numbers, h, &w, &here, &r->path);
        left = step_left(row, end, &w, r, &distance);
        here = index(numbers, w.at);
    }
    end_rays(r, distance < -ORDER_TOLERANCE_MM, OUT_OF_ORDER);
    /* Predicting the ray's curvature saves a repetition of the last step. */
    lanes unused = {0.0}, h = left;
    wavelet bent = after_taylor(h, &w, &here, &unused);
    h += step_left(row, end, &bent, r, &distance);
    wavelet last = w;
    lanes last_path = r->path, last_left = {0.0};
    flags pending = r->status == TRACED;
    for (int i_last = 0; i_last < MOST_LAST_STEPS && any_lane(pending); ++i_last) {
        lanes path = r->path;
        wavelet after = after_step(index, numbers, h, &w, &here, &path);
        left = step_left(row, end, &after, r, &distance);
        flags close = pending & (size_of_lanes(distance) < TAYLOR_MM);
        last.at = chosen3(close, after.at, last.at);
        last.along = chosen3(close, after.along, last.along);
        last_path = chosen(close, path, last_path);
        last_left = chosen(close, left, last_left);
        pending &= ~close;
        h += left;
    }
    end_rays(r, pending, NOT_CONVERGED);
    here = index(numbers, last.at);
    last = after_taylor(last_left, &last, &here, &last_path);
    step_left(row, end, &last, r, &distance);
    r->path = last_path;
}

/* Index of the medium behind surface `i` (-1: in front of the eye) at the rays. */
static lanes index_at(const eye *e, int i, const rays *r) {
    if (i < 0 || row_of(e, i)[GRADIENT] == 0.0) return all_lanes(e->indices[i + 1]);
    const double *row = row_of(e, i), *medium = e->indices + (int)row[GRADIENT];
    vector3 p, d;
    in_surface_axes(row, r, &p, &d);
    return root_of_lanes(index_of(medium)(medium + GRADIENT_NUMBERS, p).squared);
}

#endif
