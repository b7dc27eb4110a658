"""Placement of nodes along one axis: denser where PSFs change faster or are sharper.

Nodes are spread so that blending errs equally between all neighbors, and their number
is the smallest that meets the axis's share of the tolerance.  As errors fall with the
same power of the number of nodes on each axis, equal shares minimize the product.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.planning.error_law import (
    allowed_difference_px,
    half_way_error,
    mean_square,
    spot_covariance,
)
from filter_service.planning.grid import GridSpec
from filter_service.planning.sampled_use import (
    Use,
    axis_error,
    axis_errors,
    focus_slopes_px,
    light_of_foci,
    moved,
)

TOLERANCE_DB = {"loose": 47.0, "normal": 53.0, "fine": 56.0}
"""Lowest PSNR after interpolation, averaged over states by the error law, in both
modes.  `error_law.FLOOR` is 57.4 dB.  In encoded images, 95 % of blocks of 32x32 pixels
keep 39.0, 44.1 and 46.3 dB, and the median block 45.2, 49.9 and 52.3 dB
(`bench_levels`, six eyes, 320x180)."""

MAX_NODES = 64
"""Largest number of nodes on one axis, except defocus."""

COUNTS_AT_ONCE = 3
"""Node counts evaluated in one call of the eye, which takes at least 12 ms."""

STATE_AXES = ("pupil", "accommodation")
"""Axes that may have a single node, in the middle of a narrow range; frames read it at
their own defocus.  The field has at least two."""

_LADDER = 33
_STATES_ON_LADDER = 16


def target_error(spec: GridSpec) -> float:
    """Return the mean square error that interpolation may cause in total."""
    return 10.0 ** (-TOLERANCE_DB[spec.settings.tolerance] / 10.0)


def axis_nodes(
    use: Use, axis: str, range_: tuple[float, float], *, allowed_error: float
) -> tuple[NDArray[np.float64], float]:
    """Return the nodes (n,) of one axis over its whole range, and their error.

    Parameters
    ----------
    range_ : (low, high)
        Range of the axis; low < high.
    allowed_error : float
        Mean square error to meet with as few nodes as possible.
    """
    low, high = range_
    ladder = np.linspace(low, high, _LADDER)
    needed = _needed_over_ladder(use, axis, ladder, allowed_error)
    if axis in STATE_AXES:
        middle = np.interp([0.5 * needed[-1]], needed, ladder)
        error = axis_error(use, axis, middle)
        if error <= allowed_error:
            return middle, error
    count = 1 + min(max(1, math.floor(0.8 * needed[-1])), MAX_NODES - 1)
    while True:
        counts = range(count, min(count + COUNTS_AT_ONCE, MAX_NODES + 1))
        choices = [
            np.interp(np.linspace(0.0, needed[-1], n), needed, ladder) for n in counts
        ]
        errors = axis_errors(use, axis, choices)
        for nodes, error in zip(choices, errors, strict=True):
            if error <= allowed_error or nodes.size >= MAX_NODES:
                return nodes, error
        # The error falls with the fourth power of the number of intervals, slightly
        # slower where rays do not move in proportion; do not overshoot.
        grown = (counts[-1] - 1) * (errors[-1] / allowed_error) ** 0.25
        count = min(max(counts[-1] + 1, 1 + math.floor(0.9 * grown)), MAX_NODES)


def _needed_over_ladder(
    use: Use, axis: str, ladder: NDArray[Any], allowed_error: float
) -> NDArray[np.float64]:
    """Return the number of intervals needed up to each step of a ladder."""
    count = min(_STATES_ON_LADDER, use.vergence_dpt.size)
    some = use.taken(np.arange(count))
    repeated = use.taken(np.tile(np.arange(count), ladder.size))
    states = moved(repeated, axis, np.repeat(ladder, count))
    power = np.zeros((ladder.size - 1, count))
    for light_ratio, added_dpt in light_of_foci(some):
        slopes = focus_slopes_px(some, states, np.tile(added_dpt, ladder.size))
        slopes = slopes.reshape(ladder.size, count, *slopes.shape[1:])
        difference_px = np.sqrt(mean_square(np.diff(slopes, axis=0)))
        allowed_px = allowed_difference_px(
            spot_covariance(0.5 * (slopes[1:] + slopes[:-1])),
            unit_px=some.unit_px,
            half_way_error=half_way_error(axis, allowed_error),
        )
        # The mean square error grows with the fourth power of the difference.
        power += light_ratio**2 * (difference_px / allowed_px) ** 4
    dense = power.mean(axis=1) ** 0.25
    return np.concatenate([[0.0], np.cumsum(dense + 0.1 * dense.mean() + 1e-12)])
