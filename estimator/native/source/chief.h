/* Chief rays: from air through the center of the stop to the retina. */
#ifndef OCU_CHIEF_H
#define OCU_CHIEF_H

#include "trace.h"

#define UM_PER_MM 1000.0
#define START_MM 30.0             /* in front of the entrance pupil */
#define CHIEF_TOLERANCE_MM 1e-12
#define CHIEF_ACCEPTED_MM 1e-9    /* where rounding stops Newton's method earlier */
#define DIFFERENCE_MM 1e-6
#define MAGNIFICATION_MM 1e-3

enum { CHIEF_STEPS = 40, HALVINGS = 12, CONTINUATION_STEPS = 10 };

/* Rows: ex, ey and u, the unit vector to the source. */
typedef struct {
    double row[3][3];
} axes3;

static axes3 field_axes(double h_rad, double v_rad) {
    double u[3] = {sin(h_rad) * cos(v_rad), sin(v_rad), -cos(h_rad) * cos(v_rad)};
    double length = hypot(u[0], u[2]);
    double ex[3] = {-u[2] / length, 0.0, u[0] / length};
    return (axes3){{{ex[0], ex[1], ex[2]},
                    {ex[1] * u[2] - ex[2] * u[1], ex[2] * u[0] - ex[0] * u[2],
                     ex[0] * u[1] - ex[1] * u[0]},
                    {u[0], u[1], u[2]}}};
}

/* z of the paraxial entrance pupil, mm, from mean curvatures. */
static double entrance_pupil_z(const eye *e) {
    double z = stop_z(e), height = 0.0, slope = 1.0 / e->indices[e->n_before];
    for (int i = e->n_before - 1; i >= 0; --i) {
        const double *row = row_of(e, i);
        height += slope * (row[VERTEX + 2] - z);
        z = row[VERTEX + 2];
        double curvature = 0.5 * (row[CURVATURE_X] + row[CURVATURE_Y]);
        double power = (e->indices[i + 1] - e->indices[i]) * curvature;
        slope = (e->indices[i + 1] * slope + power * height) / e->indices[i];
    }
    return z - height / slope;
}

/* Traces parallel rays from (a, b) in the plane of the entrance pupil to the stop. */
static rays chief_shot(const eye *e, const axes3 *axes, double base_z, lanes a, lanes b) {
    const double *ex = axes->row[0], *ey = axes->row[1], *u = axes->row[2];
    rays r = {.at = {a * ex[0] + b * ey[0] + START_MM * u[0],
                     a * ex[1] + b * ey[1] + START_MM * u[1],
                     a * ex[2] + b * ey[2] + START_MM * u[2] + base_z},
              .along = {all_lanes(-u[0]), all_lanes(-u[1]), all_lanes(-u[2])}};
    inward(e, 0, e->n_before, &r);
    to_stop(e, &r);
    return r;
}

/* The first lane is the ray itself; two others are displaced along each axis. */
static rays displaced_shots(const eye *e, const axes3 *axes, double base_z, double a, double b) {
    const lanes along_a = {0.0, DIFFERENCE_MM}, along_b = {0.0, 0.0, DIFFERENCE_MM};
    return chief_shot(e, axes, base_z, a + along_a, b + along_b);
}

/* Inverse of the matrix of two differences, divided by their step, to the first lane. */
typedef struct {
    double aa, ab, ba, bb;
} inverse2;

INLINE inverse2 inverse_of(lanes x, lanes y, double step) {
    double xa = (x[1] - x[0]) / step, ya = (y[1] - y[0]) / step;
    double xb = (x[2] - x[0]) / step, yb = (y[2] - y[0]) / step;
    double determinant = xa * yb - xb * ya;
    return (inverse2){yb / determinant, -xb / determinant, -ya / determinant,
                      xa / determinant};
}

/* Aims the chief ray at the center of the stop by Newton's method; `start` (2,) is the initial
 * value and receives the solution.  Returns the status of the first lane of `r`, the ray. */
static int solve_chief(const eye *e, const axes3 *axes, double base_z, double *start, rays *r) {
    double a = start[0], b = start[1];
    *r = displaced_shots(e, axes, base_z, a, b);
    if (r->status[0] != TRACED) return (int)r->status[0];
    for (int i = 0; i < CHIEF_STEPS; ++i) {
        double x = r->at.x[0], y = r->at.y[0], miss = hypot(x, y);
        if (miss < CHIEF_TOLERANCE_MM) break;
        if (r->status[1] != TRACED) return (int)r->status[1];
        if (r->status[2] != TRACED) return (int)r->status[2];
        inverse2 m = inverse_of(r->at.x, r->at.y, DIFFERENCE_MM);
        double da = -(m.aa * x + m.ab * y), db = -(m.ba * x + m.bb * y), share = 1.0;
        int is_better = 0;
        for (int k = 0; k < HALVINGS && !is_better; ++k, share *= 0.5) {
            rays trial = displaced_shots(e, axes, base_z, a + share * da, b + share * db);
            if (trial.status[0] != TRACED) continue;
            if (!(hypot(trial.at.x[0], trial.at.y[0]) < miss)) continue;
            a += share * da;
            b += share * db;
            *r = trial;
            is_better = 1;
        }
        if (!is_better) break;
    }
    start[0] = a;
    start[1] = b;
    return hypot(r->at.x[0], r->at.y[0]) < CHIEF_ACCEPTED_MM ? TRACED : NOT_CONVERGED;
}

/* Traces the chief ray of a field, the first lane of `r`, to the retina; returns its status.
 *
 * If aiming from the paraxial entrance pupil fails, the field angle is increased in steps from
 * the axis (continuation). */
static int chief_ray(const eye *e, const double *field_rad, axes3 *axes, double *start,
                     rays *r) {
    double base_z = entrance_pupil_z(e);
    int status = NOT_CONVERGED;
    for (int step = -1; step <= CONTINUATION_STEPS; ++step) {
        if (step <= 0) start[0] = start[1] = 0.0;
        double share = step < 0 ? 1.0 : (double)step / CONTINUATION_STEPS;
        *axes = field_axes(share * field_rad[0], share * field_rad[1]);
        status = solve_chief(e, axes, base_z, start, r);
        /* Direct aiming ends the loop on success, continuation on failure. */
        if ((status == TRACED) == (step < 0)) break;
    }
    if (status != TRACED) return status;
    r->status = ~first_lanes(1) & IDLE;
    inward(e, e->n_before, e->n_surfaces, r);
    to_retina(e, r);
    return (int)r->status[0];
}

/* Parabasal magnification of the entrance pupil, about the chief ray; NaN if a ray fails.
 *
 * Parallel rays at height h cross the stop at h / m.  For an astigmatic eye, 1 / m is the root of
 * the determinant of this map. */
static double magnification(const eye *e) {
    const double on_axis[2] = {0.0, 0.0}, h = MAGNIFICATION_MM;
    const lanes along_a = {h, -h, 0.0, 0.0}, along_b = {0.0, 0.0, h, -h};
    axes3 axes;
    double start[2];
    rays r;
    if (chief_ray(e, on_axis, &axes, start, &r) != TRACED) return NAN;
    r = chief_shot(e, &axes, entrance_pupil_z(e), start[0] + along_a, start[1] + along_b);
    if (any_lane(r.status != TRACED)) return NAN;
    double ax = r.at.x[0] - r.at.x[1], ay = r.at.y[0] - r.at.y[1];
    double bx = r.at.x[2] - r.at.x[3], by = r.at.y[2] - r.at.y[3];
    return 2.0 * h / sqrt(fabs(ax * by - ay * bx));
}

/* Writes the magnification (count,) of eyes (count, n_rows, N_COLUMNS), whose index rows are
 * `index_step` numbers apart. */
static void magnifications(const double *packed, int64_t count, int64_t n_rows,
                           const double *indices, int64_t index_step, double *found) {
    for (int64_t i = 0; i < count; ++i) {
        eye e = eye_at(packed + i * n_rows * N_COLUMNS, (int)n_rows, indices + i * index_step);
        found[i] = magnification(&e);
    }
}

#endif
