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

/* Most vectors of rays that are traced at the same time: a ray is a chain of dependent
 * operations, and the processor works on several chains at once. */
enum { N_GROUPS = 4 };

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

/* Traces rays (n_groups,) from the retinal point through the lens to the stop. */
static void back_to_stop(const light *l, int n_groups, const aims *to, const flags *active,
                         rays *r) {
    for (int g = 0; g < n_groups; ++g) r[g] = launched(l, to[g], active[g]);
    outward(&l->e, l->e.n_before, l->e.n_surfaces, n_groups, r);
    for (int g = 0; g < n_groups; ++g) to_stop(&l->e, r + g);
}

INLINE lanes dot(const double *axis, vector3 v) {
    return axis[0] * v.x + axis[1] * v.y + axis[2] * v.z;
}

/* Samples of rays from the first surface to the plane of the wavefront. */
INLINE samples in_plane(const light *l, const rays *r) {
    const double *ex = l->outside.row[0], *ey = l->outside.row[1], *u = l->outside.row[2];
    vector3 p = {r->at.x - l->plane[0], r->at.y - l->plane[1], r->at.z - l->plane[2]};
    lanes t = -dot(u, p) / dot(u, r->along);
    p = moved(p, t, r->along);
    lanes path = r->path + t * l->e.indices[0];
    double slope = -UM_PER_MM * l->e.indices[0];
    return (samples){dot(ex, p), dot(ey, p), UM_PER_MM * (l->path - path),
                     slope * dot(ex, r->along), slope * dot(ey, r->along)};
}

/* Traces rays (n_groups,) from the stop to the plane of the wavefront. */
static void leave_eye(const light *l, int n_groups, rays *r, samples *found) {
    outward(&l->e, 0, l->e.n_before, n_groups, r);
    for (int g = 0; g < n_groups; ++g) found[g] = in_plane(l, r + g);
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

/* Points of the stop, or of a circle, for the lanes of `active`. */
typedef struct {
    lanes x, y;
    flags active;
} targets;

/* A step of Broyden's method. */
typedef struct {
    aims now;       /* directions of the rays so far */
    lanes mx, my;   /* their distance from the target */
    lanes da, db;   /* step */
    lanes share;    /* of the step */
    lanes nx, ny;   /* distance after it */
    flags pending;  /* lanes that have not arrived */
    flags searching; /* of these, those without an acceptable share */
} search;

INLINE search search_from(aims to, const rays *r, const targets *t) {
    return (search){.now = to,
                    .mx = r->at.x - t->x,
                    .my = r->at.y - t->y,
                    .pending = r->status == TRACED};
}

INLINE aims newton_step(const responses *m, lanes mx, lanes my) {
    return (aims){-(m->aa * mx + m->ab * my), -(m->ba * mx + m->bb * my)};
}

/* Ends the search of lanes that have arrived; returns whether others remain. */
INLINE int begin_step(search *s, const responses *m, double tolerance) {
    s->pending &= ~(s->mx * s->mx + s->my * s->my < tolerance * tolerance);
    aims step = newton_step(m, s->mx, s->my);
    s->da = step.a;
    s->db = step.b;
    s->share = all_lanes(1.0);
    s->nx = s->mx;
    s->ny = s->my;
    s->searching = s->pending;
    return any_lane(s->pending);
}

INLINE aims shared_step(const search *s) {
    return (aims){s->now.a + s->share * s->da, s->now.b + s->share * s->db};
}

/* Takes the lanes of a trial that are acceptable, and halves the step of the others; returns
 * whether there are any. */
INLINE int take_trial(search *s, const targets *t, const rays *trial, rays *r) {
    lanes tx = trial->at.x - t->x, ty = trial->at.y - t->y;
    lanes miss = s->mx * s->mx + s->my * s->my;
    flags fine = (trial->status == TRACED) & (tx * tx + ty * ty < WORSENING * miss);
    *r = chosen_rays(fine, trial, r);
    s->nx = chosen(fine, tx, s->nx);
    s->ny = chosen(fine, ty, s->ny);
    s->searching &= ~fine;
    if (!any_lane(s->searching)) return 0;
    lanes less = 0.5 * s->share;
    flags lost = s->searching & (less < SMALLEST_SHARE);
    flags why = chosen_flags(trial->status == TRACED, all_flags(NOT_CONVERGED), trial->status);
    r->status = chosen_flags(lost, why, r->status);
    s->searching &= ~lost;
    s->pending &= ~lost;
    s->share = chosen(s->searching, less, s->share);
    return any_lane(s->searching);
}

INLINE void end_step(search *s, responses *m) {
    lanes da = s->share * s->da, db = s->share * s->db;
    update_responses(m, s->pending, da, db, s->nx - s->mx, s->ny - s->my);
    s->now.a = chosen(s->pending, s->now.a + da, s->now.a);
    s->now.b = chosen(s->pending, s->now.b + db, s->now.b);
    s->mx = s->nx;
    s->my = s->ny;
}

/* Aims rays (n_groups,) at the stop by Broyden's method.
 *
 * `to` holds the initial directions and receives those of the targets, to first order from the
 * rays; `m` is updated.  Writes the rays at the stop, whose status is IDLE in other lanes. */
static void aim(const light *l, int n_groups, const targets *t, double tolerance, aims *to,
                responses *m, rays *r) {
    search s[N_GROUPS];
    rays trials[N_GROUPS];
    aims next[N_GROUPS];
    flags active[N_GROUPS];
    for (int g = 0; g < n_groups; ++g) active[g] = t[g].active;
    back_to_stop(l, n_groups, to, active, r);
    for (int g = 0; g < n_groups; ++g) s[g] = search_from(to[g], r + g, t + g);
    for (int step = 0; step < AIM_STEPS; ++step) {
        int searches = 0;
        for (int g = 0; g < n_groups; ++g) searches |= begin_step(s + g, m + g, tolerance);
        if (!searches) break;
        while (searches) {
            for (int g = 0; g < n_groups; ++g) {
                next[g] = shared_step(s + g);
                active[g] = s[g].searching;
            }
            back_to_stop(l, n_groups, next, active, trials);
            searches = 0;
            for (int g = 0; g < n_groups; ++g)
                searches |= take_trial(s + g, t + g, trials + g, r + g);
        }
        for (int g = 0; g < n_groups; ++g) end_step(s + g, m + g);
    }
    for (int g = 0; g < n_groups; ++g) {
        end_rays(r + g, s[g].pending, NOT_CONVERGED);
        aims rest = newton_step(m + g, s[g].mx, s[g].my);
        to[g] = (aims){s[g].now.a + rest.a, s[g].now.b + rest.b};
    }
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
    const flags active = first_lanes(3);
    back_to_stop(l, 1, &to, &active, r);
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
    r.status = ~first_lanes(1) & IDLE;
    outward(&l->e, 0, l->e.n_before, 1, &r);
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
