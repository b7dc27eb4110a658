"""Where the planned nodes lie: closer where PSFs change faster and blur hides less.

Along each axis nodes are spread so that blending errs equally between all neighbours,
and as many are taken as the axis' share of the tolerance needs.  With errors that fall
as the same power of the number of nodes, equal shares make the smallest product.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from filter_service.planning.error_law import (
    AXIS_FACTOR,
    MEAN_OF_HALF_WAY,
    allowed_difference_px,
    mean_square,
    spot_covariance,
)
from filter_service.planning.grid import GridSpec
from filter_service.planning.nodes import RaggedNodes
from filter_service.planning.sampled_use import Use, axis_error, moved
from filter_service.planning.slopes import PupilStates, slopes_px, state_frames

TOLERANCE_DB = {"loose": 43.0, "normal": 49.0, "fine": 55.0}
"""PSNR that interpolation may cost down to.  Frames planned for 49 dB, unmerged,
have 46.8 to 50.1 dB at 640x360 (six eyes) and 44.8 to 47.1 dB at 320x180 (four eyes),
where a pixel holds more contrast than those that the law was fitted to."""

QUALITY_GAIN_DB = 3.0
"""What the mode for still eyes gives on top of it."""

MAX_NODES = 64
"""On one axis but defocus."""

_LADDER = 33
_STATES_ON_LADDER = 16
_DEFOCUS_LADDER = 49

_LARGEST_RATIO = 0.86
"""Of the largest kernel: how far rays may land; diffraction and the rim lie beyond."""


def target_error(spec: GridSpec) -> float:
    """Mean square error that interpolation may make in all."""
    gain_db = QUALITY_GAIN_DB if spec.settings.mode == "quality" else 0.0
    wanted_db = TOLERANCE_DB[spec.settings.tolerance] + gain_db
    return 10.0 ** (-wanted_db / 10.0)


def axis_nodes(
    use: Use, axis: str, range_: tuple[float, float], *, allowed_error: float
) -> tuple[NDArray[np.float64], float]:
    """Nodes (n,) of one axis from end to end of its range, and their error.

    Parameters
    ----------
    range_ : (low, high)
        Not a point.
    allowed_error : float
        Mean square error that as few nodes as possible must meet.
    """
    low, high = range_
    ladder = np.linspace(low, high, _LADDER)
    needed = _needed_over_ladder(use, axis, ladder, allowed_error)
    count = 1 + min(max(1, math.floor(0.8 * needed[-1])), MAX_NODES - 1)
    while True:
        nodes = np.interp(np.linspace(0.0, needed[-1], count), needed, ladder)
        error = axis_error(use, axis, nodes)
        if error <= allowed_error or count >= MAX_NODES:
            return nodes, error
        # The error falls as the fourth power of the intervals, a little slower where
        # rays do not move in proportion; do not overshoot.
        grown = (count - 1) * (error / allowed_error) ** 0.25
        count = min(max(count + 1, 1 + math.floor(0.9 * grown)), MAX_NODES)


def _half_way_error(axis: str, allowed_error: float) -> float:
    """RMS error by the law half-way between nodes that makes a mean square error."""
    return math.sqrt(allowed_error / MEAN_OF_HALF_WAY / AXIS_FACTOR[axis])


def _needed_over_ladder(
    use: Use, axis: str, ladder: NDArray, allowed_error: float
) -> NDArray[np.float64]:
    """Intervals needed up to each step of a ladder along an axis."""
    count = min(_STATES_ON_LADDER, use.vergence_dpt.size)
    some = use.taken(np.arange(count))
    repeated = use.taken(np.tile(np.arange(count), ladder.size))
    states = moved(repeated, axis, np.repeat(ladder, count))
    frames = state_frames(
        use.eye, use.spec, states, pixel_from_mrad=repeated.pixel_from_mrad
    )
    slopes = slopes_px(frames)
    slopes = slopes.reshape(ladder.size, count, *slopes.shape[1:])
    difference_px = np.sqrt(mean_square(np.diff(slopes, axis=0)))
    allowed_px = allowed_difference_px(
        spot_covariance(0.5 * (slopes[1:] + slopes[:-1])),
        unit_px=some.unit_px,
        half_way_error=_half_way_error(axis, allowed_error),
    )
    # The mean square error goes with the fourth power of the difference.
    dense = np.mean((difference_px / allowed_px) ** 4, axis=1) ** 0.25
    return np.concatenate([[0.0], np.cumsum(dense + 0.1 * dense.mean() + 1e-12)])


def limited_ranges_dpt(
    eye: EyeOptics, spec: GridSpec, groups: PupilStates, ranges_dpt: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ranges (P, 2) without the defocus whose kernels would be too large.

    A range that holds no kernel small enough becomes the defocus of its smallest, with
    the ratio (P,) by which that has to shrink.  On the axis it stays as it is, to be
    refused with numbers when it is computed: what the eye looks at is never drawn so.
    """
    lows, highs = ranges_dpt.T
    columns = vars(groups.taken(np.tile(np.arange(lows.size), 2)))
    columns["total_defocus_dpt"] = np.concatenate([lows, lows + 1.0])
    low_px, above_px = np.split(
        slopes_px(state_frames(eye, spec, PupilStates(**columns))), 2
    )
    per_dpt = above_px - low_px
    # |low + x per|² = limit², ray by ray; all of them must stay within.
    a = np.maximum((per_dpt**2).sum(axis=-1), 1e-12)
    half_b = (low_px * per_dpt).sum(axis=-1)
    limit_px = _LARGEST_RATIO * spec.max_blur_radius_px
    room = half_b**2 - a * ((low_px**2).sum(axis=-1) - limit_px**2)
    reach = np.sqrt(np.maximum(room, 0.0))
    first_dpt = lows + ((-half_b - reach) / a).max(axis=1)
    last_dpt = lows + ((-half_b + reach) / a).min(axis=1)
    fits = (room > 0.0).all(axis=1) & (
        np.maximum(first_dpt, lows) <= np.minimum(last_dpt, highs)
    )
    limited_dpt = np.where(
        fits[:, None],
        np.stack([np.maximum(first_dpt, lows), np.minimum(last_dpt, highs)], axis=-1),
        ranges_dpt,
    )
    away_deg = np.hypot(groups.h_deg, groups.v_deg)
    shrunk = np.flatnonzero(~fits & (away_deg > away_deg.min() + 1e-9))
    ratio = np.ones(lows.size)
    if shrunk.size:
        steps = np.linspace(0.0, 1.0, _DEFOCUS_LADDER)[:, None, None, None]
        at_dpt = steps * (highs - lows)[shrunk, None, None]
        slopes = low_px[shrunk] + at_dpt * per_dpt[shrunk]
        largest_px = np.sqrt((slopes**2).sum(axis=-1)).max(axis=-1)
        best = largest_px.argmin(axis=0)
        at = np.arange(shrunk.size)
        limited_dpt[shrunk] = (lows[shrunk] + at_dpt[best, at, 0, 0])[:, None]
        ratio[shrunk] = limit_px / largest_px[best, at]
    return limited_dpt, ratio


def defocus_groups(
    eye: EyeOptics,
    spec: GridSpec,
    groups: PupilStates,
    ranges_dpt: NDArray[np.float64],
    *,
    allowed_error: float,
    unit_px: NDArray[np.float64],
) -> RaggedNodes:
    """Nodes of total defocus of every group, for a mean square error.

    Parameters
    ----------
    groups : PupilStates
        Field, pupil, accommodation and wavelength of each group (P,).
    ranges_dpt : (P, 2)
        Total defocus from end to end.
    unit_px : (P,)
        lambda / pupil diameter.
    """
    lows, highs = ranges_dpt.T
    columns = vars(groups.taken(np.tile(np.arange(lows.size), 2)))
    columns["total_defocus_dpt"] = np.concatenate([lows, lows + 1.0])
    low_px, above_px = np.split(
        slopes_px(state_frames(eye, spec, PupilStates(**columns))), 2
    )
    per_dpt = above_px - low_px  # rays move in proportion to defocus
    steps_dpt = (highs - lows) / (_DEFOCUS_LADDER - 1)
    difference_px = np.sqrt(mean_square(per_dpt)) * steps_dpt
    # The covariance is a square polynomial of defocus: through three points of it.
    at_low, at_one, spread = (
        spot_covariance(slopes) for slopes in (low_px, above_px, per_dpt)
    )
    middles_dpt = steps_dpt * (np.arange(_DEFOCUS_LADDER - 1)[:, None] + 0.5)
    x = middles_dpt[..., None]
    allowed_px = allowed_difference_px(
        at_low + x * (at_one - at_low - spread) + x * x * spread,
        unit_px=unit_px,
        half_way_error=_half_way_error("defocus", allowed_error),
    )
    needed = np.zeros((lows.size, _DEFOCUS_LADDER))
    np.cumsum((difference_px / allowed_px).T, axis=1, out=needed[:, 1:])
    nodes = []
    for low, high, own in zip(lows, highs, needed, strict=True):
        if high - low < 1e-9:
            nodes.append(np.array([low]))
            continue
        count = 1 + max(1, math.ceil(own[-1] - 1e-9))
        ladder = np.linspace(low, high, _DEFOCUS_LADDER)
        nodes.append(np.interp(np.linspace(0.0, own[-1], count), own, ladder))
    return RaggedNodes.of(nodes)
