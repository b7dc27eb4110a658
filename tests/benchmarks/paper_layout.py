"""The paper's PSF textures, and the predecessor's, as arrays.

A texture is [layer, channel, row, column]: every layer padded to the same 2R+1 square,
R being the largest radius of all, with the PSF in its middle.
"""

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.resized_psfs import (
    cut_psfs,
    full_radius_px,
    resized,
    squares_below,
)
from tests.benchmarks.view_sources import EyeState

BYTES_PER_TEXEL = 4
"""R11F_G11F_B10F, the released code's format; here weights are 32-bit floats."""


MAX_KEPT_MB = 1000.0
"""Textures that `kept_texture` holds."""


@dataclass(frozen=True)
class PaperGrid:
    """Axes of precomputed PSFs, and how many layers may go between them.

    Attributes
    ----------
    h_deg, v_deg, distance_dpt : (n,)
        Uniform and ascending.
    reduction : (s, p) or None
        Of Eq. 13; without it Eqs. 8 to 12 hold as they are, and ``(100, 100)`` leaves
        no transitional layers.
    """

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    distance_dpt: NDArray[np.float64]
    reduction: tuple[float, float] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of nodes (v, h, distance)."""
        return self.v_deg.size, self.h_deg.size, self.distance_dpt.size

    def precomputed(self, state: EyeState):
        """Cut PSFs of the nodes in C order [v, h, distance, channel]."""
        v_deg, h_deg, distance_dpt = np.meshgrid(
            self.v_deg, self.h_deg, self.distance_dpt, indexing="ij"
        )
        return cut_psfs(state, h_deg, v_deg, distance_dpt)


def paper_distances_dpt(count: int) -> NDArray[np.float64]:
    """Object distances of the released code."""
    return np.linspace(0.125, 8.125, count)


ON_AXIS = PaperGrid(np.zeros(1), np.zeros(1), paper_distances_dpt(33))
QUALITY = PaperGrid(
    np.linspace(-45.0, 45.0, 31),
    np.linspace(-25.0, 25.0, 21),
    paper_distances_dpt(9),
    reduction=(1.0, 0.5),
)
DYNAMIC = PaperGrid(
    np.linspace(-45.0, 45.0, 23),
    np.linspace(-24.0, 24.0, 13),
    paper_distances_dpt(9),
    reduction=(100.0, 100.0),
)


@dataclass(frozen=True)
class LayerAxis:
    """Layers along one axis: nodes and what goes between them.

    Attributes
    ----------
    nodes : (n,)
    first_layer : (n,)
        Layer of a node.
    base, fraction : (n_layers,)
        Interval of a layer, and where in it.
    """

    nodes: NDArray[np.float64]
    first_layer: NDArray[np.int64]
    base: NDArray[np.int64]
    fraction: NDArray[np.float64]

    @classmethod
    def of(cls, nodes: NDArray, intervals: NDArray) -> "LayerAxis":
        """Nodes and the numbers (n - 1,) of steps between them."""
        first = np.concatenate([[0], np.cumsum(intervals)]).astype(np.int64)
        base = np.repeat(np.arange(nodes.size - 1), intervals)
        fraction = (np.arange(base.size) - first[base]) / np.asarray(intervals)[base]
        last = max(nodes.size - 2, 0), float(nodes.size > 1)
        return cls(nodes, first, np.append(base, last[0]), np.append(fraction, last[1]))

    @property
    def count(self) -> int:
        """Number of layers."""
        return self.base.size

    def position(self, values: NDArray) -> tuple[NDArray, NDArray]:
        """Layer below values (n,), and the share of the one above it."""
        exact = np.interp(values, self.nodes, self.first_layer)
        lower = np.minimum(exact.astype(np.int64), max(self.count - 2, 0))
        return lower, exact - lower


@dataclass(frozen=True)
class PaperTexture:
    """Layers of PSFs by direction and distance.

    Attributes
    ----------
    weights : (n_v * n_h * n_d, 3, 2R+1, 2R+1) float32
    radius_px : (n_layers,)
        Of the largest channel of each layer.
    v, h, distance : LayerAxis
    psf_count : int
    """

    weights: NDArray[np.float32]
    radius_px: NDArray[np.float64]
    v: LayerAxis
    h: LayerAxis
    distance: LayerAxis
    psf_count: int

    @property
    def memory_mb(self) -> float:
        """Size of the published format."""
        return self.weights.size // 3 * BYTES_PER_TEXEL / 1e6


def interval_count(
    radius_px: NDArray, axis: int, reduction: tuple[float, float] | None
) -> NDArray[np.int64]:
    """Steps (n - 1,) between the nodes of an axis: transitional layers and one.

    Eqs. 8 to 12: the largest change of radius anywhere in the interval, rounded up.
    Eq. 13 divides it by (s L)^p, as released: never below one, rounded down.
    """
    change_px = np.abs(np.diff(radius_px, axis=axis))
    others = tuple(a for a in range(radius_px.ndim) if a != axis)
    steps = np.maximum(np.ceil(change_px.max(axis=others) - 1e-9), 1.0)
    if reduction is not None:
        s, p = reduction
        shrink = np.exp(np.minimum(p * np.log(np.maximum(steps * s, 1.0)), 700.0))
        steps = np.maximum(np.floor(steps / shrink), 1.0)
    return steps.astype(np.int64)


def paper_texture(state: EyeState, grid: PaperGrid) -> PaperTexture:
    """Build the texture of one pupil and focus (paper sections 6.1 to 6.3).

    A layer's PSF is, per channel, interpolated over distance and direction at equal
    radius, for the whole radii below and above the interpolated radius, and between
    those two.
    """
    cut = grid.precomputed(state)
    radii = cut.radius_px.reshape(*grid.shape, 3)
    largest = radii.max(axis=-1)
    axes = [
        LayerAxis.of(nodes, interval_count(largest, a, grid.reduction))
        for a, nodes in enumerate((grid.v_deg, grid.h_deg, grid.distance_dpt))
    ]
    first_px, last_px = _neighbour_radii(radii)
    kernels, starts = resized(cut, first_px.ravel(), last_px.ravel())
    shape = tuple(axis.count for axis in axes)
    radius = full_radius_px(radii)
    nodes, shares = _corners(axes, grid.shape)
    first_px, starts = first_px.reshape(-1, 3), starts.reshape(-1, 3)
    # (layers, channels): the interpolated radius
    radius_px = np.einsum("lk,lkc->lc", shares, radii.reshape(-1, 3)[nodes])
    weights = np.zeros((math.prod(shape), 3, 2 * radius + 1, 2 * radius + 1), "f4")
    for (layer, channel), own_px in np.ndenumerate(radius_px):
        whole = int(own_px + 1e-9)
        above = own_px - whole if own_px - whole > 1e-6 else 0.0
        for node, share in zip(nodes[layer], shares[layer], strict=True):
            for r, scale in (
                (whole, share * (1.0 - above)),
                (whole + 1, share * above),
            ):
                if scale == 0.0:
                    continue
                at = starts[node, channel] + squares_below(r)
                at -= squares_below(first_px[node, channel])
                kernel = kernels[at : at + (2 * r + 1) ** 2]
                inner = slice(radius - r, radius + r + 1)
                weights[layer, channel, inner, inner] += scale * kernel.reshape(
                    2 * r + 1, 2 * r + 1
                )
    return PaperTexture(weights, radius_px.max(axis=1), *axes, psf_count=cut.sides.size)


def _corners(
    axes: list[LayerAxis], shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the nodes (layers, 8) around each layer, and their shares."""
    nodes, shares = [], []
    for corner in np.ndindex(2, 2, 2):
        index = [
            np.minimum(axis.base + step, count - 1)
            for axis, step, count in zip(axes, corner, shape, strict=True)
        ]
        parts = [
            axis.fraction if step else 1.0 - axis.fraction
            for axis, step in zip(axes, corner, strict=True)
        ]
        nodes.append(np.ravel_multi_index(np.ix_(*index), shape).ravel())
        shares.append(math.prod(np.ix_(*parts)).ravel())
    return np.stack(nodes, axis=-1), np.stack(shares, axis=-1)


_kept: dict[tuple, tuple[PaperTexture, EyeState, float]] = {}


def kept_texture(state: EyeState, grid: PaperGrid) -> tuple[PaperTexture, float]:
    """Texture as `paper_texture` builds it, and the ms that took; the last are kept.

    Scenes, and accumulation rules, share what an eye needs.
    """
    key = (id(state.eye), state.spec, state.pupil_diameter_mm, state.focus_dpt)
    key = (*key, id(grid))
    if key not in _kept:
        start_s = time.perf_counter()
        texture = paper_texture(state, grid)
        # The state is kept too, so that its eye's id is not given out again.
        _kept[key] = (texture, state, 1e3 * (time.perf_counter() - start_s))
        while len(_kept) > 1 and _kept_mb() > MAX_KEPT_MB:
            del _kept[next(iter(_kept))]
    texture, _, build_ms = _kept[key]
    return texture, build_ms


def _kept_mb() -> float:
    return sum(texture.weights.nbytes for texture, *_ in _kept.values()) / 1e6


def _neighbour_radii(radii: NDArray) -> tuple[NDArray, NDArray]:
    """Whole radii that layers beside a node can need."""
    low, high = np.floor(radii + 1e-9), np.floor(radii + 1e-9) + 1
    for axis in range(3):
        padding = [(1, 1) if a == axis else (0, 0) for a in range(4)]
        low = np.pad(low, padding, mode="edge")
        high = np.pad(high, padding, mode="edge")
        size = radii.shape[axis]
        around = [range(k, k + size) for k in range(3)]
        low = np.min([low.take(r, axis) for r in around], axis=0)
        high = np.max([high.take(r, axis) for r in around], axis=0)
    return low.astype(np.int64), high.astype(np.int64)
