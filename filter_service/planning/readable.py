"""Ranges of total defocus that frames read at the nodes of a state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.field.eye_optics import EyeOptics
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.nodes import PlanAxes

MAX_FIELD_STEP_DPT = 1.5
"""Largest change of defocus to the next field node that the range of a node covers.
Larger changes occur only where an eye hardly sees, for example at the edge of a
cataract.  There, blends at equal blur are clamped to the ranges of the nodes, and far
objects are read slightly nearer."""

MAX_DEFOCUS_DPT = 1000.0
"""Largest defocus of an eye that looks at infinity.  A larger value is an error in the
profile, and the nodes of such a range would exceed any memory."""

GAP_MARGIN_DPT = 0.25
"""Extension of ranges into the gap between two planes: the largest distance of a
frame's layers from a plane."""


def usable_pupils_mm(eye: EyeOptics, spec: GridSpec) -> tuple[float, float]:
    """Return the smallest and largest pupil of a spec, limited to those of the eye."""
    low_mm, high_mm = spec.settings.pupil_range_mm
    return eye.usable_pupil_mm(low_mm), eye.usable_pupil_mm(high_mm)


def accommodation_range_dpt(eye: EyeOptics, spec: GridSpec) -> tuple[float, float]:
    """Return the smallest and largest accommodation for the foci of a spec."""
    return eye.accommodation_range_dpt(
        spec.settings.focus_range_dpt, pupil_range_mm=usable_pupils_mm(eye, spec)
    )


@dataclass(frozen=True)
class ReadableDefocus:
    """Total defocus that frames read, by group.

    Attributes
    ----------
    ranges_dpt : (n_groups, n_object_ranges, 3, 2)
        Limits for each range of object distances and channel.
    shift_dpt : (n_groups, 3)
        Chromatic difference of each channel from green.
    """

    ranges_dpt: NDArray[np.float64]
    shift_dpt: NDArray[np.float64]

    @property
    def all_channels_dpt(self) -> NDArray[np.float64]:
        """Ranges (n_groups, n_object_ranges, 2) over all channels."""
        return _hull(self.ranges_dpt)

    @property
    def without_shift_dpt(self) -> NDArray[np.float64]:
        """The same ranges after subtracting the shift of each channel."""
        return _hull(self.ranges_dpt - self.shift_dpt[:, None, :, None])


def check_plan_defocus(eye: EyeOptics, spec: GridSpec, axes: PlanAxes) -> None:
    """Raise if the defocus of an eye is too large anywhere in the field.

    Raises
    ------
    ProfileError
    """
    defocus_dpt = eye.total_defocus_dpt(
        h_deg=axes.h_deg[:, None, None],
        v_deg=axes.v_deg[:, None, None, None],
        pupil_diameter_mm=np.array(usable_pupils_mm(eye, spec))[:, None],
        accommodation_dpt=np.array(accommodation_range_dpt(eye, spec)),
        wavelength_nm=spec.channel_wavelengths_nm[GREEN],
    )
    check_defocus(defocus_dpt)


def check_defocus(defocus_dpt: NDArray[np.float64]) -> None:
    """Raise if defocus is larger than `MAX_DEFOCUS_DPT`.

    Raises
    ------
    ProfileError
    """
    largest_dpt = float(np.abs(defocus_dpt).max(initial=0.0))
    if not largest_dpt <= MAX_DEFOCUS_DPT:  # also true of NaN
        raise ProfileError(
            "profile",
            f"its eye is out of focus by {largest_dpt:.3g} dpt",
            f"up to {MAX_DEFOCUS_DPT:g} dpt through settings.pupil_range_mm",
        )


def _hull(ranges_dpt: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack(
        [ranges_dpt[..., 0].min(axis=-1), ranges_dpt[..., 1].max(axis=-1)], axis=-1
    )


DefocusOf = Callable[[float, float], NDArray[np.float64]]
"""Function from pupil and accommodation to total defocus (n_v, n_h, 3) at infinity."""


def readable_defocus(
    eye: EyeOptics,
    spec: GridSpec,
    axes: PlanAxes,
    ranges: tuple[tuple[float, float], tuple[float, float]],
    defocus_of: DefocusOf,
    pupil: int,
    accommodation: int,
) -> ReadableDefocus:
    """Return the total defocus that frames read at the nodes of a state.

    Frames read a node in all states up to the neighboring nodes, and a single node in
    all states of its range.

    Parameters
    ----------
    ranges : ((low, high), (low, high))
        Ranges of pupil and accommodation that frames read.
    defocus_of : callable
    pupil, accommodation : int
        Indices of the nodes of the state.
    """
    pupils_mm, reads_pupil, own_pupil = _readers(axes.pupils_mm, ranges[0], pupil)
    accommodations_dpt, reads_accommodation, own_accommodation = _readers(
        axes.accommodations_dpt, ranges[1], accommodation
    )
    at_infinity_dpt = np.stack(
        [
            np.stack(
                [defocus_of(mm, dpt) for dpt in accommodations_dpt.tolist()], axis=-2
            )
            for mm in pupils_mm.tolist()
        ],
        axis=2,
    )
    at_node_dpt = at_infinity_dpt[:, :, own_pupil, own_accommodation]
    read_dpt = at_infinity_dpt[:, :, reads_pupil][:, :, :, reads_accommodation]
    lows, highs = read_dpt.min(axis=3), read_dpt.max(axis=3)
    if spec.blends_at_equal_blur:  # both nodes are read at a defocus between theirs
        own_lows, own_highs = lows, highs
        for axis in (0, 1):
            lows = _over_neighbors(lows, axis, np.min)
            highs = _over_neighbors(highs, axis, np.max)
        lows = np.maximum(lows, own_lows - MAX_FIELD_STEP_DPT)
        highs = np.minimum(highs, own_highs + MAX_FIELD_STEP_DPT)
    objects_dpt = eye.vergence.vergence_dpt(_extended(spec.object_ranges_dpt))
    near_far = np.stack([lows, highs], axis=-1)[..., None, :, :] + objects_dpt[:, None]
    # A pupil between two nodes, up to the other node itself, reads both at equal blur;
    # with several foci, at equal defocus.
    if eye.rings is None:
        ratio = pupils_mm[reads_pupil] / pupils_mm[own_pupil]
        near_far = near_far * ratio[:, None, None, None]
    found = np.stack(
        [near_far[..., 0].min(axis=2), near_far[..., 1].max(axis=2)], axis=-1
    )
    return ReadableDefocus(
        found.reshape(-1, *found.shape[2:]),
        (at_node_dpt - at_node_dpt[..., GREEN, None]).reshape(-1, 3),
    )


def _extended(ranges_dpt: list[tuple[float, float]]) -> NDArray[np.float64]:
    """Return ranges (n, 2) extended toward each other."""
    found = np.array(ranges_dpt)
    found[1:, 0] -= GAP_MARGIN_DPT
    found[:-1, 1] += GAP_MARGIN_DPT
    return np.maximum(found, 0.0)


def _readers(
    nodes: NDArray[np.float64], range_: tuple[float, float], node: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_], int]:
    """Return the values of an axis around a node, which of them read it, and its index.

    Defocus is evaluated at these values.
    """
    if len(nodes) > 1:
        first = max(node - 1, 0)
        values = nodes[first : node + 2]
        return values, np.ones(values.size, bool), node - first
    values = np.unique(np.append(nodes, range_))
    # The node of a measured wavefront is at rest, outside the range that frames read.
    is_read = (values >= range_[0]) & (values <= range_[1])
    return values, is_read, int(np.searchsorted(values, nodes[0]))


def _over_neighbors(
    values: NDArray[np.float64], axis: int, extreme: Callable[..., Any]
) -> NDArray[np.float64]:
    """Return extremes over each field node and its neighbors along an axis."""
    count = values.shape[axis]
    return np.stack(
        [
            extreme(values.take(range(max(i - 1, 0), min(i + 2, count)), axis), axis)
            for i in range(count)
        ],
        axis=axis,
    )


def joined_ranges(ranges_dpt: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return ranges (n, 2) of each group, ascending, with overlapping ones merged.

    Parameters
    ----------
    ranges_dpt : (n_groups, n_ranges, 2)
    """
    if ranges_dpt.shape[1] == 1:
        return list(ranges_dpt)
    return [_joined(own[np.argsort(own[:, 0])]) for own in ranges_dpt]


def _joined(ascending: NDArray[np.float64]) -> NDArray[np.float64]:
    found = [ascending[0].copy()]
    for low, high in ascending[1:].tolist():
        if low <= found[-1][1]:
            found[-1][1] = max(found[-1][1], high)
        else:
            found.append(np.array([low, high]))
    return np.array(found)
