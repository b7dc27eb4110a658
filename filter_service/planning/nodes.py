"""Nodes of a PSF cache as arrays, their neighbors, and the nodes that frames read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.field.eye_optics import EyeOptics
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.node_wavefronts import NodeWavefronts


@dataclass(frozen=True)
class RaggedNodes:
    """Groups of nodes of total defocus, of different sizes.

    Attributes
    ----------
    values_dpt : (n,)
        Values of all groups, concatenated; ascending within a group.
    starts : (n_groups + 1,)
        Start of each group in `values_dpt`; the last entry is n.
    """

    values_dpt: NDArray[np.float64]
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, groups: list[NDArray[np.float64]]) -> RaggedNodes:
        """Concatenate groups, each ascending and not empty."""
        counts = np.array([len(group) for group in groups], np.int64)
        return cls.joined(np.concatenate([np.zeros(0), *groups]), counts)

    @classmethod
    def joined(
        cls, values_dpt: NDArray[np.float64], counts: NDArray[np.int64]
    ) -> RaggedNodes:
        """Split values (n,) into groups of ``counts`` (n_groups,)."""
        if not counts.size or counts.min() < 1:
            raise ValueError(f"expected at least one node in each group, got {counts}")
        starts = np.concatenate([[0], np.cumsum(counts)])
        rises = np.diff(values_dpt) > 0.0
        rises[starts[1:-1] - 1] = True
        if not rises.all():
            raise ValueError("expected ascending values in each group")
        return cls(values_dpt.astype(np.float64), starts.astype(np.int64))

    def where_fewer(
        self, index: NDArray[np.int64], other: RaggedNodes
    ) -> tuple[RaggedNodes, NDArray[np.int64]]:
        """Replace the nodes of some groups by others where those are fewer.

        Parameters
        ----------
        index : (k,)
            Groups that correspond to the groups of `other`.

        Returns
        -------
        nodes : RaggedNodes
        replaced : (m,)
            Positions in `index` of the replaced groups.
        """
        replaced = np.flatnonzero(other.counts < self.counts[index])
        counts, first = self.counts, self.starts[:-1].copy()
        counts[index[replaced]] = other.counts[replaced]
        first[index[replaced]] = self.values_dpt.size + other.starts[:-1][replaced]
        at = np.arange(counts.sum()) + np.repeat(
            first - (np.cumsum(counts) - counts), counts
        )
        values_dpt = np.concatenate([self.values_dpt, other.values_dpt])[at]
        return RaggedNodes.joined(values_dpt, counts), replaced

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of nodes (n_groups,) in each group."""
        return np.diff(self.starts)

    @property
    def group_of_node(self) -> NDArray[np.int64]:
        """Group (n,) of each node."""
        return np.repeat(np.arange(len(self.starts) - 1), self.counts)

    def group_at(self, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the group (n,) of each of some nodes."""
        return np.searchsorted(self.starts, nodes, side="right") - 1

    @cached_property
    def lowest_dpt(self) -> float:
        """Smallest value of all groups."""
        return float(self.values_dpt.min())

    @cached_property
    def span_dpt(self) -> float:
        """Interval reserved for each group in `keys_dpt`."""
        return float(np.ptp(self.values_dpt)) + 1.0

    @cached_property
    def keys_dpt(self) -> NDArray[np.float64]:
        """Values (n,), shifted to ascend over all groups for a single search."""
        return self.values_dpt - self.lowest_dpt + self.span_dpt * self.group_of_node

    def bracket(
        self, groups: ArrayLike, t: ArrayLike
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return the neighbors of values in their groups, clipped to their ends.

        Parameters
        ----------
        groups : (...) int
        t : (...)
            Values; they broadcast with `groups`.

        Returns
        -------
        lower, upper : (...) int
            Indices into `values_dpt`; the same node twice in a group of one.
        fraction : (...)
            Share of the upper node, 0 to 1.
        """
        groups, wanted = np.broadcast_arrays(np.asarray(groups), np.asarray(t, float))
        first, last = self.starts[groups], self.starts[groups + 1] - 1
        inside = np.clip(wanted, self.values_dpt[first], self.values_dpt[last])
        keys = inside - self.lowest_dpt + self.span_dpt * groups
        upper = np.searchsorted(self.keys_dpt, keys)
        upper = np.clip(upper, np.minimum(first + 1, last), last)
        lower = np.maximum(upper - 1, first)
        span = self.values_dpt[upper] - self.values_dpt[lower]
        fraction = (t - self.values_dpt[lower]) / np.where(span > 0.0, span, 1.0)
        return lower, upper, np.clip(fraction, 0.0, 1.0)


@dataclass(frozen=True)
class PlanPrediction:
    """Predicted cost and interpolation error of a plan.

    Attributes
    ----------
    psf_count : int
    memory_mb : float
        Memory of the kernels, two bytes per texel.
    build_s : float
        Time on `core_count` processor cores.
    core_count : int
    interpolation_db : float
        PSNR of images filtered with interpolated PSFs relative to exact ones, over the
        states of frames.
    error_db_by_axis : dict
        The same with one axis interpolated at a time: "h", "v", "pupil",
        "accommodation", "defocus"; axes with one node are missing.
    """

    psf_count: int
    memory_mb: float
    build_s: float
    core_count: int
    interpolation_db: float
    error_db_by_axis: dict[str, float]


@dataclass(frozen=True)
class PlanAxes:
    """Nodes of a cache over field, pupil and accommodation.

    `planning.plan.NodePlanner` plans the nodes of defocus for each state.

    Attributes
    ----------
    h_deg, v_deg : (n_h,), (n_v,)
        Field directions, ascending; a single (0, 0) on axis.
    pupils_mm : (n_pupils,)
    accommodations_dpt : (n_accommodations,)
    defocus_error : float
        Mean square error that interpolation in defocus may cause; 0 if the nodes do not
        depend on it.
    """

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    pupils_mm: NDArray[np.float64]
    accommodations_dpt: NDArray[np.float64]
    defocus_error: float = 0.0

    @cached_property
    def field_nodes_deg(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Azimuths and elevations (n_fields,) of the nodes, [v, h] in C order."""
        v_deg, h_deg = np.meshgrid(self.v_deg, self.h_deg, indexing="ij")
        return h_deg.ravel(), v_deg.ravel()

    @cached_property
    def axis_node(self) -> int:
        """Index of the field node nearest to the gaze direction."""
        return int(np.argmin(np.hypot(*self.field_nodes_deg)))

    @property
    def group_shape(self) -> tuple[int, int, int, int]:
        """Numbers of nodes (pupil, accommodation, v, h)."""
        return (
            len(self.pupils_mm),
            len(self.accommodations_dpt),
            len(self.v_deg),
            len(self.h_deg),
        )


@dataclass(frozen=True)
class PlanNodes:
    """Nodes of total defocus of all field nodes, for one or several states.

    Attributes
    ----------
    defocus : RaggedNodes
        Total defocus; a group is one field node [v, h] in one state.
    channel_shift_dpt : (n_groups, 3)
        The kernel of channel c of a node at t has total defocus t + shift.  The shift
        is zero if the node is the same defocus for all channels.  It is the chromatic
        difference if the node is an object distance, as with few distances and in the
        paper's grids.
    blur_px : (n_psfs,)
        Geometric blur of the nodes' PSFs, see `defocus_nodes`.
    is_limited : (n_groups,)
        Whether a group ends where the blur reaches the radius of the largest kernel.
    shrink_ratio : (n_groups,)
        Factor of the wavefronts of a group whose smallest blur exceeds that radius; one
        for the others.
    wavefronts : NodeWavefronts
        Wavefronts, scaled by `shrink_ratio`.
    """

    defocus: RaggedNodes
    channel_shift_dpt: NDArray[np.float64]
    blur_px: NDArray[np.float32]
    is_limited: NDArray[np.bool_]
    shrink_ratio: NDArray[np.float64]
    wavefronts: NodeWavefronts

    @property
    def arrays(self) -> list[NDArray[Any]]:
        """All arrays, to compute their size."""
        parts = (self, self.defocus, self.wavefronts)
        values = [value for part in parts for value in vars(part).values()]
        return [value for value in values if isinstance(value, np.ndarray)]

    @classmethod
    def joined(cls, several: Sequence[PlanNodes]) -> PlanNodes:
        """Concatenate nodes of one eye and field."""
        if len(several) == 1:
            return several[0]
        return cls(
            defocus=RaggedNodes.joined(
                np.concatenate([one.defocus.values_dpt for one in several]),
                np.concatenate([one.defocus.counts for one in several]),
            ),
            channel_shift_dpt=np.concatenate([n.channel_shift_dpt for n in several]),
            blur_px=np.concatenate([one.blur_px for one in several]),
            is_limited=np.concatenate([one.is_limited for one in several]),
            shrink_ratio=np.concatenate([one.shrink_ratio for one in several]),
            wavefronts=NodeWavefronts.joined([one.wavefronts for one in several]),
        )


@dataclass(frozen=True)
class CachePlan(PlanAxes):
    """All nodes of a cache.

    Attributes
    ----------
    nodes : PlanNodes
        Groups in C order [pupil, accommodation, v, h].
    prediction : PlanPrediction, optional
        None unless requested, because it takes longer than the plan.
    """

    nodes: PlanNodes = field(kw_only=True)
    prediction: PlanPrediction | None = None


def bracket_axis(
    nodes: ArrayLike, value: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the neighbors of values (...) in sorted nodes.

    The results are the same as from `RaggedNodes.bracket`.
    """
    nodes = np.asarray(nodes, np.float64)
    last = nodes.size - 1
    value = np.clip(np.asarray(value, np.float64), nodes[0], nodes[-1])
    upper = np.clip(np.searchsorted(nodes, value), min(1, last), last)
    lower = np.maximum(upper - 1, 0)
    span = nodes[upper] - nodes[lower]
    return lower, upper, (value - nodes[lower]) / np.where(span > 0.0, span, 1.0)


def triangle(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return weights of the corners of half a rectangle, split along its diagonal.

    Parameters
    ----------
    first, second : (n,)
        Positions along two axes, 0 to 1.

    Returns
    -------
    weights : (n, 3)
        Weights of the corner (0, 0), of the intermediate corner and of (1, 1).
    is_first : (n,)
        Whether the intermediate corner is (1, 0) and not (0, 1).
    """
    low, high = np.minimum(first, second), np.maximum(first, second)
    return np.stack([1.0 - high, high - low, low], axis=-1), first >= second


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
    """Return the smallest and largest pupil of a spec, limited to the eye's range."""
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
