/* Ray bundle that fills the stop for one field.
 *
 * Rays are aimed at the nodes of a quadrature over the stop: Gauss-Radau rings in the squared
 * radius, the last one on the rim, at equally spaced azimuths.  The quadrature is exact for
 * polynomials of degree 4 n_rings - 4 (if below n_azimuths), so the fit converges
 * exponentially.  The lanes of a vector trace spokes, the nodes of one azimuth, from the center
 * outward: each ray starts from the directions of the last ones. */
#ifndef OCU_BUNDLE_H
#define OCU_BUNDLE_H

#include "aim.h"
#include "pupil_fit.h"

#define AIM_TOLERANCE_MM 3e-8 /* an error only moves the sample */
#define RIM_TOLERANCE_MM 1e-9 /* an error changes the radius of the circle */
#define EDGE_MARGIN 1e-6      /* times the stop's radius: exceeds the aiming tolerance */

/* Halvings find an edge to 2e-8 of the radius. */
enum { EDGE_HALVINGS = 24, EXTRAPOLATED = 5 };

/* Nodes of a pupil; azimuths are padded to whole vectors. */
typedef struct {
    int n_rings, n_azimuths, n_padded;
    const double *rings;     /* (n_rings,), relative to the radius */
    const double *weights;   /* (n_rings,) */
    const double *azimuths;  /* (n_azimuths, 2): cosine and sine */
} pupil_nodes;

INLINE int padded_count(int n) { return (n + N_LANES - 1) / N_LANES * N_LANES; }

/* Radius of a ring, where ring 0 is the chief ray. */
INLINE double ring_radius(const pupil_nodes *nodes, int ring) {
    return ring == 0 ? 0.0 : nodes->rings[ring - 1];
}

/* Directions, divided by their radii, at a radius, from those of rings first to last - 1; both
 * relative to the radius of the stop. */
INLINE aims through_rings(const pupil_nodes *nodes, const aims *known, int first, int last,
                          double radius) {
    aims out = {{0.0}, {0.0}};
    for (int i = first; i < last; ++i) {
        double share = 1.0, own = ring_radius(nodes, i);
        for (int k = first; k < last; ++k)
            if (k != i) share *= (radius - ring_radius(nodes, k)) / (own - ring_radius(nodes, k));
        out.a += share * known[i].a;
        out.b += share * known[i].b;
    }
    return out;
}

INLINE aims extrapolated(const pupil_nodes *nodes, const aims *known, int ring) {
    int first = ring > EXTRAPOLATED ? ring - EXTRAPOLATED : 0;
    return through_rings(nodes, known, first, ring, ring_radius(nodes, ring));
}

INLINE aims interpolated(const pupil_nodes *nodes, const aims *known, double radius) {
    return through_rings(nodes, known, 0, nodes->n_rings + 1, radius);
}

/* Spokes of N_LANES azimuths. */
typedef struct {
    lanes cosine, sine;
    flags active;  /* lanes with an azimuth */
    aims *known;   /* (n_rings + 1,): directions to each ring, divided by its radius */
    flags done;    /* number of rings whose rays pass */
    flags status;  /* of the last ray; TRACED in other lanes */
    int first;     /* azimuth of the first lane */
} spokes;

/* Prepares the spokes of a pupil (n_groups,); `response` is the inverse matrix of position, about
 * the chief ray, by direction, and `known` memory for all of them. */
static void prepare_spokes(const pupil_nodes *nodes, inverse2 response, aims *known, spokes *s) {
    for (int first = 0; first < nodes->n_azimuths; first += N_LANES, ++s) {
        *s = (spokes){.active = first_lanes(nodes->n_azimuths - first), .known = known,
                      .first = first};
        for (int lane = 0; lane < N_LANES && first + lane < nodes->n_azimuths; ++lane) {
            s->cosine[lane] = nodes->azimuths[2 * (first + lane)];
            s->sine[lane] = nodes->azimuths[2 * (first + lane) + 1];
        }
        known[0] = (aims){response.aa * s->cosine + response.ab * s->sine,
                          response.ba * s->cosine + response.bb * s->sine};
        known += nodes->n_rings + 1;
    }
}

INLINE void keep_lanes(double *to, flags yes, lanes value) {
    store_lanes(to, chosen(yes, value, load_lanes(to)));
}

/* Stores the samples of a ring in the lanes of `yes`. */
static void keep_samples(const pupil_nodes *nodes, const spokes *s, int ring, flags yes,
                         const samples *found, const sample_table *table) {
    int at = (ring - 1) * nodes->n_padded + s->first;
    keep_lanes(table->x + at, yes, found->x);
    keep_lanes(table->y + at, yes, found->y);
    keep_lanes(table->w + at, yes, found->w);
    keep_lanes(table->slope_x + at, yes, found->slope_x);
    keep_lanes(table->slope_y + at, yes, found->slope_y);
}

/* Traces the rings of spokes, whose last ring has the radii (n_groups,), in the lanes of
 * `active`.
 *
 * The first directions are extrapolated from inner rings, or interpolated from a stop that is
 * `reuse` times as large, whose directions are known; 0: none are. */
static void trace_spokes(const light *l, const pupil_nodes *nodes, int n_groups,
                         const lanes *radius, const flags *active, double reuse, spokes *s,
                         const sample_table *table) {
    responses m[N_GROUPS];
    targets t[N_GROUPS];
    for (int g = 0; g < n_groups; ++g) {
        m[g] = all_responses(l->response);
        t[g].active = active[g];
        s[g].done = s[g].status = (flags){0};
    }
    for (int ring = 1; ring <= nodes->n_rings; ++ring) {
        aims to[N_GROUPS];
        rays r[N_GROUPS];
        samples found[N_GROUPS];
        int remains = 0;
        for (int g = 0; g < n_groups; ++g) {
            lanes own = radius[g] * nodes->rings[ring - 1];
            t[g].x = own * s[g].cosine;
            t[g].y = own * s[g].sine;
            to[g] = reuse > 0.0 ? interpolated(nodes, s[g].known, nodes->rings[ring - 1] / reuse)
                                : extrapolated(nodes, s[g].known, ring);
            to[g] = (aims){own * to[g].a, own * to[g].b};
            remains |= any_lane(t[g].active);
        }
        if (!remains) break;
        double tolerance = ring == nodes->n_rings ? RIM_TOLERANCE_MM : AIM_TOLERANCE_MM;
        aim(l, n_groups, t, tolerance, to, m, r);
        leave_eye(l, n_groups, r, found);
        for (int g = 0; g < n_groups; ++g) {
            lanes own = radius[g] * nodes->rings[ring - 1];
            flags passes = t[g].active & (r[g].status == TRACED);
            s[g].status = chosen_flags(t[g].active, r[g].status, s[g].status);
            if (reuse == 0.0) s[g].known[ring] = (aims){to[g].a / own, to[g].b / own};
            keep_samples(nodes, s + g, ring, passes, found + g, table);
            s[g].done += passes & 1;
            t[g].active = passes;
        }
    }
}

/* Finds the largest radii of the stop without vignetting (n_groups,) by bisection, in the lanes
 * of `active`, between those of the last ring that passes and of the next one. */
static void open_radii(const light *l, const pupil_nodes *nodes, int n_groups,
                       const lanes *radius, const flags *active, const spokes *s, lanes *low) {
    lanes high[N_GROUPS];
    aims known[N_GROUPS];
    for (int g = 0; g < n_groups; ++g) {
        low[g] = high[g] = (lanes){0.0};
        known[g] = (aims){{0.0}, {0.0}};
        for (int lane = 0; lane < N_LANES; ++lane) {
            if (!active[g][lane]) continue;
            int done = (int)s[g].done[lane];
            low[g][lane] = radius[g][lane] * ring_radius(nodes, done);
            high[g][lane] = radius[g][lane] * ring_radius(nodes, done + 1);
            known[g].a[lane] = s[g].known[done].a[lane];
            known[g].b[lane] = s[g].known[done].b[lane];
        }
    }
    for (int i = 0; i < EDGE_HALVINGS; ++i) {
        responses m[N_GROUPS];
        targets t[N_GROUPS];
        aims to[N_GROUPS];
        rays r[N_GROUPS];
        lanes own[N_GROUPS];
        for (int g = 0; g < n_groups; ++g) {
            own[g] = 0.5 * (low[g] + high[g]);
            to[g] = (aims){own[g] * known[g].a, own[g] * known[g].b};
            m[g] = all_responses(l->response);
            t[g] = (targets){own[g] * s[g].cosine, own[g] * s[g].sine, active[g]};
        }
        aim(l, n_groups, t, AIM_TOLERANCE_MM, to, m, r);
        outward(&l->e, 0, l->e.n_before, n_groups, r);
        for (int g = 0; g < n_groups; ++g) {
            flags passes = r[g].status == TRACED;
            low[g] = chosen(passes, own[g], low[g]);
            high[g] = chosen(passes, high[g], own[g]);
            known[g].a = chosen(passes, to[g].a / own[g], known[g].a);
            known[g].b = chosen(passes, to[g].b / own[g], known[g].b);
        }
    }
}

/* Samples the wavefront over the stop for some spokes (n_groups,); returns the worst status.
 *
 * On vignetted azimuths, the rings are compressed to the open part, whose fraction of the radius
 * is written to `edge`; it is 0 with `only_whole`. */
static int sample_spokes(const light *l, const pupil_nodes *nodes, double stop_radius_mm,
                         int n_groups, double reuse, int only_whole, spokes *s,
                         const sample_table *table, double *edge) {
    lanes share[N_GROUPS], radius[N_GROUPS];
    flags active[N_GROUPS];
    int64_t worst = TRACED;
    for (int g = 0; g < n_groups; ++g) {
        share[g] = all_lanes(1.0);
        active[g] = s[g].active;
    }
    for (int attempt = 0; attempt < 2; ++attempt) {
        int fails = 0;
        for (int g = 0; g < n_groups; ++g) radius[g] = stop_radius_mm * share[g];
        trace_spokes(l, nodes, n_groups, radius, active, reuse, s, table);
        for (int g = 0; g < n_groups; ++g) {
            active[g] &= s[g].status != TRACED;
            fails |= any_lane(active[g]);
        }
        if (!fails) break;
        if (reuse > 0.0) /* unlike the larger stop */
            return sample_spokes(l, nodes, stop_radius_mm, n_groups, 0.0, only_whole, s, table,
                                 edge);
        lanes open[N_GROUPS] = {{0.0}};
        if (attempt == 0 && !only_whole)
            open_radii(l, nodes, n_groups, radius, active, s, open);
        for (int g = 0; g < n_groups; ++g) {
            for (int lane = 0; lane < N_LANES; ++lane)
                if (active[g][lane] && s[g].status[lane] > worst) worst = s[g].status[lane];
            open[g] = open[g] / stop_radius_mm * (1.0 - EDGE_MARGIN);
            share[g] = chosen(active[g], open[g], share[g]);
        }
        if (only_whole) break;
    }
    for (int g = 0; g < n_groups; ++g) store_lanes(edge + s[g].first, share[g]);
    return (int)worst;
}

/* Samples the wavefront over the stop; returns the worst status of the rays.
 *
 * `s` are the spokes of the pupil, and `reuse` is that of `trace_spokes`.  The table starts with
 * zeros.  With `only_whole`, a vignetted pupil is left where it is found to be one. */
static int sample_pupil(const light *l, const pupil_nodes *nodes, double stop_radius_mm,
                        double reuse, int only_whole, spokes *s, const sample_table *table,
                        double *edge) {
    int worst = TRACED, count = nodes->n_padded / N_LANES;
    for (int first = 0; first < count && !(only_whole && worst); first += N_GROUPS) {
        int n_groups = count - first < N_GROUPS ? count - first : N_GROUPS;
        int own = sample_spokes(l, nodes, stop_radius_mm, n_groups, reuse, only_whole, s + first,
                                table, edge);
        if (own > worst) worst = own;
    }
    return worst;
}

#endif
