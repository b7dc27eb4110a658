"""Nodes of a PSF cache as plain arrays, and the search for the neighbors of a value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
        Geometric blur of the nodes' PSFs, see `planning.node_blur`.
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

    The results are those of `RaggedNodes.bracket`.
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
