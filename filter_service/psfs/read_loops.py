"""Compiled loops over field nodes and layers that interpolate the cache for a state.

They read two nodes of defocus for each neighbor in pupil and accommodation.  Arrays
have a few thousand entries, and the loops run once per frame whose pupil or focus has
changed.
"""

from numba import njit

from filter_service.constants import RGB


@njit(cache=True, nogil=True, error_model="numpy")
def clipped(value, low, high):
    """Clip a value to a range."""
    return min(max(value, low), high)


@njit(cache=True, nogil=True, error_model="numpy")
def bracket(tables, group, t, start):
    """Return the lower and upper node of a total defocus, and the share of the upper.

    The result is that of `RaggedNodes.bracket`.  The search is linear from ``start``,
    the upper node of the previous, smaller t, which mostly is the result.  The
    processor would mispredict half of the branches of a binary search.
    """
    values_dpt = tables.values_dpt
    first, last = tables.starts[group], tables.starts[group + 1] - 1
    t = clipped(t, values_dpt[first], values_dpt[last])
    upper = max(start, min(first + 1, last))
    while upper < last and values_dpt[upper] < t:
        upper += 1
    lower = max(upper - 1, first)
    span = values_dpt[upper] - values_dpt[lower]
    share = (t - values_dpt[lower]) / (span if span > 0.0 else 1.0)
    return lower, upper, clipped(share, 0.0, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def channel_taps(tables, reads, field, channel, total_dpt, uppers, psfs, weights):
    """Write the PSFs and weights (2 n_corners,) of one channel at a total defocus.

    Parameters
    ----------
    field : int
        Index of the field node.
    uppers : (n_corners,)
        Upper nodes of a smaller total defocus, or the groups' first; updated.
    """
    for corner in range(reads.groups.size):
        own = reads.groups[corner] + field
        t = total_dpt * reads.scales[corner] - tables.channel_shift_dpt[own, channel]
        lower, upper, share = bracket(tables, own, t, uppers[corner])
        uppers[corner] = upper
        psfs[2 * corner] = RGB * lower + channel
        psfs[2 * corner + 1] = RGB * upper + channel
        weights[2 * corner] = reads.weights[corner] * (1.0 - share)
        weights[2 * corner + 1] = reads.weights[corner] * share
