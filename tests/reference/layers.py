"""Places of a frame's layers, from the formulas."""

import numpy as np


def step_curve(blur_px, at_dpt, *, blur_ratio, px_per_dpt):
    """Layers needed up to each vergence (n,), for blur (n, n_fields * 3).

    A layer for each blur step of the channel and field with the most, and at least one
    for two blur steps of a perfect eye, or 0.25 dpt where its blur changes faster.
    """
    least_px = np.minimum(blur_px[:-1], blur_px[1:])
    step_px = np.maximum(blur_ratio * least_px, 0.25)
    steps = (np.abs(np.diff(blur_px, axis=0)) / step_px).max(axis=1)
    gap_dpt = 2.0 * blur_ratio * least_px.min(axis=1) / px_per_dpt
    gaps = np.diff(at_dpt) / np.maximum(gap_dpt, 0.25)
    return np.append(0.0, np.cumsum(np.maximum(steps, gaps)))


def layer_distances_dpt(steps_at, range_dpt, ends_dpt, known_dpt, *, step_dpt=0.25):
    """Layers at whole numbers of steps, and at ends, which replace layers beside them.

    Parameters
    ----------
    steps_at : callable
        Number of steps up to vergences (n,), read at the ends, at ``known_dpt`` and
        every ``step_dpt``.
    """
    low_dpt, high_dpt = range_dpt
    ends = {low_dpt, high_dpt, *(end for end in ends_dpt if low_dpt < end < high_dpt)}
    known = {end for end in known_dpt if low_dpt < end < high_dpt}
    at_dpt = np.array(sorted({*np.arange(low_dpt, high_dpt, step_dpt), *ends, *known}))
    steps = steps_at(at_dpt)
    whole = np.arange(np.ceil(steps[0]), steps[-1])
    at_ends = np.interp(sorted(ends), at_dpt, steps)
    whole = whole[np.abs(whole[:, None] - at_ends).min(axis=1) > 1e-3]
    return np.array(sorted({*np.interp(whole, steps, at_dpt), *ends}))
