"""Ranges of defocus that frames read at the nodes of a state."""

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
"""Largest change of defocus to the next field node that a node's range covers.  It is
larger only where an eye hardly sees, as at the edge of a cataract; there the nodes' own
ranges limit the blend at equal blur, and far objects are read slightly nearer."""


MAX_DEFOCUS_DPT = 1000.0
"""Limit for an eye that looks at infinity.  More is an error in the profile, and the
nodes of such a range would exceed any memory."""

GAP_ROOM_DPT = 0.25
"""Extension of ranges into the gap between two planes: the distance of a frame's layers
from a plane."""


def usable_pupils_mm(eye: EyeOptics, spec: GridSpec) -> tuple[float, float]:
    """Return the smallest and largest pupil of a spec that the eye supports."""
    low_mm, high_mm = spec.settings.pupil_range_mm
    return eye.usable_pupil_mm(low_mm), eye.usable_pupil_mm(high_mm)


def used_accommodations_dpt(eye: EyeOptics, spec: GridSpec) -> tuple[float, float]:
    """Return the smallest and largest accommodation of a spec."""
    return eye.accommodation_range_dpt(
        spec.settings.focus_range_dpt, pupil_range_mm=usable_pupils_mm(eye, spec)
    )


@dataclass(frozen=True)
class ReadableDefocus:
    """Total defocus that frames read, field node by field node.

    Attributes
    ----------
    ranges_dpt : (n_groups, n_object_ranges, 3, 2)
        Limits for each range of object distances and each channel.
    shift_dpt : (n_groups, 3)
        Chromatic difference of the channels from green at each node.
    """

    ranges_dpt: NDArray[np.float64]
    shift_dpt: NDArray[np.float64]

    @property
    def of_any_channel_dpt(self) -> NDArray[np.float64]:
        """Ranges (n_groups, n_object_ranges, 2) that contain those of all channels."""
        return _hull(self.ranges_dpt)

    @property
    def beside_shift_dpt(self) -> NDArray[np.float64]:
        """The same after subtracting the channels' own shifts."""
        return _hull(self.ranges_dpt - self.shift_dpt[:, None, :, None])


def check_plan_defocus(eye: EyeOptics, spec: GridSpec, axes: PlanAxes) -> None:
    """Raise if defocus is out of range anywhere in the field, before planning nodes.

    Raises
    ------
    ProfileError
    """
    defocus_dpt = eye.total_defocus_dpt(
        h_deg=axes.h_deg[:, None, None],
        v_deg=axes.v_deg[:, None, None, None],
        pupil_diameter_mm=np.array(usable_pupils_mm(eye, spec))[:, None],
        accommodation_dpt=np.array(used_accommodations_dpt(eye, spec)),
        wavelength_nm=spec.channel_wavelengths_nm[GREEN],
    )
    check_defocus(defocus_dpt)


def check_defocus(defocus_dpt: NDArray[np.float64]) -> None:
    """Raise if defocus is larger than that of any eye.

    Raises
    ------
    ProfileError
    """
    largest_dpt = float(np.abs(defocus_dpt).max(initial=0.0))
    if not largest_dpt <= MAX_DEFOCUS_DPT:  # also true of NaN
        raise ProfileError(
            "profile",
            f"its eye is out of focus by {largest_dpt:.3g} dpt",
            f"up to {MAX_DEFOCUS_DPT:g} dpt through the pupils asked for",
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
    used: int,
) -> ReadableDefocus:
    """Return the defocus read at a state's nodes, over objects and reading states.

    A node is read by states up to its neighboring nodes, a single node by all states of
    its range.

    Parameters
    ----------
    ranges : ((low, high), (low, high))
        Pupils and accommodations in use.
    defocus_of : callable
    pupil, used : int
        Indices of the state's nodes of pupil and accommodation.
    """
    pupils_mm, reads_pupil, own_pupil = _readers(axes.pupils_mm, ranges[0], pupil)
    used_dpt, reads_used, own_used = _readers(axes.accommodations_dpt, ranges[1], used)
    at_infinity_dpt = np.stack(
        [
            np.stack([defocus_of(mm, dpt) for dpt in used_dpt.tolist()], axis=-2)
            for mm in pupils_mm.tolist()
        ],
        axis=2,
    )
    at_node_dpt = at_infinity_dpt[:, :, own_pupil, own_used]
    read_dpt = at_infinity_dpt[:, :, reads_pupil][:, :, :, reads_used]
    lows, highs = read_dpt.min(axis=3), read_dpt.max(axis=3)
    if spec.blends_at_equal_blur:  # nodes are read at the defocus between them
        own_lows, own_highs = lows, highs
        for axis in (0, 1):
            lows = _over_neighbors(lows, axis, np.min)
            highs = _over_neighbors(highs, axis, np.max)
        lows = np.maximum(lows, own_lows - MAX_FIELD_STEP_DPT)
        highs = np.minimum(highs, own_highs + MAX_FIELD_STEP_DPT)
    objects_dpt = eye.vergence.vergence_dpt(_roomy(spec.object_ranges_dpt))
    near_far = np.stack([lows, highs], axis=-1)[..., None, :, :] + objects_dpt[:, None]
    # A pupil between two nodes reads both at equal blur, up to the other node's own;
    # with several foci, it reads both at the same defocus.
    if eye.rings is None:
        by = pupils_mm[reads_pupil] / pupils_mm[own_pupil]
        near_far = near_far * by[:, None, None, None]
    found = np.stack(
        [near_far[..., 0].min(axis=2), near_far[..., 1].max(axis=2)], axis=-1
    )
    return ReadableDefocus(
        found.reshape(-1, *found.shape[2:]),
        (at_node_dpt - at_node_dpt[..., GREEN, None]).reshape(-1, 3),
    )


def _roomy(ranges_dpt: list[tuple[float, float]]) -> NDArray[np.float64]:
    """Return ranges (n, 2) extended toward each other."""
    found = np.array(ranges_dpt)
    found[1:, 0] -= GAP_ROOM_DPT
    found[:-1, 1] += GAP_ROOM_DPT
    return np.maximum(found, 0.0)


def _readers(
    nodes: NDArray[np.float64], range_: tuple[float, float], node: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_], int]:
    """Return values at which to evaluate defocus, which read a node, and its index."""
    if len(nodes) > 1:
        first = max(node - 1, 0)
        values = nodes[first : node + 2]
        return values, np.ones(values.size, bool), node - first
    values = np.unique(np.append(nodes, range_))
    # A measured wavefront has its node at rest, outside the range that is read.
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
