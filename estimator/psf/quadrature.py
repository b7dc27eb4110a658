"""PSFs by quadrature in double precision, for derivatives.

The other methods sample a PSF on grids that change with the wavefront, which moves up
to 1e-3 of its light when a wavefront changes a little.  Here, the pupil is integrated
along chords, by the trapezoidal rule across them and Gauss-Legendre nodes on each, and
the intensity by Gauss-Legendre nodes in each pixel.  Both converge faster than
exponentially, so that errors are below 1e-6 of the peak.  A PSF takes 10 to 300 ms.

Beyond `MARGIN` of the spot, kernels consist of the mean light of the pupil's edge (see
`tail`), without its fringes.  Half the L1 distance to a PSF that is integrated in all
pixels is 1e-6 to 2e-5 (pupils of 3 and 5 mm, pixels of 0.3 to 1.3 mrad).
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import exponents
from estimator.psf.compute import compute_psf_batch, plan_psfs
from estimator.psf.survey import PupilSurvey
from estimator.threads import thread_count

MARGIN, MIN_MARGIN_PX = 100.0, 6.0
"""Distance from the spot up to which pixels are integrated, lambda/D.  With 36, the
derivative by the pupil of a sharp image has an error of 0.2 % instead of 0.03 %."""

MAX_SPOT_PX = 80
"""Radius of a spot above which `compute_psf_batch` computes its kernel: the time of
quadrature grows with the fourth power of the radius."""

CHORDS_AT_A_TIME = 32

ONE_THREAD_PRODUCT = 1 << 16
"""Multiplications of a matrix product that OpenBLAS computes on the calling thread; the
threads of larger ones wait for each other."""


@cache
def _gauss_legendre(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    from scipy.special import roots_legendre

    nodes, weights = roots_legendre(count)
    return nodes, weights


def _node_count(bandwidth: float) -> int:
    """Return the number of Gauss-Legendre nodes for exp(i f), |f'| <= B on [-1, 1].

    The error falls faster than exponentially from B / 2 nodes on, after a transition of
    a width that is proportional to the cube root of B.
    """
    return math.ceil(bandwidth / 2.0 + 2.0 * bandwidth ** (1.0 / 3.0)) + 6


def _polynomial(
    coefficients: NDArray[np.float64], x: NDArray[Any], y: NDArray[Any]
) -> NDArray[np.float64]:
    powers = exponents(coefficients.size)
    order = int(powers.max())
    of_x, of_y = ([np.ones_like(axis)] for axis in (x, y))
    for k in range(order):
        of_x.append(of_x[k] * x)
        of_y.append(of_y[k] * y)
    terms = zip(powers.tolist(), coefficients.tolist(), strict=True)
    found = np.zeros_like(x)
    for (a, b), value in terms:
        if value:
            found += value * of_x[a] * of_y[b]
    return found


def spot_by_quadrature(
    survey: PupilSurvey, psf: int, *, radius_px: int
) -> NDArray[np.float64]:
    """Return the share (2R+1, 2R+1) of the light in each pixel of a square.

    Parameters
    ----------
    survey : PupilSurvey
        Surveyed pupils, without screens.
    psf : int
        Which of them.
    radius_px : int
        R.
    """
    frames = survey.frames
    half = frames.half_width_um_per_px[psf]
    shear = float(frames.shear_ratio[psf])
    root = math.sqrt(1.0 - shear**2)
    per_um = 2.0 * math.pi / (float(frames.wavelength_nm[psf]) / 1000.0)
    # Bandwidths of a chord, and of points of the edge from chord to chord.
    spot_px = float(survey.blur_radius_px[psf])
    along = per_um * float(half[1]) * root * (spot_px + radius_px + 0.5)
    farthest_px = spot_px + math.sqrt(2.0) * (radius_px + 0.5)
    across = per_um * float(half.max()) * (1.0 + abs(shear)) * farthest_px
    count, chord_count = _node_count(along), math.ceil(1.15 * _node_count(across))
    step = math.pi / chord_count
    turn = -math.pi / 2.0 + step * (np.arange(chord_count) + 0.5)
    node, weight = _gauss_legendre(count)
    # On a chord, x of the disc is constant, and with it the phase of a pixel's column.
    x = np.broadcast_to(np.sin(turn)[:, None], (turn.size, count))
    y = np.cos(turn)[:, None] * node
    weights = step * np.cos(turn)[:, None] ** 2 * weight / math.pi
    box_y = shear * x + root * y
    phase = per_um * _polynomial(frames.disc_polynomial_um[psf], x, y)
    log = frames.log_amplitude[psf]
    powers = np.ones_like(x), x, box_y, x * x, x * box_y, box_y * box_y
    amplitude = np.exp(sum(c * own for c, own in zip(log, powers, strict=True)))
    passed_ratio = float((weights * amplitude**2).sum())
    field = weights * amplitude * np.exp(1j * phase)
    pixels = np.arange(-radius_px, radius_px + 1)
    (at_x, weight_x), (at_y, weight_y) = (
        _gauss_legendre(math.ceil(b / 2.0 + 1.2 * b ** (1.0 / 3.0) + 2.0))
        for b in per_um * half
    )
    down = per_um * half[1] * box_y
    chords = np.empty((turn.size, at_y.size, pixels.size), np.complex128)
    part_size = max(1, ONE_THREAD_PRODUCT // (at_y.size * pixels.size))
    for first in range(0, turn.size, CHORDS_AT_A_TIME):
        own = down[first : first + CHORDS_AT_A_TIME, None, :]
        inner = field[first : first + CHORDS_AT_A_TIME, None, :] * np.exp(
            -1j * own * (at_y[:, None] / 2.0 - radius_px)
        )
        turns = np.repeat(np.exp(-1j * own), pixels.size, axis=1)
        turns[:, 0] = 1.0
        np.cumprod(turns, axis=1, out=turns)
        turns = turns.swapaxes(1, 2)
        chords[first : first + CHORDS_AT_A_TIME] = sum(
            inner[..., i : i + part_size] @ turns[:, i : i + part_size]
            for i in range(0, count, part_size)
        )
    of_columns = chords.reshape(turn.size, -1)
    columns = per_um * half[0] * np.sin(turn)
    at = np.exp(-1j * (pixels[:, None, None] + at_x[:, None] / 2.0) * columns)
    light = np.empty((pixels.size, of_columns.shape[1]))
    part_size = max(1, ONE_THREAD_PRODUCT // (at_x.size * turn.size))
    for first in range(0, light.shape[1], part_size):
        part = slice(first, first + part_size)
        wave = at @ of_columns[:, part]
        light[:, part] = weight_x / 2.0 @ (wave.real**2 + wave.imag**2)
    shape = pixels.size, at_y.size, pixels.size
    kernel = np.einsum("xgy,g->yx", light.reshape(shape), weight_y / 2.0)
    area = math.pi * float(half[0] * half[1]) * root
    wavelength_um = float(frames.wavelength_nm[psf]) / 1000.0
    return kernel[::-1] * (area / wavelength_um**2 / passed_ratio)


def quadrature_kernels(
    zernike_um: NDArray[np.float64],
    *,
    radius_px: NDArray[np.int64],
    workers: int | None = None,
    **arguments: Any,
) -> list[NDArray[np.float64]]:
    """Compute PSFs (P,) on discs of given radii, in double precision.

    Parameters
    ----------
    zernike_um : (P, n_terms), um
    radius_px : (P,)
        Radii R of the kernels.
    workers : int, optional
        Number of threads; by default as many as the process may use.
    **arguments
        Wavelength, pupil and scale of the pixels, as of `compute_psf_batch`, without a
        screen.

    Returns
    -------
    list of (2R+1, 2R+1) float64
        Shares of the light of a point, whose sums are below 1 by the light outside.

    Raises
    ------
    ValueError
        As `compute_psf_batch`.
    """
    plan = plan_psfs(zernike_um, method="fourier", **arguments)
    survey = plan.survey

    def kernel(psf: int) -> NDArray[np.float64]:
        own = {name: _item(value, psf) for name, value in arguments.items()}
        radius = int(radius_px[psf])
        whole = compute_psf_batch(zernike_um[psf : psf + 1], radius_px=radius, **own)[0]
        found = whole.kernel.astype(np.float64) * (1.0 - whole.lost_energy_ratio)
        spot_px = float(survey.blur_radius_px[psf])
        if spot_px > MAX_SPOT_PX:
            return found
        margin_px = max(MARGIN * float(survey.unit_px[psf].max()), MIN_MARGIN_PX)
        core = min(math.ceil(spot_px + margin_px), radius)
        inner = slice(radius - core, radius + core + 1)
        found[inner, inner] = spot_by_quadrature(survey, psf, radius_px=core)
        return found

    with ThreadPoolExecutor(workers or thread_count()) as pool:
        return list(pool.map(kernel, range(len(zernike_um))))


def _item(value: Any, psf: int) -> Any:
    """Return the value of one PSF of an argument with or without an axis of PSFs."""
    return value[psf : psf + 1] if isinstance(value, np.ndarray) else value
