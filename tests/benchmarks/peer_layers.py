"""Peers that cut a view into layers of one distance each and convolve those."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from filter_service.constants import MIN_COVERAGE
from tests.benchmarks.layered_baselines import _bounds, _widened
from tests.benchmarks.peer_problem import (
    LAYER_COUNT,
    KeptForState,
    NotInstalled,
    Peer,
    Problem,
)
from tests.benchmarks.view_sources import EyeState

N_WORKERS = 2
EDGE_SAMPLES = 8
"""Samples along a pixel, for the rim of a drawn disc."""

SIGMA_OF_RADIUS = 0.5
"""A Gaussian as wide as a disc, by its variance."""


def cut(
    problem: Problem, *, linear: bool, near_first: bool
) -> Iterator[tuple[int, tuple, NDArray]]:
    """Layers that hold something: number, box, and planes (4, rows, columns).

    Planes are the layer's light and how much of each pixel is in it: all in the nearest
    layer, or shared by the two around its distance.
    """
    nodes_dpt = problem.layers_dpt()
    step_dpt = max(nodes_dpt[1] - nodes_dpt[0], 1e-9)
    position = ((problem.distance_dpt - nodes_dpt[0]) / step_dpt).astype(np.float32)
    numbers = range(nodes_dpt.size)
    for n in reversed(numbers) if near_first else numbers:
        aside = np.abs(position - np.float32(n))
        share = np.maximum(1.0 - aside, 0.0) if linear else aside <= 0.5
        box = _bounds(share > 0.0)
        if box is not None:
            own = share[box].astype(np.float32)
            light = own * np.moveaxis(problem.color[box], -1, 0)
            yield n, box, np.concatenate([light, own[None]])


class Picture:
    """Light and coverage (3, height, width) that layers are added to."""

    def __init__(self, problem: Problem):
        self._own = problem.color
        self.light = np.zeros((3, *problem.color.shape[:2]), np.float32)
        self.coverage = np.zeros_like(self.light)

    def put_behind(self, box, light: NDArray, coverage: NDArray) -> None:
        """Let a layer take what nearer ones leave free."""
        at = (slice(None), *box)
        room = np.maximum(1.0 - self.coverage[at], 0.0)
        share = np.minimum(room / np.maximum(coverage, MIN_COVERAGE), 1.0)
        self.light[at] += share * light
        self.coverage[at] += share * coverage

    def put_over(self, box, light: NDArray, coverage: NDArray) -> None:
        """Lay a layer over what is there, as opaque as it covers."""
        at = (slice(None), *box)
        through = 1.0 - coverage
        self.light[at] = light + through * self.light[at]
        self.coverage[at] = coverage + through * self.coverage[at]

    def normalised(self) -> NDArray:
        """Light over coverage (height, width, 3)."""
        light, coverage = (
            np.moveaxis(planes, 0, -1) for planes in (self.light, self.coverage)
        )
        shown = light / np.maximum(coverage, MIN_COVERAGE)
        return np.where(coverage >= MIN_COVERAGE, shown, self._own)


def fft_layers(*, linear: bool):
    """Open the layers by FFT: exact PSFs, one for each layer and colour.

    Parameters
    ----------
    linear : bool
        A pixel belongs to the two layers around it, and nearer layers leave the rest
        to farther ones; or to the nearest, and layers go over each other.
    """

    def opened(problem: Problem):
        kernels = KeptForState(lambda state: _LayerKernels(problem, state))
        shape = problem.color.shape[:2]

        def frame(state: EyeState) -> NDArray:
            of_state, picture = kernels.get(state), Picture(problem)
            put = picture.put_behind if linear else picture.put_over
            for n, box, planes in cut(problem, linear=linear, near_first=linear):
                wide, _ = _widened(box, int(of_state.reach_px[n]), shape)
                put(wide, *of_state.convolved(n, box, wide, planes))
            return picture.normalised()

        return frame

    return opened


class _LayerKernels:
    """PSFs of all layers at one state; transforms are kept by the size they are for."""

    def __init__(self, problem: Problem, state: EyeState):
        nodes_dpt = problem.layers_dpt()
        zeros = np.zeros(nodes_dpt.size)
        self._psfs = state.exact_psfs(zeros, zeros, nodes_dpt)
        self.reach_px = self._psfs.radius_px.reshape(-1, 3).max(axis=1)
        self._transforms = {}

    def convolved(self, n, box, wide, planes) -> tuple[NDArray, NDArray]:
        """Light and coverage (3, rows, columns) of a layer within its wide box."""
        reach = int(self.reach_px[n])
        size = tuple(
            fft.next_fast_len(side + 2 * reach, real=True) for side in planes.shape[1:]
        )
        kernels = self._transformed(n, size)
        waves = fft.rfft2(planes, size, workers=N_WORKERS)
        both = np.concatenate([waves[:3] * kernels, waves[3:] * kernels])
        full = fft.irfft2(both, size, workers=N_WORKERS)
        seen = tuple(
            slice(part.start - own.start + reach, part.stop - own.start + reach)
            for part, own in zip(wide, box, strict=True)
        )
        found = np.maximum(full[:, seen[0], seen[1]], 0.0)
        return found[:3], found[3:]

    def _transformed(self, n: int, size: tuple[int, int]) -> NDArray:
        if (n, size) not in self._transforms:
            reach = int(self.reach_px[n])
            own = np.zeros((3, 2 * reach + 1, 2 * reach + 1), np.float32)
            for c in range(3):
                kernel = self._psfs[3 * n + c].kernel
                edge = reach - kernel.shape[0] // 2
                inner = slice(edge, 2 * reach + 1 - edge)
                own[c, inner, inner] = kernel
            self._transforms[n, size] = fft.rfft2(own, size, workers=N_WORKERS)
        return self._transforms[n, size]


def opencv_layers(shape: str):
    """Open the layers by OpenCV: one drawn kernel for all colours of a layer.

    Parameters
    ----------
    shape : "disc" or "gaussian"
    """

    def opened(problem: Problem):
        try:
            import cv2
        except ImportError as error:
            raise NotInstalled("opencv-python-headless") from error
        cv2.setNumThreads(N_WORKERS)
        image_shape = problem.color.shape[:2]
        radii = KeptForState(
            lambda state: problem.disc_radius_px(state, problem.layers_dpt())
        )

        def frame(state: EyeState) -> NDArray:
            picture = Picture(problem)
            for n, box, planes in cut(problem, linear=False, near_first=False):
                radius_px = float(radii.get(state)[n])
                reach = int(np.ceil(radius_px * (2 if shape == "gaussian" else 1))) + 1
                wide, _ = _widened(box, reach, image_shape)
                light = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
                blurred = _blurred(cv2, _placed(light, box, wide), radius_px, shape)
                blurred = np.moveaxis(blurred, -1, 0)
                picture.put_over(wide, blurred[:3], blurred[3:])
            return picture.normalised()

        return frame

    return opened


def _placed(light, box, wide) -> NDArray:
    sides = [
        (own.start - more.start, more.stop - own.stop)
        for own, more in zip(box, wide, strict=True)
    ]
    return np.pad(light, (*sides, (0, 0)))


def _blurred(cv2, light: NDArray, radius_px: float, shape: str) -> NDArray:
    border = cv2.BORDER_CONSTANT
    if shape == "gaussian":
        sigma_px = max(SIGMA_OF_RADIUS * radius_px, 1e-3)
        return cv2.GaussianBlur(light, (0, 0), sigma_px, borderType=border)
    return cv2.filter2D(light, -1, drawn_disc(radius_px), borderType=border)


def drawn_disc(radius_px: float) -> NDArray[np.float32]:
    """Even light within a circle, by the share of each pixel in it."""
    radius_px = max(radius_px, 0.5)
    reach = int(np.ceil(radius_px))
    n = EDGE_SAMPLES * (2 * reach + 1)
    at = (np.arange(n) + 0.5) / EDGE_SAMPLES - reach - 0.5
    inside = at[:, None] ** 2 + at[None] ** 2 <= radius_px**2
    side = 2 * reach + 1
    share = inside.reshape(side, EDGE_SAMPLES, side, EDGE_SAMPLES).mean(axis=(1, 3))
    return (share / share.sum()).astype(np.float32)


PEERS = (
    Peer(
        "FFT linear",
        f"{LAYER_COUNT} layers of exact PSFs with linear weights between, clamped "
        "coverage near to far; no field",
        fft_layers(linear=True),
    ),
    Peer(
        "FFT over",
        f"{LAYER_COUNT} layers of exact PSFs, far to near over each other: seams where "
        "layers meet; no field",
        fft_layers(linear=False),
    ),
    Peer(
        "OpenCV disc",
        f"{LAYER_COUNT} layers, even discs by geometry, over; no PSF, color or field",
        opencv_layers("disc"),
    ),
    Peer(
        "OpenCV Gaussian",
        f"{LAYER_COUNT} layers, Gaussians, over; no PSF, color or field",
        opencv_layers("gaussian"),
    ),
)
