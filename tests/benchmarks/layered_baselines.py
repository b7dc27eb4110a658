"""Methods that convolve: Barsky's slices, and interpolation of off-axis convolutions.

Where the published methods evaluate an interpolated PSF for every output pixel, the
same image is had by interpolating images, each convolved with one PSF of the grid by
FFT; that is what is timed here, so these rows are the fast form of each method.

Images are light and coverage convolved alike and divided in the end, which leaves no
dark border.  The prior implementation's versions mirror the kernels, never interpolate
(their factor is always 1) and read the distances in reverse; none of that is repeated.
"""

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from estimator.psf.compute import PsfBatch
from filter_service.constants import MIN_COVERAGE
from filter_service.planning.nodes import bracket_axis
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.view_sources import EyeState, linear_color, view_sources

BARSKY_SLICE_COUNT = 41
SURFACE_STEP_DPT = 0.1
"""Neighbouring pixels farther apart belong to different objects."""

CELAYA_GRID = (5, 3, 2)
GONZALEZ_GRID = (11, 11, 3)
"""PSFs over azimuth, elevation and distance (paper section 7.2.2)."""

BYTES_PER_WEIGHT = 4


@dataclass(frozen=True)
class Filtered:
    """A view filtered by a baseline, and what that took.

    Attributes
    ----------
    color : (height, width, 3)
        Linear light.
    prepare_ms : float
        PSFs and tables; once for an eye, pupil and focus.
    render_ms : float
        Per frame.
    memory_mb : float
        PSFs as the method keeps them, at the bytes a texel that it is published with.
    psf_count : int
    tap_count : int
        PSF samples that the frame needs, without those that a tile reads beyond a PSF;
        0 where nothing counts them, as with methods that convolve by FFT.
    """

    color: NDArray[np.float64]
    prepare_ms: float
    render_ms: float
    memory_mb: float
    psf_count: int
    tap_count: int = 0


class Stopwatch:
    """Wall time of consecutive stages."""

    def __init__(self):
        self._start_s = time.perf_counter()

    def lap_ms(self) -> float:
        """Time since the last call, or since the start."""
        now_s = time.perf_counter()
        lap_ms = 1e3 * (now_s - self._start_s)
        self._start_s = now_s
        return lap_ms


def barsky(
    view: RgbdView,
    state: EyeState,
    *,
    slice_count: int = BARSKY_SLICE_COUNT,
    finds_objects: bool = True,
) -> Filtered:
    """Depth slices, each convolved with its PSF on the axis, composited far to near.

    Slices are uniform in dioptres over the frame's depths.  A slice's colour is blurred
    together with the rest of the objects that it cuts, so that a surface that goes
    through several slices shows no seams; its blurred own mask is its opacity.  Objects
    are what depth steps of less than `SURFACE_STEP_DPT` connect.

    References
    ----------
    Barsky 2004, "Vision-realistic rendering: simulation of the scanned foveal image
    from wavefront data of human subjects"; 41 slices as in Csoba & Kunkli 2023, 7.2.1.
    """
    watch = Stopwatch()
    color = linear_color(view)
    distance_dpt = view_sources(view, state.spec).distance_dpt.reshape(color.shape[:2])
    slices_dpt = _spread(distance_dpt, slice_count)
    zeros = np.zeros(slices_dpt.size)
    psfs = state.exact_psfs(zeros, zeros, slices_dpt)
    prepare_ms = watch.lap_ms()
    slice_of = _nearest(slices_dpt, distance_dpt)
    object_of = depth_objects(distance_dpt) if finds_objects else None
    convolved = _Convolver(color.shape[:2], int(psfs.radius_px.max()))
    light, coverage = np.zeros_like(color), np.zeros_like(color)
    for s in np.unique(slice_of):
        own = slice_of == s
        seen = own
        if finds_objects:
            seen = np.isin(object_of, np.unique(object_of[own]))
        for c in range(3):
            kernel = convolved.kernel(psfs[3 * s + c].kernel)
            alpha = convolved.image(own, kernel)
            near = convolved.image(seen, kernel)
            shown = convolved.image(seen * color[..., c], kernel)
            shown = shown / np.maximum(near, MIN_COVERAGE)
            light[..., c] = alpha * shown + (1.0 - alpha) * light[..., c]
            coverage[..., c] = alpha + (1.0 - alpha) * coverage[..., c]
    return Filtered(
        color=light / np.maximum(coverage, MIN_COVERAGE),
        prepare_ms=prepare_ms,
        render_ms=watch.lap_ms(),
        memory_mb=_memory_mb(psfs),
        psf_count=len(psfs),
    )


def celaya(
    view: RgbdView, state: EyeState, *, grid: tuple[int, int, int] = CELAYA_GRID
) -> Filtered:
    """Gather with a PSF interpolated for each output pixel over angles and distance.

    Eight PSFs of a 5 x 3 x 2 grid, uniform in angle over the image and in dioptres
    between its nearest and farthest point, are blended by the output pixel's place;
    what lies around that pixel is gathered with the result.  No order of depth.

    References
    ----------
    Rodríguez Celaya et al. (reference 26 of Csoba & Kunkli 2023), as described there in
    sections 2.1 and 7.2.2.
    """
    watch = Stopwatch()
    places = _Places.of(view, state, grid)
    psfs = places.psfs(state)
    prepare_ms = watch.lap_ms()
    whole = np.ones(places.distance_dpt.shape, bool)
    color = linear_color(view)
    depth_weights = places.distance_weights()
    light, coverage = np.zeros_like(color), np.zeros_like(color)
    for d in range(places.nodes_dpt.size):
        part = places.blended(psfs, d, color, whole, depth_weights[d])
        light += part[0]
        coverage += part[1]
    return Filtered(
        color=light / np.maximum(coverage, MIN_COVERAGE),
        prepare_ms=prepare_ms,
        render_ms=watch.lap_ms(),
        memory_mb=_memory_mb(psfs),
        psf_count=len(psfs),
    )


def gonzalez(
    view: RgbdView, state: EyeState, *, grid: tuple[int, int, int] = GONZALEZ_GRID
) -> Filtered:
    """Three depth layers, each gathered with off-axis PSFs interpolated per pixel.

    A layer holds the pixels nearest to its distance, in dioptres; its light and its
    mask are gathered with PSFs of an 11 x 11 grid of angles at that distance, blended
    by the output pixel's direction; layers are composited far to near.

    References
    ----------
    Gonzalez-Utrera (reference 27 of Csoba & Kunkli 2023), as described there in
    sections 2.1 and 7.2.2.
    """
    watch = Stopwatch()
    places = _Places.of(view, state, grid)
    psfs = places.psfs(state)
    prepare_ms = watch.lap_ms()
    color = linear_color(view)
    layer_of = _nearest(places.nodes_dpt, places.distance_dpt)
    light, coverage = np.zeros_like(color), np.zeros_like(color)
    everywhere = np.ones(layer_of.shape)
    for d in range(places.nodes_dpt.size):
        own = layer_of == d
        if not own.any():
            continue
        shown, alpha = places.blended(psfs, d, color, own, everywhere)
        light = shown + (1.0 - alpha) * light
        coverage = alpha + (1.0 - alpha) * coverage
    return Filtered(
        color=light / np.maximum(coverage, MIN_COVERAGE),
        prepare_ms=prepare_ms,
        render_ms=watch.lap_ms(),
        memory_mb=_memory_mb(psfs),
        psf_count=len(psfs),
    )


@dataclass(frozen=True)
class _Places:
    """A grid of PSFs over an image, and where its pixels are in it.

    ``psfs`` are in C order [distance, elevation, azimuth], channel fastest.
    """

    h_deg: NDArray
    v_deg: NDArray
    distance_dpt: NDArray
    nodes_h_deg: NDArray
    nodes_v_deg: NDArray
    nodes_dpt: NDArray

    @classmethod
    def of(
        cls, view: RgbdView, state: EyeState, grid: tuple[int, int, int]
    ) -> "_Places":
        shape = view.depth_m.shape
        sources = view_sources(view, state.spec)
        return cls(
            sources.h_deg.reshape(shape),
            sources.v_deg.reshape(shape),
            sources.distance_dpt.reshape(shape),
            _spread(sources.h_deg, grid[0]),
            _spread(sources.v_deg, grid[1]),
            _spread(sources.distance_dpt, grid[2]),
        )

    def psfs(self, state: EyeState) -> PsfBatch:
        distance_dpt, v_deg, h_deg = np.meshgrid(
            self.nodes_dpt, self.nodes_v_deg, self.nodes_h_deg, indexing="ij"
        )
        return state.exact_psfs(h_deg, v_deg, distance_dpt)

    def distance_weights(self) -> NDArray:
        """Weights (n_distances, height, width) of the grid's distances."""
        return _hats(self.nodes_dpt, self.distance_dpt)

    def blended(self, psfs, d, color, mask, depth_weight) -> tuple[NDArray, NDArray]:
        """Light and coverage of the masked pixels by the PSFs of one distance.

        Each PSF of the grid acts on output pixels of the cells around it alone, so only
        what can reach those is convolved.
        """
        light, coverage = np.zeros_like(color), np.zeros_like(color)
        h_weights = _hats(self.nodes_h_deg, self.h_deg)
        v_weights = _hats(self.nodes_v_deg, self.v_deg)
        n_v, n_h = self.nodes_v_deg.size, self.nodes_h_deg.size
        for v, h in np.ndindex(n_v, n_h):
            weight = v_weights[v] * h_weights[h] * depth_weight
            box = _bounds(weight > 0.0)
            if box is None:
                continue
            first = 3 * ((d * n_v + v) * n_h + h)
            reach = int(psfs.radius_px[first : first + 3].max())
            wide, inner = _widened(box, reach, mask.shape)
            if not mask[wide].any():
                continue
            convolved = _Convolver(mask[wide].shape, reach)
            for c in range(3):
                kernel = convolved.kernel(psfs[first + c].kernel)
                lit = convolved.image(mask[wide] * color[wide][..., c], kernel)
                light[(*box, c)] += weight[box] * lit[inner]
                covered = convolved.image(mask[wide], kernel)
                coverage[(*box, c)] += weight[box] * covered[inner]
        return light, coverage


class _Convolver:
    """Convolutions of images of one size, kernels padded to one FFT."""

    def __init__(self, shape: tuple[int, int], reach_px: int):
        self._shape = shape
        self._padded = [
            fft.next_fast_len(max(n + reach_px, 2 * reach_px + 1), real=True)
            for n in shape
        ]

    def kernel(self, kernel: NDArray) -> NDArray:
        """Transform of a kernel whose centre goes to the origin."""
        reach = kernel.shape[0] // 2
        padded = np.zeros(self._padded)
        for rows, to_rows in _halves(reach):
            for columns, to_columns in _halves(reach):
                padded[to_rows, to_columns] = kernel[rows, columns]
        return fft.rfft2(padded, workers=2)

    def image(self, image: NDArray, kernel: NDArray) -> NDArray:
        """Convolution, of the image's size; nothing lies beyond its borders."""
        transform = fft.rfft2(image.astype(np.float64), self._padded, workers=2)
        full = fft.irfft2(transform * kernel, self._padded, workers=2)
        return np.maximum(full[: self._shape[0], : self._shape[1]], 0.0)


def _halves(reach: int):
    """Rows of a kernel, and where they go with its centre at 0 of a ring."""
    yield slice(reach, None), slice(0, reach + 1)
    if reach:
        yield slice(0, reach), slice(-reach, None)


def depth_objects(distance_dpt: NDArray) -> NDArray[np.int64]:
    """Label (height, width) of the connected surface that each pixel belongs to."""
    index = np.arange(distance_dpt.size).reshape(distance_dpt.shape)
    pairs = []
    for axis in (0, 1):
        step = np.abs(np.diff(distance_dpt, axis=axis)) < SURFACE_STEP_DPT
        before = np.take(index, range(index.shape[axis] - 1), axis=axis)[step]
        pairs.append(np.stack([before, before + (index.shape[1] if axis == 0 else 1)]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array(
        (np.ones(first.size, np.int8), (first, second)), shape=(index.size,) * 2
    )
    return connected_components(graph, directed=False)[1].reshape(index.shape)


def _spread(values: NDArray, count: int) -> NDArray[np.float64]:
    """Nodes from the smallest to the largest value; one alone goes to the middle."""
    low, high = float(values.min()), float(values.max())
    if count == 1 or math.isclose(low, high, abs_tol=1e-9):
        return np.array([(low + high) / 2])
    return np.linspace(low, high, count)


def _nearest(nodes: NDArray, values: NDArray) -> NDArray[np.int64]:
    return np.searchsorted((nodes[1:] + nodes[:-1]) / 2, values)


def _hats(nodes: NDArray, values: NDArray) -> NDArray[np.float64]:
    """Weights (n_nodes, ...) of linear interpolation."""
    lower, upper, share = bracket_axis(nodes, values)
    return np.stack(
        [(lower == n) * (1.0 - share) + (upper == n) * share for n in range(nodes.size)]
    )


def _bounds(mask: NDArray) -> tuple[slice, slice] | None:
    """Smallest box that holds what is set."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return None
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _widened(box, reach, shape) -> tuple[tuple, tuple]:
    """A box with a margin, and where the box lies in that."""
    wide = tuple(
        slice(max(part.start - reach, 0), min(part.stop + reach, size))
        for part, size in zip(box, shape, strict=True)
    )
    inner = tuple(
        slice(part.start - more.start, part.stop - more.start)
        for part, more in zip(box, wide, strict=True)
    )
    return wide, inner


def _memory_mb(psfs: PsfBatch) -> float:
    return psfs.flat_kernels.size * BYTES_PER_WEIGHT / 1e6
