"""Placement of nodes along one axis: denser where PSFs change faster or are sharper.

The blending error is the same in all intervals, and the number of nodes is the smallest
that meets the axis's share of the tolerance.  The error of each axis falls with the
same power of its number of nodes, so equal shares minimize the number of PSFs.
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
from filter_service.planning.state_samples import (
    StateSample,
    axis_error,
    axis_errors,
    focus_light,
    focus_slopes_px,
    moved,
)

TOLERANCE_DB = {"loose": 47.0, "normal": 53.0, "fine": 56.0}
"""Lowest PSNR after interpolation, predicted by the error law as a mean over states, in
both modes.  `error_law.FLOOR` is 57.4 dB.  In encoded images, 95 % of blocks of 32x32
pixels keep 39.0, 44.1 and 46.3 dB, and the median block 45.2, 49.9 and 52.3 dB
(`bench_levels`, six eyes, 320x180)."""

MAX_NODES = 64
"""Largest number of nodes on one axis, except defocus."""

COUNTS_AT_ONCE = 3
"""Number of node counts evaluated per call of the eye, which takes at least 12 ms."""

STATE_AXES = ("pupil", "accommodation")
"""Axes that may have a single node, in the middle of a narrow range.  Frames read it at
their own defocus.  Each axis of the field has at least two nodes."""

_SAMPLES = 33
_STATES_PER_SAMPLE = 16


def target_error(spec: GridSpec) -> float:
    """Return the mean square error that interpolation may cause in total."""
    return 10.0 ** (-TOLERANCE_DB[spec.settings.tolerance] / 10.0)


def axis_nodes(
    sample: StateSample, axis: str, range_: tuple[float, float], *, allowed_error: float
) -> tuple[NDArray[np.float64], float]:
    """Return the nodes (n,) of one axis over its range, and their mean square error.

    Parameters
    ----------
    range_ : (low, high)
        Range of the axis; low < high.
    allowed_error : float
        Largest mean square error.
    """
    low, high = range_
    samples = np.linspace(low, high, _SAMPLES)
    needed = _needed_intervals(sample, axis, samples, allowed_error)
    if axis in STATE_AXES:
        middle = np.interp([0.5 * needed[-1]], needed, samples)
        error = axis_error(sample, axis, middle)
        if error <= allowed_error:
            return middle, error
    count = 1 + min(max(1, math.floor(0.8 * needed[-1])), MAX_NODES - 1)
    while True:
        counts = range(count, min(count + COUNTS_AT_ONCE, MAX_NODES + 1))
        choices = [
            np.interp(np.linspace(0.0, needed[-1], n), needed, samples) for n in counts
        ]
        errors = axis_errors(sample, axis, choices)
        for nodes, error in zip(choices, errors, strict=True):
            if error <= allowed_error or nodes.size >= MAX_NODES:
                return nodes, error
        # The error falls with the fourth power of the number of intervals, and slightly
        # slower where rays do not move in proportion.  0.9 avoids too many nodes.
        grown = (counts[-1] - 1) * (errors[-1] / allowed_error) ** 0.25
        count = min(max(counts[-1] + 1, 1 + math.floor(0.9 * grown)), MAX_NODES)


def _needed_intervals(
    sample: StateSample, axis: str, samples: NDArray[Any], allowed_error: float
) -> NDArray[np.float64]:
    """Return the number of intervals needed up to each sample of the axis."""
    count = min(_STATES_PER_SAMPLE, sample.vergence_dpt.size)
    some = sample.select(np.arange(count))
    repeated = sample.select(np.tile(np.arange(count), samples.size))
    states = moved(repeated, axis, np.repeat(samples, count))
    power = np.zeros((samples.size - 1, count))
    for light_ratio, added_dpt in focus_light(some):
        slopes = focus_slopes_px(some, states, np.tile(added_dpt, samples.size))
        slopes = slopes.reshape(samples.size, count, *slopes.shape[1:])
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
