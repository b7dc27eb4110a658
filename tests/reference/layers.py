"""Places of a frame's layers, from the formulas."""

import math
from itertools import pairwise

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


def layer_distances_dpt(steps_at, range_dpt, ends_dpt, *, step_dpt=0.25):
    """Layers at equal parts of the steps between ends, at most one step apart.

    Parameters
    ----------
    steps_at : callable
        Number of steps up to vergences (n,), read at the ends and every ``step_dpt``.
    """
    low_dpt, high_dpt = range_dpt
    inside = {end for end in ends_dpt if low_dpt < end < high_dpt}
    count = 1 + math.ceil((high_dpt - low_dpt) / step_dpt - 1e-9)
    at_dpt = np.array(sorted({*np.linspace(low_dpt, high_dpt, count), *inside}))
    steps = steps_at(at_dpt)
    layers_dpt = [np.array([low_dpt])]
    stops = np.interp([low_dpt, *sorted(inside), high_dpt], at_dpt, steps)
    for first, last in pairwise(stops):
        parts = max(math.ceil(last - first - 1e-9), 1)
        wanted = np.linspace(first, last, parts + 1)[1:]
        layers_dpt.append(np.interp(wanted, steps, at_dpt))
    return np.concatenate(layers_dpt)
