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

#define AIM_TOLERANCE_MM 1e-7 /* an error only moves the sample */
#define RIM_TOLERANCE_MM 1e-9 /* an error changes the radius of the circle */
#define EDGE_MARGIN 1e-6      /* times the stop's radius: exceeds the aiming tolerance */

enum { EDGE_HALVINGS = 40, EXTRAPOLATED = 3 };

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

/* Extrapolates ray directions from up to three inner rings to ring `ring`. */
INLINE aims extrapolated(const pupil_nodes *nodes, const aims *known, int ring) {
    int first = ring > EXTRAPOLATED ? ring - EXTRAPOLATED : 0;
    aims out = {{0.0}, {0.0}};
    for (int i = first; i < ring; ++i) {
        double share = 1.0, own = ring_radius(nodes, i);
        for (int k = first; k < ring; ++k)
            if (k != i)
                share *= (ring_radius(nodes, ring) - ring_radius(nodes, k))
                         / (own - ring_radius(nodes, k));
        out.a += share * known[i].a;
        out.b += share * known[i].b;
    }
    return out;
}

/* Spokes of N_LANES azimuths. */
typedef struct {
    lanes cosine, sine;
    flags active;  /* lanes with an azimuth */
    aims *known;   /* (n_rings + 1,): directions to the chief ray and to each ring */
    flags done;    /* number of rings whose rays pass */
    flags status;  /* of the last ray; TRACED in other lanes */
    int first;     /* azimuth of the first lane */
} spokes;

static spokes spokes_from(const pupil_nodes *nodes, int first, aims *known) {
    spokes s = {.active = first_lanes(nodes->n_azimuths - first), .known = known,
                .first = first};
    for (int lane = 0; lane < N_LANES && first + lane < nodes->n_azimuths; ++lane) {
        s.cosine[lane] = nodes->azimuths[2 * (first + lane)];
        s.sine[lane] = nodes->azimuths[2 * (first + lane) + 1];
    }
    known[0] = (aims){{0.0}, {0.0}};
    return s;
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

/* Traces rays aimed at (x, y) of the stop out of the eye; returns their status. */
static flags trace_aimed(const light *l, lanes x, lanes y, double tolerance, flags active,
                         aims *to, responses *m, samples *found) {
    rays r = aimed(l, x, y, tolerance, active, to, m);
    *found = leave_eye(l, &r);
    return r.status;
}

INLINE aims first_aim(const responses *m, lanes x, lanes y) {
    return (aims){m->aa * x + m->ab * y, m->ba * x + m->bb * y};
}

/* Traces the rings of spokes, whose last ring has the given radii, in the lanes of `active`. */
static void trace_spokes(const light *l, const pupil_nodes *nodes, lanes radius, flags active,
                         spokes *s, const sample_table *table) {
    responses m = all_responses(l->response);
    s->done = s->status = (flags){0};
    for (int ring = 1; ring <= nodes->n_rings && any_lane(active); ++ring) {
        lanes own = radius * nodes->rings[ring - 1], x = own * s->cosine, y = own * s->sine;
        aims to = ring == 1 ? first_aim(&m, x, y) : extrapolated(nodes, s->known, ring);
        double tolerance = ring == nodes->n_rings ? RIM_TOLERANCE_MM : AIM_TOLERANCE_MM;
        samples found;
        flags status = trace_aimed(l, x, y, tolerance, active, &to, &m, &found);
        flags passes = active & (status == TRACED);
        s->status = chosen_flags(active, status, s->status);
        s->known[ring] = to;
        keep_samples(nodes, s, ring, passes, &found, table);
        active = passes;
        s->done += passes & 1;
    }
}

/* Finds the largest radii of the stop without vignetting by bisection, in the lanes of
 * `active`, between those of the last ring that passes and of the next one. */
static lanes open_radii(const light *l, const pupil_nodes *nodes, lanes radius, flags active,
                        const spokes *s) {
    lanes low = {0.0}, high = {0.0};
    aims known = {{0.0}, {0.0}};
    for (int lane = 0; lane < N_LANES; ++lane) {
        if (!active[lane]) continue;
        int done = (int)s->done[lane];
        low[lane] = radius[lane] * ring_radius(nodes, done);
        high[lane] = radius[lane] * ring_radius(nodes, done + 1);
        known.a[lane] = s->known[done].a[lane];
        known.b[lane] = s->known[done].b[lane];
    }
    for (int i = 0; i < EDGE_HALVINGS; ++i) {
        lanes own = 0.5 * (low + high);
        lanes share = chosen(low > 0.0, own / low, all_lanes(1.0));
        aims to = {share * known.a, share * known.b};
        responses m = all_responses(l->response);
        samples found;
        flags status = trace_aimed(l, own * s->cosine, own * s->sine, AIM_TOLERANCE_MM, active,
                                   &to, &m, &found);
        flags passes = status == TRACED;
        low = chosen(passes, own, low);
        high = chosen(passes, high, own);
        known.a = chosen(passes, to.a, known.a);
        known.b = chosen(passes, to.b, known.b);
    }
    return low;
}

/* Samples the wavefront over the stop; returns the worst status of the rays.
 *
 * On vignetted azimuths, the rings are compressed to the open part, whose fraction of the radius
 * is written to `edge` (n_padded,).  The table starts with zeros. */
static int sample_pupil(const light *l, const pupil_nodes *nodes, double stop_radius_mm,
                        aims *known, const sample_table *table, double *edge) {
    int64_t worst = TRACED;
    for (int first = 0; first < nodes->n_azimuths; first += N_LANES) {
        spokes s = spokes_from(nodes, first, known);
        lanes share = all_lanes(1.0);
        flags active = s.active;
        for (int attempt = 0; attempt < 2; ++attempt) {
            lanes radius = stop_radius_mm * share;
            trace_spokes(l, nodes, radius, active, &s, table);
            active &= s.status != TRACED;
            if (!any_lane(active)) break;
            for (int lane = 0; lane < N_LANES; ++lane)
                if (active[lane] && s.status[lane] > worst) worst = s.status[lane];
            lanes open = {0.0};
            if (attempt == 0) {
                open = open_radii(l, nodes, radius, active, &s);
                open = open / stop_radius_mm * (1.0 - EDGE_MARGIN);
            }
            share = chosen(active, open, share);
        }
        store_lanes(edge + first, share);
    }
    return (int)worst;
}

#endif
