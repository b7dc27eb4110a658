/* Intersection of rays with one surface, and refraction there. */
#ifndef OCU_SURFACES_H
#define OCU_SURFACES_H

#include "forms.h"

#define ORDER_TOLERANCE_MM 1e-9
#define STEP_TOLERANCE_MM 1e-13
#define LARGEST_STEP_MM 1e3

enum { MOST_STEPS = 30 };

/* Distance to a conic of revolution; NaN without an intersection.
 *
 * Of the two roots, it is the one that becomes that of the plane as the curvature vanishes.  For
 * a ray inside a closed retina, this is the farther one. */
INLINE lanes conic_distance(double c, double k, vector3 p, vector3 d) {
    lanes a = c * (1.0 + k * d.z * d.z);
    lanes b = c * (p.x * d.x + p.y * d.y + (1.0 + k) * p.z * d.z) - d.z;
    lanes e = c * (p.x * p.x + p.y * p.y + (1.0 + k) * p.z * p.z) - 2.0 * p.z;
    lanes root = root_of_lanes(b * b - a * e);
    flags forward = d.z > 0.0;
    return chosen(forward, e, -e) / (root + chosen(forward, -b, b));
}

/* Distance by Newton's method for the rays of `active`; NaN outside the form, infinite if not
 * converged.  Writes the slopes of the surface there. */
static lanes iterated_distance(const double *row, vector3 p, vector3 d, flags active,
                               lanes *zx, lanes *zy) {
    double c = 0.5 * (row[CURVATURE_X] + row[CURVATURE_Y]);
    lanes t = conic_distance(c, row[CONIC], p, d);
    t = chosen(t != t, -p.z / d.z, t);
    lanes found = all_lanes(INFINITY);
    *zx = *zy = (lanes){0.0};
    for (int i = 0; i < MOST_STEPS; ++i) {
        sags s = surface_sag(row, p.x + t * d.x, p.y + t * d.y);
        lanes step = (p.z + t * d.z - s.z) / (d.z - s.zx * d.x - s.zy * d.y);
        t -= step;
        lanes size = size_of_lanes(step);
        flags close = active & (size < STEP_TOLERANCE_MM * (1.0 + size_of_lanes(t)));
        flags lost = (active & ~(size < LARGEST_STEP_MM)) | (close & ~s.inside);
        found = chosen(close, t, found);
        found = chosen(lost, all_lanes(NAN), found);
        *zx = chosen(active, s.zx, *zx);
        *zy = chosen(active, s.zy, *zy);
        active &= ~(close | lost);
        if (!any_lane(active)) break;
    }
    return found;
}

/* Point and direction of rays in the axes of a surface. */
INLINE void in_surface_axes(const double *row, const rays *r, vector3 *p, vector3 *d) {
    *p = from_vertex(row, r->at);
    *d = r->along;
    if (row[IS_TURNED] != 0.0) {
        *p = to_surface_axes(row, *p);
        *d = to_surface_axes(row, *d);
    }
}

/* Distance along a straight line; NaN if a ray misses the surface, infinite if the iteration
 * does not converge. */
static lanes straight_distance(const double *row, const rays *r) {
    vector3 p, d;
    lanes zx, zy;
    in_surface_axes(row, r, &p, &d);
    if (row[FORM] == REVOLVED) return conic_distance(row[CURVATURE_X], row[CONIC], p, d);
    return iterated_distance(row, p, d, r->status == TRACED, &zx, &zy);
}

/* Directions behind a surface with the normal g, not normalized. */
INLINE vector3 refracted(rays *r, vector3 d, vector3 g, lanes n_from, lanes n_to) {
    flags changes = n_from != n_to;
    if (!any_lane(changes)) return d;
    lanes inverse = 1.0 / root_of_lanes(g.x * g.x + g.y * g.y + g.z * g.z);
    lanes ratio = n_from / n_to;
    lanes cosine = (d.x * g.x + d.y * g.y + d.z * g.z) * inverse;
    lanes squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine);
    end_rays(r, changes & (squared < 0.0), TOTAL_REFLECTION);
    lanes along = (with_sign(root_of_lanes(squared), cosine) - ratio * cosine) * inverse;
    return (vector3){chosen(changes, ratio * d.x + along * g.x, d.x),
                     chosen(changes, ratio * d.y + along * g.y, d.y),
                     chosen(changes, ratio * d.z + along * g.z, d.z)};
}

/* Traces rays to a surface and refracts them; equal indices leave the direction unchanged. */
static void cross_surface(const double *row, rays *r, lanes n_from, lanes n_to) {
    vector3 p, d, g;
    lanes t;
    in_surface_axes(row, r, &p, &d);
    int is_revolved = row[FORM] == REVOLVED;
    double c = row[CURVATURE_X], k = row[CONIC];
    if (is_revolved) {
        t = conic_distance(c, k, p, d);
    } else {
        t = iterated_distance(row, p, d, r->status == TRACED, &g.x, &g.y);
        g = (vector3){-g.x, -g.y, all_lanes(1.0)};
    }
    end_rays(r, t == INFINITY, NOT_CONVERGED);
    end_rays(r, t != t, MISSED);
    p = moved(p, t, d);
    if (is_revolved) {
        g = (vector3){-c * p.x, -c * p.y, 1.0 - c * (1.0 + k) * p.z};
        end_rays(r, (g.z <= 0.0) & (n_from != n_to), MISSED);
    }
    end_rays(r, p.x * p.x + p.y * p.y > row[CLEAR_SQUARED], CLIPPED);
    r->path += n_from * t;
    end_rays(r, r->since + t < -ORDER_TOLERANCE_MM, OUT_OF_ORDER);
    r->since = (lanes){0.0};
    d = refracted(r, d, g, n_from, n_to);
    if (row[IS_TURNED] != 0.0) {
        p = to_eye_axes(row, p);
        d = to_eye_axes(row, d);
    }
    r->at = (vector3){p.x + row[VERTEX], p.y + row[VERTEX + 1], p.z + row[VERTEX + 2]};
    r->along = d;
}

#endif
