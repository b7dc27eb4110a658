/* Total defocus of a traced eye at fixed fields, for one state of the eye.
 *
 * It depends only on sums of monomials of the same even degree, and on the rim of the pupil.
 * `TracedFields.wavefronts` computes the complete wavefronts. */
#ifndef OCU_FIELD_DEFOCUS_H
#define OCU_FIELD_DEFOCUS_H

#include <math.h>
#include <stdint.h>

#include "defocus_job.h"
#include "vectors.h"

#define N_DEGREES 5           /* 2, 4 ... 10, which contribute to C(2,0) */
#define N_RIM 5               /* x, y of the center and xx, xy, yy of the matrix, mm */
#define N_VALUES (N_DEGREES + N_RIM)
#define SMOOTH_PUPILS 3       /* whose interpolation is smooth, see `interpolation.pupil_weights` */
#define RIM_LANES 8
#define RIM_SAMPLES 16
#define NEWTON_STEPS 4
#define NEWTON_STEP_RAD 0.2

/* Weights of the accommodations, and of the pupils after `lower`, which has the rest. */
typedef struct {
    const double *accommodations;
    int64_t lower;
    double pupils[2][N_VALUES];
} grid_weights;

/* Lagrange weights of the polynomial through nodes. */
INLINE void lagrange_weights(const double *nodes, int64_t n, double at, double *weights) {
    for (int64_t i = 0; i < n; ++i) {
        weights[i] = 1.0;
        for (int64_t j = 0; j < n; ++j)
            if (j != i) weights[i] *= (at - nodes[j]) / (nodes[i] - nodes[j]);
    }
}

static grid_weights weights_of_state(const defocus_grid *traced, double pupil_mm,
                                     const double *accommodations) {
    grid_weights w = {accommodations, 0, {{0.0}}};
    const double *nodes_mm = traced->pupils_mm;
    if (traced->pupil_count == 1) return w;
    if (traced->pupil_count == SMOOTH_PUPILS) {
        double first = nodes_mm[0] / nodes_mm[2], middle = nodes_mm[1] / nodes_mm[2];
        double here = pupil_mm / nodes_mm[2];
        for (int k = 0; k < N_VALUES; ++k) {
            double low = traced->powers[k], high = low + 2.0;
            double first_low = pow(first, low), first_high = pow(first, high);
            double a = pow(middle, low) - first_low, b = pow(middle, high) - first_high;
            double c = 1.0 - first_low, d = 1.0 - first_high;
            double e = pow(here, low) - first_low, f = pow(here, high) - first_high;
            w.pupils[0][k] = (e * d - f * c) / (a * d - b * c);
            w.pupils[1][k] = (a * f - b * e) / (a * d - b * c);
        }
        return w;
    }
    while (w.lower < traced->pupil_count - 2 && nodes_mm[w.lower + 1] <= pupil_mm) ++w.lower;
    double high_mm = nodes_mm[w.lower + 1];
    for (int k = 0; k < N_VALUES; ++k) {
        double least = pow(nodes_mm[w.lower] / high_mm, traced->powers[k]);
        w.pupils[0][k] = (pow(pupil_mm / high_mm, traced->powers[k]) - least) / (1.0 - least);
    }
    return w;
}

/* Interpolates the sums and the rim of a request, with the rim relative to the pupil. */
INLINE void values_between(const defocus_grid *traced, const grid_weights *w, int64_t field,
                           int64_t channel, double found[N_VALUES]) {
    int64_t count = traced->accommodation_count, stride = N_VALUES * count;
    int64_t upper = w->lower + 1, third = w->lower + 2, last = traced->pupil_count - 1;
    const double *pupils
        = traced->values + (field * traced->channel_count + channel) * traced->pupil_count * stride;
    const double *low = pupils + w->lower * stride;
    const double *high = pupils + (upper < last ? upper : last) * stride;
    const double *highest = pupils + (third < last ? third : last) * stride;
    for (int k = 0; k < N_VALUES; ++k) found[k] = 0.0;
    for (int64_t a = 0; a < count; ++a)
        for (int k = 0; k < N_VALUES; ++k) {
            int64_t i = N_VALUES * a + k;
            double part = low[i] + w->pupils[0][k] * (high[i] - low[i]);
            part += w->pupils[1][k] * (highest[i] - low[i]);
            found[k] += w->accommodations[a] * part;
        }
}

/* Rims of several requests: center x, y and matrix xx, xy, yy, mm. */
typedef struct { double of[N_RIM][RIM_LANES]; } rims;

/* Sets a lane to a rim that is stored relative to the pupil (its center, to the square). */
INLINE void set_rim(rims *r, int lane, const double values[N_VALUES], double pupil_mm,
                    double ratio) {
    for (int k = 0; k < N_RIM; ++k) {
        double scaled = values[N_DEGREES + k] * (pupil_mm * ratio);
        r->of[k][lane] = k < 2 ? scaled * pupil_mm : scaled;
    }
}

/* Radii of the circles about the chief ray that circumscribe rims.
 *
 * Loops over the lanes, without branches, are vector instructions: a fifth of the time of one
 * rim after another. */
static void circumscribed_mm(const rims *r, double radius_mm[RIM_LANES]) {
    static const double sampled_cos[RIM_SAMPLES] = {
        1.0, 0.92387953251128674, 0.70710678118654757, 0.38268343236508984,
        0.0, -0.38268343236508984, -0.70710678118654757, -0.92387953251128674,
        -1.0, -0.92387953251128674, -0.70710678118654757, -0.38268343236508984,
        0.0, 0.38268343236508984, 0.70710678118654757, 0.92387953251128674};
    const double *x = r->of[0], *y = r->of[1], *xx = r->of[2], *xy = r->of[3], *yy = r->of[4];
    double most[RIM_LANES], cosine[RIM_LANES], sine[RIM_LANES];
    for (int i = 0; i < RIM_LANES; ++i) {
        most[i] = -1.0;
        cosine[i] = 1.0;
        sine[i] = 0.0;
    }
    for (int k = 0; k < RIM_SAMPLES; ++k) {
        double c = sampled_cos[k], s = sampled_cos[(k + 3 * RIM_SAMPLES / 4) % RIM_SAMPLES];
        for (int i = 0; i < RIM_LANES; ++i) {
            double px = x[i] + xx[i] * c + xy[i] * s, py = y[i] + xy[i] * c + yy[i] * s;
            double square = px * px + py * py;
            int is_more = square > most[i];
            most[i] = is_more ? square : most[i];
            cosine[i] = is_more ? c : cosine[i];
            sine[i] = is_more ? s : sine[i];
        }
    }
    for (int step = 0; step < NEWTON_STEPS; ++step)
        for (int i = 0; i < RIM_LANES; ++i) {
            double c = cosine[i], s = sine[i];
            double off_x = xx[i] * c + xy[i] * s, off_y = xy[i] * c + yy[i] * s;
            double px = x[i] + off_x, py = y[i] + off_y;
            double tx = xy[i] * c - xx[i] * s, ty = yy[i] * c - xy[i] * s;
            double second = tx * tx + ty * ty - px * off_x - py * off_y;
            int is_concave = second < 0.0;
            double turn = -(px * tx + py * ty) / (is_concave ? second : 1.0);
            turn = turn < NEWTON_STEP_RAD ? turn : NEWTON_STEP_RAD;
            turn = turn > -NEWTON_STEP_RAD ? turn : -NEWTON_STEP_RAD;
            turn = is_concave ? turn : 0.0;
            /* Series of cosine and sine, exact to 1e-14 for such steps. */
            double q = turn * turn;
            double turn_c
                = 1.0 - q / 2.0 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0)));
            double turn_s
                = turn
                  * (1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0))));
            cosine[i] = c * turn_c - s * turn_s;
            sine[i] = s * turn_c + c * turn_s;
        }
    for (int i = 0; i < RIM_LANES; ++i) {
        double px = x[i] + xx[i] * cosine[i] + xy[i] * sine[i];
        double py = y[i] + xy[i] * cosine[i] + yy[i] * sine[i];
        double square = px * px + py * py;
        radius_mm[i] = sqrt(square > most[i] ? square : most[i]);
    }
}

/* Ratios of the requested to the traced pupil on the axis, for several channels. */
INLINE void ratios_on_axis(const defocus_grid *axis, const grid_weights *w, double pupil_mm,
                           int64_t first, int64_t count, double *ratio) {
    rims r;
    double radius_mm[RIM_LANES];
    for (int lane = 0; lane < RIM_LANES; ++lane) {
        double values[N_VALUES];
        int64_t channel = first + (lane < count ? lane : 0);
        values_between(axis, w, 0, channel, values);
        set_rim(&r, lane, values, pupil_mm, 1.0);
    }
    circumscribed_mm(&r, radius_mm);
    for (int lane = 0; lane < RIM_LANES && lane < count; ++lane)
        ratio[lane] = 0.5 * pupil_mm / radius_mm[lane];
}

/* Factor of pupil coordinates; see `measured_residual.stretch_ratio`. */
INLINE double stretch_ratio(double pupil_ratio, double overshoot) {
    double beyond = pupil_ratio - 1.0;
    beyond = beyond > 0.0 ? beyond : 0.0;
    beyond = beyond < 2.0 * overshoot ? beyond : 2.0 * overshoot;
    double rim = pupil_ratio < 1.0 ? pupil_ratio : 1.0;
    return (rim + beyond - beyond * beyond / (4.0 * overshoot)) / pupil_ratio;
}

static void fill_defocus(const defocus_job *job) {
    const defocus_grid *field = &job->field, *axis = &job->axis;
    double *axis_ratio = job->scratch;
    double *field_share = axis_ratio + axis->channel_count;
    double *axis_share = field_share + field->accommodation_count;
    lagrange_weights(field->accommodations_dpt, field->accommodation_count,
                     job->accommodation_dpt, field_share);
    lagrange_weights(axis->accommodations_dpt, axis->accommodation_count,
                     job->accommodation_dpt, axis_share);
    grid_weights whole = weights_of_state(field, job->pupil_mm, field_share);
    grid_weights on_axis = weights_of_state(axis, job->pupil_mm, axis_share);
    for (int64_t channel = 0; channel < axis->channel_count; channel += RIM_LANES)
        ratios_on_axis(axis, &on_axis, job->pupil_mm, channel, axis->channel_count - channel,
                       axis_ratio + channel);
    for (int64_t first = 0; first < job->count; first += RIM_LANES) {
        double values[RIM_LANES][N_VALUES], fade[RIM_LANES], radius_mm[RIM_LANES];
        rims r;
        for (int lane = 0; lane < RIM_LANES; ++lane) {
            int64_t k = first + lane < job->count ? first + lane : job->count - 1;
            int64_t channel = job->channels[k];
            double own_mm = job->open_mm[k], ratio;
            if (own_mm < job->pupil_mm) {
                grid_weights own = weights_of_state(axis, own_mm, axis_share);
                ratios_on_axis(axis, &own, own_mm, channel, 1, &ratio);
                own = weights_of_state(field, own_mm, field_share);
                values_between(field, &own, job->fields[k], channel, values[lane]);
            } else {
                own_mm = job->pupil_mm;
                ratio = axis_ratio[channel];
                values_between(field, &whole, job->fields[k], channel, values[lane]);
            }
            set_rim(&r, lane, values[lane], own_mm, ratio);
            fade[lane] = stretch_ratio(0.5 * own_mm / job->fading_mm, job->overshoot);
        }
        circumscribed_mm(&r, radius_mm);
        for (int lane = 0; lane < RIM_LANES && first + lane < job->count; ++lane) {
            int64_t k = first + lane;
            double total = 0.0, radius_power = 1.0;
            double fading = fade[lane] * fade[lane], fading_power = fading;
            for (int d = 0; d < N_DEGREES; ++d) {
                double part = values[lane][d] + job->always[N_DEGREES * k + d]
                              + job->fading[N_DEGREES * k + d] * fading_power;
                total += part * radius_power;
                fading_power *= fading;
                radius_power *= radius_mm[lane] * radius_mm[lane];
            }
            job->found_dpt[k] = -job->sphere_per_c20 * total;
        }
    }
}

#endif
