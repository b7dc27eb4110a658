"""Ray-optical PSFs: every pupil cell splats its footprint, then a small Airy kernel.

Right on its own where blur swamps diffraction (n = 2 g D / lambda >= 192), and the
answer where diffraction is switched off at any blur, down to a perfect eye's delta.
"""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.psf_survey import PupilSurvey
from estimator.psf_tail import add_tail
from estimator.zernike import EXPONENTS

AIRY_RADIUS_PX = 6
"""13 x 13: as good as 31 x 31 in images and several times cheaper (measured)."""

MIN_CELLS = 40
MAX_CELLS = 192
"""Cells across the pupil; below 40 the pupil's own edge shows, above 192 nothing."""

CELLS_PER_PX = 1.6
"""Cells per pixel of blur: footprints of at most about a pixel."""

_PART = 32
"""PSFs per task: a task handed to a thread costs as much as half a PSF."""


@njit(cache=True, nogil=True, fastmath=True)
def _row_footprints(c, d, e, x, cell, sx, sy, wx, wy):
    """Centre and size of the footprints of one row of cells.

    ``c``, ``d``, ``e``: float32 coefficients in x of W, dW/dy and d²W/dy² at this row;
    all results are per unit pupil, before the factor that makes them pixels.  Sizes
    are those of the box with the same variance as the parallelogram that the cell's
    corners make.
    """
    # Scalars first: read inside the loop they might alias its outputs, and the loop
    # would not vectorise.
    two, three, four, five = np.float32(2), np.float32(3), np.float32(4), np.float32(5)
    c1, c2, c3, c4 = c[1], two * c[2], three * c[3], four * c[4]
    c5, c6 = five * c[5], np.float32(6) * c[6]
    d0, d1, d2, d3, d4, d5 = d[0], d[1], d[2], d[3], d[4], d[5]
    e0, e1, e2, e3, e4 = e[0], e[1], e[2], e[3], e[4]
    for i in range(x.shape[0]):
        u = x[i]
        sx[i] = c1 + u * (c2 + u * (c3 + u * (c4 + u * (c5 + u * c6))))
        sy[i] = d0 + u * (d1 + u * (d2 + u * (d3 + u * (d4 + u * d5))))
        hxx = c2 + u * (two * c3 + u * (three * c4 + u * (four * c5 + u * five * c6)))
        hxy = d1 + u * (two * d2 + u * (three * d3 + u * (four * d4 + u * five * d5)))
        hyy = e0 + u * (e1 + u * (e2 + u * (e3 + u * e4)))
        wx[i] = cell * np.sqrt(hxx * hxx + hxy * hxy)
        wy[i] = cell * np.sqrt(hxy * hxy + hyy * hyy)


@njit(cache=True, nogil=True)
def _splat_wide_box(image, box, weight):
    """Spread a weight over the pixels a box covers, by overlap area."""
    x0, x1, y0, y1 = box
    radius = image.shape[0] // 2
    per_area = weight / ((x1 - x0) * (y1 - y0))
    iy0, iy1 = math.floor(y0 + 0.5), math.floor(y1 + 0.5)
    ix0, ix1 = math.floor(x0 + 0.5), math.floor(x1 + 0.5)
    for iy in range(max(iy0, -radius), min(iy1, radius) + 1):
        part = per_area * (min(y1, iy + 0.5) - max(y0, iy - 0.5))
        for ix in range(max(ix0, -radius), min(ix1, radius) + 1):
            share = min(x1, ix + 0.5) - max(x0, ix - 0.5)
            image[radius - iy, ix + radius] += part * share


@njit(cache=True, nogil=True)
def _splat_box(image, x, y, width, height, weight):
    """Spread a weight over the pixels a box covers; a point fills the one it is in.

    Most boxes span at most two pixels each way and take the short path.
    """
    radius = image.shape[0] // 2
    x0, x1 = x - 0.5 * width, x + 0.5 * width
    y0, y1 = y - 0.5 * height, y + 0.5 * height
    ix, iy = math.floor(x0 + 0.5), math.floor(y0 + 0.5)
    over_x, over_y = x1 - ix - 0.5, y1 - iy - 0.5
    is_inside = -radius <= ix < radius and -radius <= iy < radius
    if not is_inside or over_x > 1.0 or over_y > 1.0:
        # Never empty: a box without size in the last pixel would divide by zero.
        tiny = 1e-9
        _splat_wide_box(image, (x0, x1 + tiny, y0, y1 + tiny), weight)
        return
    # All four pixels are written, with a share of zero where the box ends before:
    # cheaper than branches that no processor can predict.
    share_x = max(over_x, 0.0) / max(width, 1e-12)
    share_y = max(over_y, 0.0) / max(height, 1e-12)
    row, column = radius - iy, radius + ix
    upper, lower = weight * share_y, weight * (1.0 - share_y)
    image[row, column] += lower * (1.0 - share_x)
    image[row, column + 1] += lower * share_x
    image[row - 1, column] += upper * (1.0 - share_x)
    image[row - 1, column + 1] += upper * share_x


@njit(cache=True, nogil=True)
def splat_pupil(polynomial, factor_x, factor_y, n_cells, image):
    """Splat the footprints of all cells of the unit disc; returns their weight.

    Parameters
    ----------
    polynomial : (7, 7), um
        ``[b, a]`` multiplies y^b x^a of W on the unit circle.
    factor_x, factor_y : float
        Slope of W per unit pupil, to pixels.
    n_cells : int
        Cells across the pupil.
    image : (2R+1, 2R+1) float32
        Added to; image orientation.
    """
    cell = 2.0 / n_cells
    x = ((np.arange(n_cells) + 0.5) * cell - 1.0).astype(np.float32)
    footprint = np.empty((4, n_cells), np.float32)
    sx, sy, wx, wy = footprint[0], footprint[1], footprint[2], footprint[3]
    row = np.empty((3, 7), np.float32)
    c, d, e = row[0], row[1], row[2]
    total = 0.0
    for j in range(n_cells):
        y = (j + 0.5) * cell - 1.0
        for a in range(7):
            value, first, second = 0.0, 0.0, 0.0
            for b in range(6 - a, -1, -1):
                second = second * y + 2.0 * first
                first = first * y + value
                value = value * y + polynomial[b, a]
            c[a], d[a], e[a] = value, first, second
        _row_footprints(c, d, e, x, np.float32(cell), sx, sy, wx, wy)
        reach = math.sqrt(max(0.0, (1.0 + 0.5 * cell) ** 2 - y * y))
        first = max(0, math.floor((1.0 - reach) / cell))
        for i in range(first, n_cells - first):
            rho = math.sqrt(x[i] * x[i] + y * y)
            # Area of the cell inside the disc, its edge taken as straight.
            weight = min(1.0, max(0.0, (1.0 - rho) / cell + 0.5))
            if weight > 0.0:
                _splat_box(
                    image,
                    sx[i] * factor_x,
                    sy[i] * factor_y,
                    wx[i] * factor_x,
                    wy[i] * factor_y,
                    weight,
                )
                total += weight
    return total


@njit(cache=True, nogil=True, fastmath=True)
def _accumulate(weight, source, out):
    for i in range(source.shape[0]):
        out[i] += weight * source[i]


@njit(cache=True, nogil=True)
def _convolve(image, kernel, window, out):
    """Same-size convolution of the part of an image that holds light.

    ``window`` = (first, end) rows and (first, end) columns; light that leaves the
    image is lost.  Rows are laid end to end with room for the kernel between them, so
    that each tap is one long multiply-add, which vectorises.
    """
    size, width = image.shape[0], kernel.shape[0]
    reach = width // 2
    y0, y1, x0, x1 = window[0], window[1], window[2], window[3]
    stride = x1 - x0 + width - 1
    flat = np.zeros((y1 - y0) * stride, np.float32)
    for y in range(y0, y1):
        for x in range(x0, x1):
            flat[(y - y0) * stride + x - x0] = image[y, x]
    total = np.zeros(flat.size + width * stride + width, np.float32)
    for ky in range(width):
        for kx in range(width):
            _accumulate(kernel[ky, kx], flat, total[ky * stride + kx :])
    for y in range(max(0, y0 - reach), min(size, y1 + reach)):
        for x in range(max(0, x0 - reach), min(size, x1 + reach)):
            out[y, x] = total[(y - y0 + reach) * stride + x - x0 + reach]


def _n_cells(survey: PupilSurvey, p: int, pixel_pitch_mrad) -> int:
    extent_px = (survey.slope_high_mrad[p] - survey.slope_low_mrad[p]) / np.asarray(
        pixel_pitch_mrad
    )
    wanted = math.ceil(CELLS_PER_PX * float(extent_px.max()))
    return min(MAX_CELLS, max(MIN_CELLS, wanted))


def _geometric_spot(survey, p, radius_px, pixel_pitch_mrad) -> NDArray[np.float32]:
    dense = np.zeros((7, 7))
    dense[EXPONENTS[:, 1], EXPONENTS[:, 0]] = survey.polynomial_um[p]
    per_radius = 2.0 / survey.pupil_diameter_mm[p]
    image = np.zeros((2 * radius_px + 1, 2 * radius_px + 1), np.float32)
    total = splat_pupil(
        dense,
        per_radius / pixel_pitch_mrad[0],
        per_radius / pixel_pitch_mrad[1],
        _n_cells(survey, p, pixel_pitch_mrad),
        image,
    )
    image /= np.float32(total)
    return image


def _with_diffraction(survey, p, spot, airy, pixel_pitch_mrad):
    pitch = np.asarray(pixel_pitch_mrad)
    # One pixel more than the sampled slopes: footprints may reach beyond them.
    (x0, y0) = np.floor(survey.slope_low_mrad[p] / pitch - 0.5).astype(int).tolist()
    (x1, y1) = np.ceil(survey.slope_high_mrad[p] / pitch + 0.5).astype(int).tolist()
    size = spot.shape[0]
    middle = size // 2
    window = (
        max(0, middle - y1),
        min(size, middle - y0 + 1),
        max(0, middle + x0),
        min(size, middle + x1 + 1),
    )
    out = np.zeros_like(spot)
    _convolve(spot, airy, window, out)
    # Pixels beyond the reach of the small kernel get the mean edge light instead.
    add_tail(out, survey, p, pixel_pitch_mrad=pixel_pitch_mrad)
    return out


def geometric_kernels(
    survey: PupilSurvey,
    members: NDArray[np.int64],
    *,
    radius_px: NDArray[np.int64],
    pixel_pitch_mrad: tuple[float, float],
    airy_kernels: dict[tuple[float, float], NDArray[np.float32]] | None,
    workers: int,
) -> list[NDArray[np.float32]]:
    """Pixel-integrated PSFs by ray optics, not yet cut to a disc or normalised.

    Parameters
    ----------
    survey : PupilSurvey
    members : (M,)
        Which PSFs of the survey.
    radius_px : (P,)
        Kernel radius of every PSF of the survey.
    pixel_pitch_mrad : (x, y)
    airy_kernels : {(pupil_diameter_mm, wavelength_nm): (13, 13)} or None
        Pixel-integrated Airy patterns in shares of the light; None leaves
        diffraction out.
    workers : int
        Threads.

    Returns
    -------
    kernels : M arrays (2R+1, 2R+1) float32
        Shares of the whole light, image orientation.
    """

    def work(part: NDArray[np.int64]) -> list[NDArray[np.float32]]:
        kernels = []
        for p in part.tolist():
            kernel = _geometric_spot(survey, p, int(radius_px[p]), pixel_pitch_mrad)
            if airy_kernels is not None:
                diameter_mm = float(survey.pupil_diameter_mm[p])
                airy = airy_kernels[diameter_mm, float(survey.wavelength_nm[p])]
                kernel = _with_diffraction(survey, p, kernel, airy, pixel_pitch_mrad)
            kernels.append(kernel)
        return kernels

    parts = [members[i : i + _PART] for i in range(0, members.size, _PART)]
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        return [kernel for kernels in pool.map(work, parts) for kernel in kernels]
