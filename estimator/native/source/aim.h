/* Rays from the retinal point of the chief ray, aimed at points of the stop.
 *
 * All rays have the same origin, so their optical paths to a plane outside sample the eikonal of
 * one wave: an aiming error moves a sample, but its value is exact at the new position. */
#ifndef OCU_AIM_H
#define OCU_AIM_H

#include "chief.h"

#define DIFFERENCE_COSINE 1e-6
#define SMALLEST_SHARE 1e-3
#define WORSENING 4.0 /* of the squared error that a step may cause */

enum { AIM_STEPS = 25 };

/* Source of the rays of one field, and the plane of the wavefront. */
typedef struct {
    eye e;
    double retina[3], plane[3]; /* mm: the chief ray on the retina, and in the plane */
    axes3 inside;               /* across the chief ray, and along it, within the eye */
    axes3 outside;
    double path;                /* of the chief ray to the plane, mm */
    inverse2 response;          /* direction by position in the stop */
} light;

/* Samples of the wavefront: position, mm, W, um, and slopes, um/mm. */
typedef struct {
    lanes x, y, w, slope_x, slope_y;
} samples;

typedef struct {
    lanes a, b; /* direction cosines across the chief ray at the retina */
} aims;

typedef struct {
    lanes aa, ab, ba, bb;
} responses;

INLINE responses all_responses(inverse2 m) {
    return (responses){all_lanes(m.aa), all_lanes(m.ab), all_lanes(m.ba), all_lanes(m.bb)};
}

/* Starts rays at the retinal point; those that do not point out of the eye end. */
INLINE rays launched(const light *l, aims to, flags active) {
    lanes squared = 1.0 - to.a * to.a - to.b * to.b, c = root_of_lanes(squared);
    rays r = {.at = {all_lanes(l->retina[0]), all_lanes(l->retina[1]), all_lanes(l->retina[2])},
              .status = ~active & IDLE};
    lanes *along[] = {&r.along.x, &r.along.y, &r.along.z};
    for (int i = 0; i < 3; ++i)
        *along[i] = to.a * l->inside.row[0][i] + to.b * l->inside.row[1][i]
                    + c * l->inside.row[2][i];
    end_rays(&r, ~((squared > 0.0) & (r.along.z < 0.0)), NOT_CONVERGED);
    return r;
}

/* Traces rays from the retinal point through the lens to the stop. */
static rays back_to_stop(const light *l, aims to, flags active) {
    rays r = launched(l, to, active);
    outward(&l->e, l->e.n_before, l->e.n_surfaces, &r);
    to_stop(&l->e, &r);
    return r;
}

INLINE lanes dot(const double *axis, vector3 v) {
    return axis[0] * v.x + axis[1] * v.y + axis[2] * v.z;
}

/* Traces rays from the stop to the plane of the wavefront. */
static samples leave_eye(const light *l, rays *r) {
    outward(&l->e, 0, l->e.n_before, r);
    const double *ex = l->outside.row[0], *ey = l->outside.row[1], *u = l->outside.row[2];
    vector3 p = {r->at.x - l->plane[0], r->at.y - l->plane[1], r->at.z - l->plane[2]};
    lanes t = -dot(u, p) / dot(u, r->along);
    p = moved(p, t, r->along);
    lanes path = r->path + t * l->e.indices[0];
    double slope = -UM_PER_MM * l->e.indices[0];
    return (samples){dot(ex, p), dot(ey, p), UM_PER_MM * (l->path - path),
                     slope * dot(ex, r->along), slope * dot(ey, r->along)};
}

INLINE rays chosen_rays(flags yes, const rays *a, const rays *b) {
    return (rays){chosen3(yes, a->at, b->at), chosen3(yes, a->along, b->along),
                  chosen(yes, a->path, b->path), chosen(yes, a->since, b->since),
                  chosen_flags(yes, a->status, b->status)};
}

/* Broyden's update (Sherman-Morrison): the matrix times the change of position becomes the
 * step, in the lanes of `active`. */
INLINE void update_responses(responses *m, flags active, lanes da, lanes db, lanes cx,
                             lanes cy) {
    lanes va = da * m->aa + db * m->ba, vb = da * m->ab + db * m->bb;
    lanes scale = va * cx + vb * cy;
    active &= scale != 0.0;
    lanes ea = (da - m->aa * cx - m->ab * cy) / scale;
    lanes eb = (db - m->ba * cx - m->bb * cy) / scale;
    m->aa = chosen(active, m->aa + ea * va, m->aa);
    m->ab = chosen(active, m->ab + ea * vb, m->ab);
    m->ba = chosen(active, m->ba + eb * va, m->ba);
    m->bb = chosen(active, m->bb + eb * vb, m->bb);
}

/* Aims rays at (x, y) of the stop by Broyden's method, in the lanes of `active`.
 *
 * `to` holds the initial directions and receives the solutions; `m` is updated.  Returns the rays
 * at the stop, whose status is IDLE in the other lanes. */
static rays aimed(const light *l, lanes x, lanes y, double tolerance, flags active, aims *to,
                  responses *m) {
    rays r = back_to_stop(l, *to, active);
    flags pending = r.status == TRACED;
    aims now = *to;
    lanes mx = r.at.x - x, my = r.at.y - y;
    for (int step = 0; step < AIM_STEPS; ++step) {
        lanes miss = mx * mx + my * my;
        pending &= ~(miss < tolerance * tolerance);
        if (!any_lane(pending)) break;
        lanes da = -(m->aa * mx + m->ab * my), db = -(m->ba * mx + m->bb * my);
        lanes share = all_lanes(1.0), nx = mx, ny = my;
        flags searching = pending;
        while (any_lane(searching)) {
            aims next = {now.a + share * da, now.b + share * db};
            rays trial = back_to_stop(l, next, searching);
            lanes tx = trial.at.x - x, ty = trial.at.y - y;
            flags fine = (trial.status == TRACED) & (tx * tx + ty * ty < WORSENING * miss);
            r = chosen_rays(fine, &trial, &r);
            nx = chosen(fine, tx, nx);
            ny = chosen(fine, ty, ny);
            searching &= ~fine;
            lanes less = 0.5 * share;
            flags lost = searching & (less < SMALLEST_SHARE);
            flags why = chosen_flags(trial.status == TRACED, all_flags(NOT_CONVERGED),
                                     trial.status);
            r.status = chosen_flags(lost, why, r.status);
            searching &= ~lost;
            pending &= ~lost;
            share = chosen(searching, less, share);
        }
        da *= share;
        db *= share;
        update_responses(m, pending, da, db, nx - mx, ny - my);
        now.a = chosen(pending, now.a + da, now.a);
        now.b = chosen(pending, now.b + db, now.b);
        mx = nx;
        my = ny;
    }
    end_rays(&r, pending, NOT_CONVERGED);
    *to = now;
    return r;
}

/* Two unit vectors that complete the third row, a direction, to a basis. */
static void complete_basis(axes3 *axes) {
    double *ex = axes->row[0], *ey = axes->row[1];
    const double *d = axes->row[2];
    double length = hypot(d[0], d[2]);
    ex[0] = d[2] / length;
    ex[1] = 0.0;
    ex[2] = -d[0] / length;
    ey[0] = d[1] * ex[2] - d[2] * ex[1];
    ey[1] = d[2] * ex[0] - d[0] * ex[2];
    ey[2] = d[0] * ex[1] - d[1] * ex[0];
}

/* Prepares rays from where the first lane of `r`, a chief ray, meets the retina. */
static void start_from(light *l, const rays *r) {
    const lanes *at[] = {&r->at.x, &r->at.y, &r->at.z};
    const lanes *along[] = {&r->along.x, &r->along.y, &r->along.z};
    for (int i = 0; i < 3; ++i) {
        l->retina[i] = (*at[i])[0];
        l->inside.row[2][i] = -(*along[i])[0];
    }
    complete_basis(&l->inside);
}

/* Traces the chief ray from the retina to the stop, and finds the response there.  Returns the
 * rays, the chief ray first; their status is TRACED only if all of them pass. */
static int respond(light *l, rays *r) {
    const aims to = {{0.0, DIFFERENCE_COSINE}, {0.0, 0.0, DIFFERENCE_COSINE}};
    *r = back_to_stop(l, to, first_lanes(3));
    for (int lane = 0; lane < 3; ++lane)
        if (r->status[lane] != TRACED) return (int)r->status[lane];
    l->response = inverse_of(r->at.x, r->at.y, DIFFERENCE_COSINE);
    return TRACED;
}

/* Traces the chief ray of a field in and out of the eye; returns the status. */
static int prepare_light(light *l, const double *field_rad) {
    double start[2];
    rays r;
    int status = chief_ray(&l->e, field_rad, &l->outside, start, &r);
    if (status != TRACED) return status;
    start_from(l, &r);
    status = respond(l, &r);
    if (status != TRACED) return status;
    memcpy(l->plane, l->retina, sizeof l->plane);
    l->path = 0.0;
    r.status = ~first_lanes(1) & IDLE;
    leave_eye(l, &r);
    l->plane[0] = r.at.x[0];
    l->plane[1] = r.at.y[0];
    l->plane[2] = r.at.z[0];
    l->path = r.path[0];
    return (int)r.status[0];
}

/* Distance along the chief ray from its plane to z = `pupil_z`, mm. */
static double distance_along(const light *l, double pupil_z) {
    const double *u = l->outside.row[2];
    return l->plane[0] * u[0] + l->plane[1] * u[1] + (l->plane[2] - pupil_z) * u[2];
}

/* Moves the plane inward along the chief ray in object space. */
static void move_plane_inward(light *l, double along) {
    for (int i = 0; i < 3; ++i) l->plane[i] -= along * l->outside.row[2][i];
    l->path -= along * l->e.indices[0];
}

#endif
