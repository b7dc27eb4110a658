"""PSFs resampled to every blur radius that a texture layout needs.

Csoba and Kunkli interpolate PSFs at equal blur radius: each PSF is cut to the square
that holds 99 % of its light, and that square is resized to 2R+1 pixels.  Here a PSF's
radius is the R at which this changes nothing: half of the square's side less half a
pixel.  (The prior implementation takes half of the side, and so enlarges every PSF.)
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compute import PsfBatch
from tests.benchmarks.view_sources import EyeState

KEPT_ENERGY_RATIO = 0.99
SAMPLES_PER_PX = 3
"""Raster that PSFs are resampled from; odd, so that the middles coincide."""

GRID_BATCH_COUNT = 1000


@dataclass(frozen=True)
class CutPsfs:
    """PSFs on a fine raster, cut to 99 % of their light, as running sums.

    Attributes
    ----------
    sums : (total,)
        (side + 1)² light above and to the left of each corner of the raster's samples.
    starts, sides : (P,)
        Where a PSF's sums start, and its samples along a side.
    radius_px : (P,)
    """

    sums: NDArray[np.float64]
    starts: NDArray[np.int64]
    sides: NDArray[np.int64]
    radius_px: NDArray[np.float64]


def cut_psfs(
    state: EyeState, h_deg: NDArray, v_deg: NDArray, distance_dpt: NDArray
) -> CutPsfs:
    """Cut PSFs (3 n) of n places, channel fastest."""
    h_deg, v_deg, distance_dpt = (
        np.ravel(values) for values in np.broadcast_arrays(h_deg, v_deg, distance_dpt)
    )
    sums, sides = [], []
    for first in range(0, h_deg.size, GRID_BATCH_COUNT):
        part = slice(first, first + GRID_BATCH_COUNT)
        batch = state.exact_psfs(
            h_deg[part],
            v_deg[part],
            distance_dpt[part],
            samples_per_px=SAMPLES_PER_PX,
        )
        part_sums, part_sides = _cut(batch)
        sums.append(part_sums)
        sides.append(part_sides)
    sides = np.concatenate(sides)
    sizes = (sides + 1) ** 2
    return CutPsfs(
        sums=np.concatenate(sums),
        starts=np.cumsum(sizes) - sizes,
        sides=sides,
        radius_px=np.maximum(sides / (2.0 * SAMPLES_PER_PX) - 0.5, 0.0),
    )


def _cut(batch: PsfBatch) -> tuple[NDArray, NDArray]:
    sums, sides = [], []
    for psf in batch:
        kernel = psf.kernel.astype(np.float64)
        total = np.zeros((kernel.shape[0] + 1,) * 2)
        total[1:, 1:] = kernel.cumsum(axis=0).cumsum(axis=1)
        full = psf.radius_px
        half = np.arange(full + 1)
        low, high = full - half, full + half + 1
        held = total[high, high] - total[low, high] - total[high, low] + total[low, low]
        radius = int(np.searchsorted(held, KEPT_ENERGY_RATIO * held[-1]))
        inside = slice(full - radius, full + radius + 1)
        side = 2 * radius + 1
        cut = np.zeros((side + 1, side + 1))
        cut[1:, 1:] = kernel[inside, inside].cumsum(axis=0).cumsum(axis=1)
        sums.append(cut.ravel() / cut[-1, -1])
        sides.append(side)
    return np.concatenate(sums), np.array(sides)


def resized(
    cut: CutPsfs, first_px: NDArray, last_px: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Resample each PSF to its whole radii first..last, by area.

    Returns
    -------
    flat_kernels : (total,) float32
        Kernels (2R+1)² of all radii of a PSF, one after the other.
    starts : (P,)
        Of the first kernel of each PSF.
    """
    first_px, last_px = first_px.astype(np.int64), last_px.astype(np.int64)
    sizes = squares_below(last_px + 1) - squares_below(first_px)
    starts = np.cumsum(sizes) - sizes
    flat = np.empty(int(sizes.sum()), np.float32)
    for p, to in enumerate(starts):
        start, corners = cut.starts[p], int(cut.sides[p]) + 1
        sums = cut.sums[start : start + corners**2].reshape(corners, corners)
        for radius in range(first_px[p], last_px[p] + 1):
            width = 2 * radius + 1
            kernel = flat[to : to + width**2].reshape(width, width)
            kernel[:] = _light_in_cells(sums, width)
            to += width**2
    return flat, starts


def squares_below(radius):
    """Weights of all kernels of radius 0 up to, but without, a radius."""
    return radius * (2 * radius - 1) * (2 * radius + 1) // 3


def _light_in_cells(sums: NDArray, count: int) -> NDArray[np.float64]:
    """Return the light in count² cells of a square; sums are bilinear in between."""
    at = np.linspace(0.0, len(sums) - 1.0, count + 1)
    lower = np.minimum(at.astype(np.int64), len(sums) - 2)
    part = at - lower
    rows = sums[lower] + part[:, None] * (sums[lower + 1] - sums[lower])
    rows = np.diff(rows, axis=0)
    inside = rows[:, lower] + part * (rows[:, lower + 1] - rows[:, lower])
    return np.diff(inside, axis=1)


def full_radius_px(radius_px: NDArray) -> int:
    """Radius that every PSF fits in."""
    return math.ceil(float(radius_px.max()) - 1e-9)
