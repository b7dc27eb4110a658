/* Layers of a frame, placed once for each new state.
 *
 * The number of layers that a state needs between two vergences is found for the nodes of
 * pupil and accommodation, which many frames share, and interpolated between them. */

#include <math.h>

#include "store_reads.h"

/* Steps from an end within which there is no other layer: in 32-bit floats, a narrower
 * interval would have no width.  Omitting a layer there moves light by a thousandth of the
 * error between layers. */
#define SAME_STEP 1e-3

/* Adds the blur radius, px, of a channel at n ascending layers; zero_dpt is the total defocus
 * of the channel at 0 dpt.  Blur is linear between nodes, so that each interval of nodes takes
 * one division. */
static void add_blur_row(const store_tables *tables, const state_reads *reads, int64_t field,
                         int channel, double zero_dpt, const double *at_dpt, int64_t n,
                         double *row_px) {
    const double *values_dpt = tables->values_dpt;
    const float *blur_px = tables->blur_px + channel;
    for (int64_t corner = 0; corner < reads->count; ++corner) {
        int64_t group = reads->groups[corner] + field;
        double weight = reads->weights[corner], scale = reads->scales[corner];
        double offset_dpt
            = zero_dpt * scale - tables->channel_shift_dpt[RGB * group + channel];
        int64_t node = tables->starts[group], last = tables->starts[group + 1] - 1, k = 0;
        double first_px = weight * (double)blur_px[RGB * node];
        for (; k < n && at_dpt[k] * scale + offset_dpt <= values_dpt[node]; ++k)
            row_px[k] += first_px;
        while (k < n) {
            double t = at_dpt[k] * scale + offset_dpt;
            while (node < last && values_dpt[node + 1] < t) ++node;
            if (node == last) break;
            double low_dpt = values_dpt[node], high_dpt = values_dpt[node + 1];
            double low_px = weight * (double)blur_px[RGB * node];
            double high_px = weight * (double)blur_px[RGB * (node + 1)];
            double slope = (high_px - low_px) / (high_dpt - low_dpt);
            while (t <= high_dpt) {
                row_px[k] += low_px + slope * (t - low_dpt);
                if (++k == n) break;
                t = at_dpt[k] * scale + offset_dpt;
            }
        }
        double last_px = weight * (double)blur_px[RGB * last];
        for (; k < n; ++k) row_px[k] += last_px;
    }
}

/* Blur radii (n_fields, 3, n), px, of n ascending layers; zero_dpt is (n_fields, 3). */
static void layer_blur(const store_tables *tables, const state_reads *reads,
                       const double *zero_dpt, const double *at_dpt, double *found_px,
                       int64_t n_fields, int64_t n) {
    for (int64_t i = 0; i < RGB * n_fields * n; ++i) found_px[i] = 0.0;
    for (int64_t row = 0; row < RGB * n_fields; ++row)
        add_blur_row(tables, reads, row / RGB, (int)(row % RGB), zero_dpt[row], at_dpt, n,
                     found_px + row * n);
}

/* Number of layers that a state needs up to each of n ascending vergences: the first row of
 * steps_before (4, n), whose other rows are scratch.
 *
 * Layers are one blur step apart: a share of the blur radius, but at least least_step_px.  Where
 * blur changes little, the gap between them has gap_ratio of the blur, in diopters of a perfect
 * eye, but at least least_gap_dpt. */
static void step_curve(const store_tables *tables, const state_reads *reads,
                       const double *zero_dpt, const double *at_dpt, double *steps_before,
                       int64_t n_fields, int64_t n, double blur_ratio, double least_step_px,
                       double gap_ratio, double px_per_dpt, double least_gap_dpt) {
    /* Over all fields and channels: the largest number of blur steps up to the next vergence,
     * and the smallest blur. */
    double *most_steps = steps_before + n, *least_px = most_steps + n, *row_px = least_px + n;
    for (int64_t k = 0; k < n; ++k) {
        most_steps[k] = 0.0;
        least_px[k] = INFINITY;
    }
    for (int64_t row = 0; row < RGB * n_fields; ++row) {
        for (int64_t k = 0; k < n; ++k) row_px[k] = 0.0;
        add_blur_row(tables, reads, row / RGB, (int)(row % RGB), zero_dpt[row], at_dpt, n,
                     row_px);
        for (int64_t k = 0; k + 1 < n; ++k) {
            double lesser_px = at_most(row_px[k], row_px[k + 1]);
            double step_px = at_least(blur_ratio * lesser_px, least_step_px);
            double steps = fabs(row_px[k + 1] - row_px[k]) / step_px;
            most_steps[k] = at_least(most_steps[k], steps);
        }
        for (int64_t k = 0; k < n; ++k) least_px[k] = at_most(least_px[k], row_px[k]);
    }
    steps_before[0] = 0.0;
    for (int64_t k = 0; k + 1 < n; ++k) {
        double gap_px = gap_ratio * at_most(least_px[k], least_px[k + 1]);
        double gap_dpt = at_least(gap_px / px_per_dpt, least_gap_dpt);
        double steps = at_least(most_steps[k], (at_dpt[k + 1] - at_dpt[k]) / gap_dpt);
        steps_before[k + 1] = steps_before[k] + steps;
    }
}

/* Number of layers up to each of n vergences: the mean of the curves of the nodes around a
 * state, relative to the pace.  zero_dpt is the total defocus of the eye at 0 dpt. */
static void steps_of_state(const double *curves, const int64_t *starts, const double *scales,
                           const double *weights, const double *at_dpt, double *steps_before,
                           int64_t corner_count, int64_t n, double zero_dpt, double pace) {
    int64_t whole = starts[corner_count];
    for (int64_t i = 0; i < n; ++i) steps_before[i] = 0.0;
    for (int64_t corner = 0; corner < corner_count; ++corner) {
        const double *total_dpt = curves + starts[corner], *steps = total_dpt + whole;
        int64_t last = starts[corner + 1] - starts[corner] - 2, k = 0;
        for (int64_t i = 0; i < n; ++i) {
            double t = (at_dpt[i] + zero_dpt) * scales[corner];
            while (k < last && total_dpt[k + 1] < t) ++k;
            /* A line through the first or last two points goes on beyond them. */
            double share = (t - total_dpt[k]) / (total_dpt[k + 1] - total_dpt[k]);
            double found = steps[k] + share * (steps[k + 1] - steps[k]);
            steps_before[i] += found * weights[corner] / pace;
        }
    }
}

/* Layers of a state: at whole numbers of steps, and at the ascending ends, which are places in
 * at_dpt.  They move continuously with the state: a layer appears and vanishes at an end.
 * Returns their number, and writes them if there is room; steps_before (n,) is scratch. */
static int64_t layers_of_state(const double *curves, const int64_t *starts,
                               const double *scales, const double *weights,
                               const double *at_dpt, double *steps_before,
                               int64_t corner_count, int64_t n, double zero_dpt, double pace,
                               const int64_t *ends, int64_t end_count, double *found_dpt,
                               int64_t room) {
    steps_of_state(curves, starts, scales, weights, at_dpt, steps_before, corner_count, n,
                   zero_dpt, pace);
    int64_t count = 0, place = 0;
    for (int64_t e = 0; e < end_count; ++e) {
        double high = steps_before[ends[e]] - SAME_STEP;
        for (double whole = floor(steps_before[place] + SAME_STEP) + 1.0; whole < high;
             whole += 1.0) {
            while (steps_before[place + 1] < whole) ++place;
            double share = (whole - steps_before[place])
                           / (steps_before[place + 1] - steps_before[place]);
            if (count < room)
                found_dpt[count] = at_dpt[place] + share * (at_dpt[place + 1] - at_dpt[place]);
            ++count;
        }
        place = ends[e];
        if (count < room) found_dpt[count] = at_dpt[place];
        ++count;
    }
    return count;
}
