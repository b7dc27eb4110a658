"""Straylight of the ocular media, added to a filtered image.

Scattered light has no fine detail, so it is computed on a coarse grid of visual angle:
the image is averaged over the cells of the grid, convolved with the scatter function
(by FFT) and interpolated to pixels.  These cells are not those of `image_cells`.  Rows
and columns of the grid are evenly spaced in the angle along the axes of the image, so
that each axis can be computed separately; in the corner of a field of 80 x 50 deg,
distances along v are a fifth too long.  The surroundings of the image are assumed to be
as bright as its edge, so that a uniform image does not change.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.media import Straylight
from estimator.native import shared_threads
from estimator.threads import thread_count
from filter_service.camera import Camera
from filter_service.constants import RGB
from filter_service.native import loops

CELL_DEG = 0.5
"""Edge of a cell, unless that exceeds `MAX_CELLS`.

The PSNR of a cataract against cells of 0.125 deg is 56 dB.  Cells of 0.25 deg reach 59
to 62 dB but take twice as long: 11.5 instead of 4.9 ms at 480x270, 30 instead of 16 at
1280x720.
"""

MAX_CELLS = 384
"""Largest cell count along one axis; wider fields have larger cells."""

SAMPLES = 4
"""Samples of the scatter function along each edge of a cell."""


def add_haze(
    color: NDArray[np.float32],
    camera: Camera,
    straylight: Straylight,
    gain_ratio: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> None:
    """Add straylight to linear light (height, width, 3) and apply gains, in place."""
    grid = haze_grid(camera, straylight)
    height, width, _ = color.shape
    coarse = np.empty((*grid.shape, RGB), np.float32)
    axes = [(a.first_px, a.shares, *a.shares.shape) for a in (grid.rows, grid.columns)]
    call, threads = loops().call, shared_threads()
    call("cell_means", threads, color, width, *axes[0], *axes[1], coarse)
    call(
        "add_scattered",
        *(threads, color, height, width, grid.scatter(coarse), *grid.shape),
        *(grid.rows.position, grid.columns.position),
        *(1.0 - grid.fraction, np.array(gain_ratio, np.float64)),
    )


class HazeGrid:
    """Convolution of a camera's image with the scatter function of an eye.

    Parameters
    ----------
    camera : Camera
    straylight : Straylight
    """

    def __init__(self, camera: Camera, straylight: Straylight):
        from scipy import fft  # not needed by frames without haze

        left, right, up, down = camera.tangents
        self.columns = _Axis.of(left, right, camera.width_px)
        self.rows = _Axis.of(up, down, camera.height_px)
        self.fraction = straylight.fraction
        n, m = self.shape = self.rows.count, self.columns.count
        self._padded = tuple(fft.next_fast_len(2 * k - 1, real=True) for k in (n, m))
        kernel = _kernel(
            straylight, self.shape, (self.rows.cell_deg, self.columns.cell_deg)
        )
        self._spectrum = fft.rfft2(
            _wrapped(kernel, self._padded), workers=thread_count()
        )
        inside = self._spread(np.ones((n, m, 1), np.float32))[..., 0]
        self._outside = np.maximum(self.fraction - inside, 0.0)[..., None]

    def scatter(self, coarse: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the light (n, m, 3) that is scattered into each cell."""
        beyond = self._outside * _edge_light(coarse)
        return (self._spread(coarse) + beyond).astype(np.float32, order="C")

    def _spread(self, coarse: NDArray[Any]) -> NDArray[Any]:
        from scipy import fft

        n, m = coarse.shape[:2]
        spectrum = fft.rfft2(coarse, self._padded, axes=(0, 1), workers=thread_count())
        spectrum *= self._spectrum[..., None]
        found = fft.irfft2(spectrum, self._padded, axes=(0, 1), workers=thread_count())
        return found[:n, :m]


@lru_cache(maxsize=8)
def haze_grid(camera: Camera, straylight: Straylight) -> HazeGrid:
    """Return the grid of a camera and an eye, cached."""
    return HazeGrid(camera, straylight)


@dataclass(frozen=True)
class _Axis:
    """Cells along one axis of an image.

    Attributes
    ----------
    first_px : (n,)
        Pixel in which each cell begins.
    shares : (n, k)
        Fraction of the cell that this pixel and the following ones cover.
    position : (n_px,)
        Pixel centers in units of cells; cell centers are at integers.
    cell_deg : float
    """

    first_px: NDArray[np.int64]
    shares: NDArray[np.float64]
    position: NDArray[np.float64]
    cell_deg: float

    @property
    def count(self) -> int:
        """Return the number of cells."""
        return self.first_px.size

    @classmethod
    def of(cls, first: float, last: float, n_px: int) -> _Axis:
        """Divide the angle between two tangents into cells."""
        edges_deg = np.degrees(np.arctan(np.linspace(first, last, n_px + 1)))
        edges_deg = np.abs(edges_deg - edges_deg[0])
        span_deg = float(edges_deg[-1])
        count = int(np.clip(round(span_deg / CELL_DEG), 1, MAX_CELLS))
        count = min(count, n_px)
        cells_deg = np.linspace(0.0, span_deg, count + 1)
        starts = np.searchsorted(edges_deg, cells_deg[:-1], side="right") - 1
        ends = np.searchsorted(edges_deg, cells_deg[1:], side="left")
        pixels = starts[:, None] + np.arange(int((ends - starts).max()))
        inside = np.minimum(pixels, n_px - 1)
        low_deg = np.maximum(edges_deg[inside], cells_deg[:-1, None])
        high_deg = np.minimum(edges_deg[inside + 1], cells_deg[1:, None])
        overlap_deg = np.where(pixels < n_px, np.maximum(high_deg - low_deg, 0.0), 0.0)
        middles_deg = 0.5 * (edges_deg[1:] + edges_deg[:-1])
        return cls(
            first_px=starts.astype(np.int64),
            shares=overlap_deg / overlap_deg.sum(axis=1, keepdims=True),
            position=np.clip(middles_deg / span_deg * count - 0.5, 0.0, count - 1.0),
            cell_deg=span_deg / count,
        )


def _kernel(
    straylight: Straylight, counts: tuple[int, int], cell_deg: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the light (2 n - 1, 2 m - 1) that one cell scatters around it."""
    sub = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    offsets = [
        (np.arange(1 - n, n)[:, None] + sub) * size
        for n, size in zip(counts, cell_deg, strict=True)
    ]
    square = (
        np.square(offsets[0])[:, :, None, None]
        + np.square(offsets[1])[None, None, :, :]
    )
    table_deg = np.geomspace(1e-3, 180.0, 4000)
    per_sr = straylight.per_sr(table_deg)
    log_per_sr = np.interp(
        0.5 * np.log(np.maximum(square, table_deg[0] ** 2)),
        np.log(table_deg),
        np.log(np.maximum(per_sr, 1e-12)),
    )
    found = np.exp(log_per_sr).mean(axis=(1, 3))
    return found * np.radians(cell_deg[0]) * np.radians(cell_deg[1])


def _edge_light(coarse: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mean light (3,) of the outermost cells."""
    edges = (coarse[0], coarse[-1], coarse[:, 0], coarse[:, -1])
    return np.concatenate(edges).mean(axis=0, dtype=np.float64)


def _wrapped(kernel: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return a kernel padded and rolled, so that its center is the first element."""
    n, m = (kernel.shape[0] + 1) // 2, (kernel.shape[1] + 1) // 2
    found = np.zeros((max(shape[0], 2 * n - 1), max(shape[1], 2 * m - 1)))
    found[: kernel.shape[0], : kernel.shape[1]] = kernel
    return np.roll(found, (1 - n, 1 - m), axis=(0, 1)).astype(np.float32)
