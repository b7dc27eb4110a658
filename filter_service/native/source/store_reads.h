/* Interpolation of cached kernels for a state of the eye.  Two nodes of defocus are read for
 * each neighbor in pupil and accommodation. */
#ifndef OCU_STORE_READS_H
#define OCU_STORE_READS_H

#include "bounds.h"
#include "constants.h"
#include "kernel_job.h"

/* Share of a node below which it is not read. */
#define NODE_SHARE 1e-7

/* Returns the upper node of a total defocus t, and its share; the lower node is the one before,
 * or the same.  The search is linear from `upper`, the node of the previous, smaller t, which
 * mostly is the result.  The processor would mispredict half of the branches of a binary
 * search. */
INLINE int64_t bracket(const store_tables *tables, int64_t group, double t, int64_t upper,
                       double *share) {
    const double *values_dpt = tables->values_dpt;
    int64_t first = tables->starts[group], last = tables->starts[group + 1] - 1;
    t = clipped(t, values_dpt[first], values_dpt[last]);
    if (upper < first + 1) upper = first + 1;
    if (upper > last) upper = last;
    while (upper < last && values_dpt[upper] < t) ++upper;
    double low_dpt = values_dpt[upper > first ? upper - 1 : first];
    double span_dpt = values_dpt[upper] - low_dpt;
    *share = clipped((t - low_dpt) / (span_dpt > 0.0 ? span_dpt : 1.0), 0.0, 1.0);
    /* At a node, rounding must not read its neighbor, too. */
    if (*share < NODE_SHARE) *share = 0.0;
    if (*share > 1.0 - NODE_SHARE) *share = 1.0;
    return upper;
}

/* Writes the PSFs and weights (2 count,) of one channel at a total defocus.  `uppers` (count,)
 * has the upper nodes of a smaller total defocus, or the groups' first; updated. */
INLINE void channel_taps(const store_tables *tables, const state_reads *reads, int64_t field,
                         int channel, double total_dpt, int64_t *uppers, int64_t *psfs,
                         double *weights) {
    for (int64_t corner = 0; corner < reads->count; ++corner) {
        int64_t group = reads->groups[corner] + field;
        double share, t = total_dpt * reads->scales[corner]
                          - tables->channel_shift_dpt[RGB * group + channel];
        int64_t upper = bracket(tables, group, t, uppers[corner], &share);
        int64_t lower = upper > tables->starts[group] ? upper - 1 : upper;
        uppers[corner] = upper;
        psfs[2 * corner] = RGB * lower + channel;
        psfs[2 * corner + 1] = RGB * upper + channel;
        weights[2 * corner] = reads->weights[corner] * (1.0 - share);
        weights[2 * corner + 1] = reads->weights[corner] * share;
    }
}

#endif
