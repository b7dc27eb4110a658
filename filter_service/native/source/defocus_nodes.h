/* Nodes of total defocus of a plan: how many each range needs, where they are, and their
 * geometric blur.  Twin of the first: `error_law.allowed_difference_px`. */

#include <math.h>
#include <stdint.h>

#include "node_job.h"
#include "vectors.h"

#define MOST_ITERATIONS 24
#define ENOUGH_CHANGE 1e-4    /* relative, of the squared difference: ends the iteration */

/* Squared difference between neighbors, px2, that causes the error; starts from a guess. */
INLINE double allowed_difference_px2(const node_job *job, const double *covariance, double x,
                                     double unit_px2, double scale, double px2) {
    const double *c = covariance;
    double xx = c[0] + x * (c[1] + x * c[2]);
    double yy = c[3] + x * (c[4] + x * c[5]);
    double xy = c[6] + x * (c[7] + x * c[8]);
    for (int i = 0; i < MOST_ITERATIONS; ++i) {
        double more = unit_px2 + job->own_share * px2;
        double square = (xx + more) * (yy + more) - xy * xy, least = more * more;
        double before = px2;
        px2 = scale * pow(sqrt(square > least ? square : least), job->blur_exponent);
        if (fabs(px2 - before) <= ENOUGH_CHANGE * px2) break;
    }
    return px2;
}

/* Writes the number of intervals that are needed up to each sample of the ranges. */
static void needed_intervals(const node_job *job) {
    int64_t n_steps = job->n_samples - 1;
    for (int64_t k = 0; k < job->n; ++k) {
        int64_t group = job->groups[k];
        const double *own = job->covariance + 12 * group;
        double unit_px2 = job->diffraction_share * (job->unit_px[group] * job->unit_px[group])
                          + job->sharp_px * job->sharp_px;
        double step_dpt = (job->highs[k] - job->lows[k]) / (double)n_steps;
        double moved_px = sqrt(own[9]) * step_dpt;
        double *needed = job->needed + k * job->n_samples;
        needed[0] = 0.0;
        double last_px2 = 0.0;
        for (int64_t i = 0; i < n_steps; ++i) {
            double least_px2 = INFINITY;
            double middle_dpt = job->lows[k] + step_dpt * ((double)i + 0.5);
            for (int64_t s = 0; s < job->n_shifts; ++s)
                for (int64_t focus = 0; focus < job->n_foci; ++focus) {
                    double x = middle_dpt + job->shifts_dpt[s * job->n + k]
                               - job->foci_dpt[focus];
                    double light = job->light_ratio[focus * job->n_groups + group];
                    double scale = job->error / light / job->doubling;
                    last_px2 = allowed_difference_px2(job, own, x, unit_px2, scale, last_px2);
                    least_px2 = least_px2 < last_px2 ? least_px2 : last_px2;
                }
            needed[i + 1] = needed[i] + moved_px / sqrt(least_px2);
        }
    }
}

/* Distributes the nodes of n ranges by the intervals that are needed up to each sample.
 * counts: nodes of each range, with at least one; reduced where ends differ by a rounding
 * error.  Returns the number of nodes. */
static int64_t spread_nodes(const double *lows, const double *highs, const double *needed,
                            int64_t *counts, double *nodes, int64_t n, int64_t n_samples) {
    double *to = nodes;
    for (int64_t k = 0; k < n; ++k, needed += n_samples) {
        double low = lows[k], high = highs[k], all = needed[n_samples - 1];
        double *first = to;
        *to++ = low;
        int64_t step = 0;
        for (int64_t i = 1; i < counts[k]; ++i) {
            double value = high;
            if (i < counts[k] - 1) {
                double wanted = all * (double)i / (double)(counts[k] - 1);
                while (step < n_samples - 2 && needed[step + 1] < wanted) ++step;
                double rise = needed[step + 1] - needed[step];
                double share = rise > 0.0 ? (wanted - needed[step]) / rise : 0.0;
                value = low + (high - low) * ((double)step + share) / (double)(n_samples - 1);
            }
            if (value > to[-1]) *to++ = value;
        }
        counts[k] = to - first;
    }
    return to - nodes;
}

/* Square of the largest distance of landing points that are linear in defocus: rows of n
 * abscissas, then of ordinates. */
INLINE double farthest_square(const double *zero_px, const double *per_dpt, int64_t n,
                              double dpt) {
    double most[4] = {0.0, 0.0, 0.0, 0.0};
    int64_t i = 0;
    for (; i + 4 <= n; i += 4)
        for (int j = 0; j < 4; ++j) {
            double x = zero_px[i + j] + dpt * per_dpt[i + j];
            double y = zero_px[n + i + j] + dpt * per_dpt[n + i + j];
            double square = x * x + y * y;
            most[j] = most[j] > square ? most[j] : square;
        }
    for (; i < n; ++i) {
        double x = zero_px[i] + dpt * per_dpt[i], y = zero_px[n + i] + dpt * per_dpt[n + i];
        double square = x * x + y * y;
        most[0] = most[0] > square ? most[0] : square;
    }
    for (int j = 1; j < 4; ++j) most[0] = most[0] > most[j] ? most[0] : most[j];
    return most[0];
}

/* Blur radii, px, of the nodes of groups: the largest distance of rays from the chief ray,
 * of the nearest focus.
 *
 * zero_px, per_dpt: (n_groups, 2, n_rays), landing points of rays; shift_dpt: (n_groups, 3);
 * foci_dpt: (3, n_foci), infinity for unused entries; blur_px: (n_nodes, 3). */
static void node_blur(const double *zero_px, const double *per_dpt, const double *values_dpt,
                      const int64_t *starts, const double *shift_dpt, const double *foci_dpt,
                      float *blur_px, int64_t n_groups, int64_t n_rays, int64_t n_foci) {
    for (int64_t group = 0; group < n_groups; ++group)
        for (int64_t node = starts[group]; node < starts[group + 1]; ++node)
            for (int channel = 0; channel < 3; ++channel) {
                double t = values_dpt[node] + shift_dpt[3 * group + channel];
                double least = INFINITY;
                for (int64_t focus = 0; focus < n_foci; ++focus) {
                    double away_dpt = t - foci_dpt[channel * n_foci + focus];
                    if (!isfinite(away_dpt)) continue;
                    double found = farthest_square(zero_px + 2 * n_rays * group,
                                                   per_dpt + 2 * n_rays * group, n_rays,
                                                   away_dpt);
                    least = least < found ? least : found;
                }
                blur_px[3 * node + channel] = (float)sqrt(least);
            }
}
