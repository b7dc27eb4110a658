"""Which defocus frames read at the nodes of a plan."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.field.eye_optics import EyeOptics
from filter_service.planning.grid import GREEN, GridSpec

MAX_FIELD_STEP_DPT = 1.5
"""Change of defocus to the next field node that a node's range follows.  Only where an
eye hardly sees, as at the edge of a cataract, is it more; there the nodes' own ranges
end the blend at equal blur, and far objects are read a little nearer."""


MAX_DEFOCUS_DPT = 1000.0
"""Of an eye that looks at infinity.  More is no eye but a mistake in its profile, and
the nodes of such a range would fill any memory."""

GAP_ROOM_DPT = 0.25
"""Into the gap between two planes: as far as a frame's layers lie beside a plane."""


@dataclass(frozen=True)
class PlanAxes:
    """Nodes of a plan but those of defocus."""

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    pupils_mm: NDArray[np.float64]
    accommodations_dpt: NDArray[np.float64]


def usable_pupils_mm(eye: EyeOptics, spec: GridSpec) -> tuple[float, float]:
    """Smallest and largest pupil of a spec that the eye knows."""
    low_mm, high_mm = spec.settings.pupil_range_mm
    return eye.usable_pupil_mm(low_mm), eye.usable_pupil_mm(high_mm)


def used_accommodations_dpt(eye: EyeOptics, spec: GridSpec) -> tuple[float, float]:
    """Smallest and largest accommodation of a spec."""
    return eye.accommodation_range_dpt(
        spec.settings.focus_range_dpt, pupil_range_mm=usable_pupils_mm(eye, spec)
    )


@dataclass(frozen=True)
class ReadableDefocus:
    """Total defocus that frames read, group by group in the order of a plan.

    Attributes
    ----------
    ranges_dpt : (n_groups, n_object_ranges, 3, 2)
        Smallest and largest for each range of object distances and each channel.
    shift_dpt : (n_groups, 3)
        Chromatic difference of the channels to green at each node.
    """

    ranges_dpt: NDArray[np.float64]
    shift_dpt: NDArray[np.float64]

    @property
    def of_any_channel_dpt(self) -> NDArray[np.float64]:
        """Ranges (n_groups, n_object_ranges, 2) that hold all channels."""
        return _hull(self.ranges_dpt)

    @property
    def beside_shift_dpt(self) -> NDArray[np.float64]:
        """The same, of what is left when the channels' own shifts are taken off."""
        return _hull(self.ranges_dpt - self.shift_dpt[:, None, :, None])


def check_central_defocus(eye: EyeOptics, spec: GridSpec) -> None:
    """Refuse an eye that is no eye on its axis, before anything is planned for it.

    Raises
    ------
    ProfileError
    """
    defocus_dpt = eye.total_defocus_dpt(
        pupil_diameter_mm=np.array(usable_pupils_mm(eye, spec))[:, None, None],
        accommodation_dpt=np.array(used_accommodations_dpt(eye, spec))[:, None],
        wavelength_nm=spec.channel_wavelengths_nm,
    )
    check_defocus(defocus_dpt)


def check_defocus(defocus_dpt: NDArray[np.float64]) -> None:
    """Refuse defocus that no eye has.

    Raises
    ------
    ProfileError
    """
    largest_dpt = float(np.abs(defocus_dpt).max(initial=0.0))
    if not largest_dpt <= MAX_DEFOCUS_DPT:  # NaN is none either
        raise ProfileError(
            "profile",
            f"its eye is out of focus by {largest_dpt:.3g} dpt",
            f"up to {MAX_DEFOCUS_DPT:g} dpt through the pupils asked for",
        )


def _hull(ranges_dpt: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack(
        [ranges_dpt[..., 0].min(axis=-1), ranges_dpt[..., 1].max(axis=-1)], axis=-1
    )


def readable_defocus(eye: EyeOptics, spec: GridSpec, axes: PlanAxes) -> ReadableDefocus:
    """Over objects, and over every accommodation and pupil that reads a node.

    A node is read by states up to its neighbours, a single one by all of its range.
    """
    pupils_mm, of_pupil, own_pupil = _readers(
        axes.pupils_mm, usable_pupils_mm(eye, spec)
    )
    used_dpt, of_used, own_used = _readers(
        axes.accommodations_dpt, used_accommodations_dpt(eye, spec)
    )
    at_infinity_dpt = eye.total_defocus_dpt(
        h_deg=axes.h_deg[:, None, None, None],
        v_deg=axes.v_deg[:, None, None, None, None],
        pupil_diameter_mm=pupils_mm[:, None, None],
        accommodation_dpt=used_dpt[:, None],
        wavelength_nm=spec.channel_wavelengths_nm,
    )
    check_defocus(at_infinity_dpt)
    at_nodes_dpt = at_infinity_dpt[:, :, own_pupil][:, :, :, own_used]
    lows = _over(at_infinity_dpt, 3, of_used, np.min)
    highs = _over(at_infinity_dpt, 3, of_used, np.max)
    if spec.blends_at_equal_blur:  # nodes are read at the defocus between them
        own_lows, own_highs = lows, highs
        for axis in (0, 1):
            beside = _neighbours(lows.shape[axis])
            lows = _over(lows, axis, beside, np.min)
            highs = _over(highs, axis, beside, np.max)
        lows = np.maximum(lows, own_lows - MAX_FIELD_STEP_DPT)
        highs = np.minimum(highs, own_highs + MAX_FIELD_STEP_DPT)
    objects_dpt = eye.vergence.vergence_dpt(_roomy(spec.object_ranges_dpt))
    near_far = np.stack([lows, highs], axis=-1)[..., None, :, :] + objects_dpt[:, None]
    # A pupil between two nodes reads both at equal blur, up to the other's own; one
    # with several foci reads them at the same defocus.
    is_scaled = eye.rings is None
    by = (p if is_scaled else np.ones(len(p)) for p in (pupils_mm, axes.pupils_mm))
    of_reader, of_node = (p[:, None, None, None, None] for p in by)
    scaled = near_far * of_reader
    ranges = np.stack(
        [
            _over(scaled[..., 0], 2, of_pupil, np.min),
            _over(scaled[..., 1], 2, of_pupil, np.max),
        ],
        axis=-1,
    )
    ranges /= of_node
    return ReadableDefocus(
        ranges.reshape(-1, *ranges.shape[4:]),
        (at_nodes_dpt - at_nodes_dpt[..., GREEN, None]).reshape(-1, 3),
    )


def _roomy(ranges_dpt: list[tuple[float, float]]) -> NDArray[np.float64]:
    """Ranges (n, 2) with room towards each other."""
    found = np.array(ranges_dpt)
    found[1:, 0] -= GAP_ROOM_DPT
    found[:-1, 1] += GAP_ROOM_DPT
    return np.maximum(found, 0.0)


Readers = tuple[NDArray[np.float64], list[list[int]], list[int]]


def _readers(nodes: NDArray[np.float64], range_: tuple[float, float]) -> Readers:
    """Values at which defocus is asked for, those that read each node, and the nodes.

    The last two are indices into the first.
    """
    if len(nodes) > 1:
        return nodes, _neighbours(len(nodes)), list(range(len(nodes)))
    values = np.unique(np.append(nodes, range_))
    # A measured wavefront has its node at rest, beside the range that is read.
    read = np.flatnonzero((values >= range_[0]) & (values <= range_[1]))
    return values, [read.tolist()], [int(np.searchsorted(values, nodes[0]))]


def _neighbours(count: int) -> list[list[int]]:
    """Return the indices of each node and of those beside it."""
    return [list(range(max(i - 1, 0), min(i + 2, count))) for i in range(count)]


def _over(
    values: NDArray[np.float64], axis: int, groups: list[list[int]], extreme
) -> NDArray[np.float64]:
    """Extremes of groups of indices along an axis."""
    return np.stack(
        [extreme(values.take(own, axis), axis=axis) for own in groups], axis=axis
    )


def joined_ranges(ranges_dpt: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Ranges (n, 2) of each group, ascending; those that overlap are one.

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
