"""Brute-force float64 point-spread functions: the truth the fast engines answer to.

No FFT, no grid shared with `psf_fourier.py`: the pupil integral is done by spectral
quadrature for every direction asked for, the pixel integral by Gauss-Legendre nodes
inside every pixel.  Slow (milliseconds to minutes); tests and benchmarks only.
"""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from estimator.zernike import EXPONENTS, wavefront_polynomial, zernike_gradient

ROWS_AT_A_TIME = 1 << 24
"""Field values held at a time (256 MiB): rows of pixels are done in such parts."""


def _slope_limit_mrad(zernike_um: NDArray, radius_mm: float) -> float:
    """Largest slope over the pupil, from a dense polar grid."""
    rho, angle = np.meshgrid(np.linspace(0, 1, 33), np.linspace(0, 2 * np.pi, 129))
    gradient = zernike_gradient(rho * np.cos(angle), rho * np.sin(angle)) @ zernike_um
    return float(np.hypot(gradient[..., 0], gradient[..., 1]).max()) / radius_mm


def _node_count(bandwidth: float) -> int:
    """Gauss-Legendre nodes for exp(i f), |f'| <= bandwidth on [-1, 1].

    The error of n nodes falls faster than exponentially from n = B/2 on, where the
    zone of transition is B^(1/3) wide; 3 of it and 8 nodes give 1e-11.
    """
    return math.ceil(bandwidth / 2.0 + 3.0 * bandwidth ** (1.0 / 3.0)) + 8


def _chord_nodes(n_chords: int, n_nodes: int):
    """Quadrature of the unit disc by chords y = sin t: x, y, weight (chords, nodes).

    Trapezoid in t, where the chord's half length cos t and dy = cos t dt make the
    integrand periodic and smooth, times Gauss-Legendre on each chord.
    """
    step = math.pi / n_chords
    t = -math.pi / 2.0 + step * (np.arange(n_chords) + 0.5)
    node, weight = np.polynomial.legendre.leggauss(n_nodes)
    half = np.cos(t)[:, None]
    return half * node, np.sin(t), step * half**2 * weight


@njit(cache=True, nogil=True, fastmath=True)
def _chord_integrals(phase_rad, weight, x, start, step, offsets, out):
    """Sum over a chord's nodes of w exp(i phase) exp(-i x (start + o + q step)).

    ``out`` is (chords, offsets, steps).  One rotation per step instead of a sine and
    a cosine; rounding grows to about 1e-16 times the number of steps.
    """
    n_nodes = x.shape[1]
    re, im = np.empty(n_nodes), np.empty(n_nodes)
    turn_re, turn_im = np.empty(n_nodes), np.empty(n_nodes)
    for j in range(x.shape[0]):
        for i in range(n_nodes):
            turn_re[i] = math.cos(x[j, i] * step)
            turn_im[i] = -math.sin(x[j, i] * step)
        for g in range(offsets.shape[0]):
            for i in range(n_nodes):
                angle = phase_rad[j, i] - x[j, i] * (start + offsets[g])
                re[i] = weight[j, i] * math.cos(angle)
                im[i] = weight[j, i] * math.sin(angle)
            for q in range(out.shape[2]):
                total_re, total_im = 0.0, 0.0
                for i in range(n_nodes):
                    a, b = re[i], im[i]
                    total_re += a
                    total_im += b
                    re[i] = a * turn_re[i] - b * turn_im[i]
                    im[i] = a * turn_im[i] + b * turn_re[i]
                out[j, g, q] = complex(total_re, total_im)


def _polynomial_values(coefficients, x, y):
    powers_x = [x**k for k in range(7)]
    powers_y = [y**k for k in range(7)]
    total = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for (a, b), c in zip(EXPONENTS.tolist(), coefficients, strict=True):
        if c != 0.0:
            total += c * powers_x[a] * powers_y[b]
    return total


def _chords(theta_x_mrad, theta_y_mrad, *, pupil, zernike_um, refine):
    """Quadrature of the pupil that resolves all directions asked for.

    Returns x, weight, phase (chords, nodes) and y (chords,) on the unit disc, and the
    factor from theta to phase per unit of x.
    """
    pupil_diameter_mm, wavelength_nm = pupil
    radius_mm = pupil_diameter_mm / 2.0
    per_um = 2.0 * math.pi * 1000.0 / wavelength_nm
    limit = _slope_limit_mrad(zernike_um, radius_mm) + math.hypot(
        np.abs(theta_x_mrad).max(), np.abs(theta_y_mrad).max()
    )
    n_nodes = math.ceil(refine * _node_count(per_um * radius_mm * limit))
    x, y, weight = _chord_nodes(math.ceil(1.15 * n_nodes), n_nodes)
    wavefront = _polynomial_values(wavefront_polynomial(zernike_um), x, y[:, None])
    return x, weight, per_um * wavefront, y, per_um * radius_mm


def reference_field(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: float,
    wavelength_nm: float,
    theta_x_mrad: ArrayLike,
    theta_y_mrad: ArrayLike,
    theta_x_offset_mrad: ArrayLike = (0.0,),
    refine: float = 1.0,
    workers: int = 2,
) -> NDArray[np.complex128]:
    """Complex field on a tensor grid of directions.

    Parameters
    ----------
    zernike_um : (28,), um
    theta_x_mrad, theta_y_mrad : (nx,), (ny,)
        Directions, x right, y up; ``theta_x_mrad`` evenly spaced.
    theta_x_offset_mrad : (no,)
        Added to every ``theta_x_mrad``.
    refine : float
        Factor on the number of nodes, for convergence tests.
    workers : int
        Threads.

    Returns
    -------
    field : (ny, no, nx) complex128
        (1/pi) int_unit_disc exp(2 pi i / lambda (W - R u.theta)) d²u.
    """
    theta_x = np.asarray(theta_x_mrad, dtype=np.float64)
    theta_y = np.asarray(theta_y_mrad, dtype=np.float64)
    offset = np.asarray(theta_x_offset_mrad, dtype=np.float64)
    x, weight, phase_rad, y, scale = _chords(
        theta_x[[0, -1], None] + offset,
        theta_y,
        pupil=(pupil_diameter_mm, wavelength_nm),
        zernike_um=np.asarray(zernike_um, dtype=np.float64),
        refine=refine,
    )
    step = float(theta_x[1] - theta_x[0]) if theta_x.size > 1 else 0.0
    chords = np.empty((y.size, offset.size, theta_x.size), np.complex128)

    def integrate(part: slice) -> None:
        _chord_integrals(
            phase_rad[part],
            weight[part],
            x[part],
            scale * theta_x[0],
            scale * step,
            scale * offset,
            chords[part],
        )

    with ThreadPoolExecutor(max_workers=workers) as pool:
        list(pool.map(integrate, [slice(i, i + 16) for i in range(0, y.size, 16)]))
    field = np.exp(-1j * scale * np.outer(theta_y, y)) @ chords.reshape(y.size, -1)
    return field.reshape(theta_y.size, offset.size, theta_x.size) / math.pi


def reference_kernel(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: float,
    wavelength_nm: float,
    pixel_pitch_mrad: ArrayLike,
    radius_px: int,
    refine: float = 1.0,
    workers: int = 2,
) -> NDArray[np.float64]:
    """Wave-optical PSF integrated over pixels, float64.

    Parameters
    ----------
    zernike_um : (28,), um
        Wavefront on the circle of half the pupil diameter; tilt acts.
    pixel_pitch_mrad : (x, y) or scalar
    radius_px : int
    refine : float
        Factor on all node counts, for convergence tests.
    workers : int
        Threads.

    Returns
    -------
    kernel : (2R+1, 2R+1) float64
        Image orientation.  Each pixel holds its share of the whole light: the sum
        is below 1 by what falls outside the square.

    Notes
    -----
    Checked against closed forms and an independent polar quadrature
    (tests/numerical/test_psf_reference.py): field to 1e-12, pixels to 1e-9 of the
    brightest.  The intensity is band-limited to D/lambda, so Gauss-Legendre nodes
    inside a pixel converge faster than exponentially.
    """
    pitch = np.broadcast_to(np.asarray(pixel_pitch_mrad, dtype=np.float64), (2,))
    wavelength_um = wavelength_nm / 1000.0
    pixels = np.arange(-radius_px, radius_px + 1)
    # |E|² swings by at most 2 pi D / lambda per mrad; half a pixel is the unit of
    # Gauss-Legendre's interval.
    swing = math.pi * pupil_diameter_mm / wavelength_um * pitch
    (node_x, weight_x), (node_y, weight_y) = (
        np.polynomial.legendre.leggauss(
            math.ceil(refine * (b / 2.0 + 2.0 * b ** (1.0 / 3.0) + 4.0))
        )
        for b in swing
    )
    kernel = np.empty((pixels.size, pixels.size))
    rows = max(1, ROWS_AT_A_TIME // (node_y.size * pixels.size * node_x.size))
    for first in range(0, pixels.size, rows):
        part = slice(first, first + rows)
        theta_y = (pixels[part, None] + node_y / 2.0) * pitch[1]
        field = reference_field(
            zernike_um,
            pupil_diameter_mm=pupil_diameter_mm,
            wavelength_nm=wavelength_nm,
            theta_x_mrad=pixels * pitch[0],
            theta_y_mrad=theta_y.ravel(),
            theta_x_offset_mrad=node_x / 2.0 * pitch[0],
            refine=refine,
            workers=workers,
        ).reshape(*theta_y.shape, node_x.size, pixels.size)
        intensity = field.real**2 + field.imag**2
        kernel[part] = np.einsum(
            "g,h,pghq->pq", weight_y / 2.0, weight_x / 2.0, intensity, optimize=True
        )
    density = math.pi * (pupil_diameter_mm / 2.0 / wavelength_um) ** 2
    return kernel[::-1] * density * pitch[0] * pitch[1]
