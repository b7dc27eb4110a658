"""Brute-force float64 point-spread functions: ground truth for the fast engines.

No FFT, no grid shared with `fourier.py`: the pupil integral is computed by spectral
quadrature for every requested direction, the pixel integral by Gauss-Legendre nodes
inside every pixel.  Slow (milliseconds to minutes); tests and benchmarks only.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.special
from numpy.typing import ArrayLike, NDArray

from estimator.optics.zernike import (
    exponents,
    radial_order,
    wavefront_polynomial,
    zernike_gradient,
)
from estimator.psf.arguments import checked_scale
from estimator.psf.stiles_crawford import StilesCrawford

VALUES_AT_A_TIME = 1 << 24
"""Field values held at a time (256 MiB); pixel columns are processed in such parts."""

ONE_THREAD_PRODUCT = 1 << 16
"""Multiplications of a matrix product that OpenBLAS computes on the calling thread.

Larger products on the threads of `_field` take 15 times the processor time:
the threads of OpenBLAS wait for each other.
"""


@dataclass(frozen=True)
class _Pupil:
    """One elliptical pupil: u = center + matrix w (mm) over the unit disc w.

    ``matrix`` is rotated so that J^-T matrix is upper triangular: the second pixel
    coordinate then has one phase on each chord of constant w_y.
    """

    zernike_um: NDArray[np.float64]
    circle_mm: float
    wavelength_um: float
    centre_mm: NDArray[np.float64]
    matrix_mm: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    per_mm2: float
    bright_mm: NDArray[np.float64]

    def circle_point(self, x, y):
        """Map unit-disc points to points of the Zernike circle."""
        u = self.centre_mm[0] + self.matrix_mm[0, 0] * x + self.matrix_mm[0, 1] * y
        v = self.centre_mm[1] + self.matrix_mm[1, 0] * x + self.matrix_mm[1, 1] * y
        return u / self.circle_mm, v / self.circle_mm

    def amplitude(self, x, y):
        """Return the apodization at unit-disc points."""
        u, v = self.circle_point(x, y)
        u, v = u * self.circle_mm - self.bright_mm[0], v * self.circle_mm
        return np.exp(-self.per_mm2 * (u**2 + (v - self.bright_mm[1]) ** 2))

    def slope_limit(self) -> float:
        """Return the largest |dW/dw| over the pupil, um, from a dense polar grid."""
        rho, angle = np.meshgrid(np.linspace(0, 1, 33), np.linspace(0, 2 * np.pi, 129))
        x, y = self.circle_point(rho * np.cos(angle), rho * np.sin(angle))
        gradient = zernike_gradient(x, y, n_terms=self.zernike_um.size)
        gradient = gradient @ self.zernike_um
        gradient = gradient / self.circle_mm @ self.matrix_mm
        return float(np.hypot(gradient[..., 0], gradient[..., 1]).max())

    @property
    def image_matrix(self) -> NDArray[np.float64]:
        """J^-T matrix: phase is p . (image_matrix w) for pixels p."""
        return np.linalg.inv(self.jacobian).T @ self.matrix_mm


def _pupil(
    zernike_um, pupil_diameter_mm, wavelength_nm, jacobian, ellipse, apodization
):
    circle_mm = pupil_diameter_mm / 2.0
    if ellipse is None:
        ellipse = (0.0, 0.0, circle_mm, circle_mm, 0.0)
    cx, cy, major, minor, angle = (float(value) for value in ellipse)
    turn = np.array(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    matrix = turn @ np.diag([major, minor])
    image = np.linalg.inv(jacobian).T @ matrix
    norm = math.hypot(*image[1])
    # Rotates the last row of `image` to (0, norm).
    swing = np.array([[image[1, 1], image[1, 0]], [-image[1, 0], image[1, 1]]]) / norm
    per_mm2, bright_mm = 0.0, np.zeros(2)
    if apodization is not None:
        per_mm2, bright_mm = (np.asarray(part)[0] for part in apodization)
    return _Pupil(
        zernike_um=np.asarray(zernike_um, dtype=np.float64),
        circle_mm=circle_mm,
        wavelength_um=wavelength_nm / 1000.0,
        centre_mm=np.array([cx, cy]),
        matrix_mm=matrix @ swing,
        jacobian=np.asarray(jacobian, dtype=np.float64),
        per_mm2=float(per_mm2),
        bright_mm=bright_mm,
    )


def _node_count(bandwidth: float) -> int:
    """Return the number of Gauss-Legendre nodes for exp(i f), |f'| <= B on [-1, 1].

    The error of n nodes falls faster than exponentially from n = B/2 on, after a
    transition zone B^(1/3) wide; 3 times that width and 8 nodes give 1e-11.
    """
    return math.ceil(bandwidth / 2.0 + 3.0 * bandwidth ** (1.0 / 3.0)) + 8


@cache
def _gauss_legendre(n_nodes: int):
    """Return Gauss-Legendre nodes and weights; SciPy's are as exact as NumPy's.

    NumPy finds them as eigenvalues of a full matrix: seconds for a thousand.
    """
    return scipy.special.roots_legendre(n_nodes)


def _chord_nodes(n_chords: int, n_nodes: int):
    """Return x, y, weight (chords, nodes) of the unit disc by chords y = sin t.

    Trapezoid in t, where the chord's half length cos t and dy = cos t dt make the
    integrand periodic and smooth, times Gauss-Legendre on each chord.
    """
    step = math.pi / n_chords
    t = -math.pi / 2.0 + step * (np.arange(n_chords) + 0.5)
    node, weight = _gauss_legendre(n_nodes)
    half = np.cos(t)[:, None]
    return half * node, np.sin(t), step * half**2 * weight


def _chord_integrals(phase_rad, weight, x, start, step, offsets, n_steps):
    """Sum w exp(i phase) exp(-i x (start + o + q step)) over each chord's nodes.

    Returns (chords, offsets, n_steps).  Powers of one rotation replace a sine and a
    cosine for each step; rounding grows to about 1e-16 times the number of steps.
    """
    at = start + offsets[:, None]
    field = weight[:, None] * np.exp(1j * (phase_rad[:, None] - x[:, None] * at))
    turns = np.repeat(np.exp(-1j * step * x)[:, None], n_steps, axis=1)
    turns[:, 0] = 1.0
    np.cumprod(turns, axis=1, out=turns)
    part = max(1, ONE_THREAD_PRODUCT // (offsets.size * n_steps))
    return sum(
        field[..., i : i + part] @ turns[..., i : i + part].swapaxes(1, 2)
        for i in range(0, x.shape[1], part)
    )


def _polynomial_values(coefficients, x, y):
    powers_x, powers_y = ([np.ones_like(value)] for value in (x, y))
    for powers, value in ((powers_x, x), (powers_y, y)):
        for _ in range(radial_order(coefficients.size)):
            powers.append(powers[-1] * value)
    total = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    powers = exponents(coefficients.size).tolist()
    for (a, b), c in zip(powers, coefficients, strict=True):
        if c != 0.0:
            total += c * powers_x[a] * powers_y[b]
    return total


def _chords(pupil: _Pupil, x_px, y_px, refine):
    """Return a quadrature of the pupil that resolves all requested directions.

    Returns x, weight, phase (chords, nodes) and y (chords,); x and y times a
    direction in pixels give a phase.
    """
    image = pupil.image_matrix
    per_um = 2.0 * math.pi / pupil.wavelength_um
    far = np.array([np.abs(x_px).max(), np.abs(y_px).max()])
    limit = pupil.slope_limit() + float(np.hypot(*(np.abs(image).T @ far)))
    n_nodes = math.ceil(refine * _node_count(per_um * limit))
    x, y, weight = _chord_nodes(math.ceil(1.15 * n_nodes), n_nodes)
    y_all = np.broadcast_to(y[:, None], x.shape)
    wavefront = _polynomial_values(
        wavefront_polynomial(pupil.zernike_um), *pupil.circle_point(x, y_all)
    )
    across = per_um * (image[0, 0] * x + image[0, 1] * y_all)
    weight = weight * pupil.amplitude(x, y_all)
    return across, weight, per_um * wavefront, per_um * image[1, 1] * y


def _field(pupil: _Pupil, x_px, y_px, x_offset_px, refine, workers):
    """Return the complex field (ny, no, nx) on a grid of directions in pixels."""
    x, weight, phase_rad, y = _chords(
        pupil, x_px[[0, -1], None] + x_offset_px, y_px, refine
    )
    step = float(x_px[1] - x_px[0]) if x_px.size > 1 else 0.0
    chords = np.empty((y.size, x_offset_px.size, x_px.size), np.complex128)

    def integrate(part: slice) -> None:
        chords[part] = _chord_integrals(
            phase_rad[part],
            weight[part],
            x[part],
            x_px[0],
            step,
            x_offset_px,
            x_px.size,
        )

    with ThreadPoolExecutor(max_workers=workers) as pool:
        list(pool.map(integrate, [slice(i, i + 16) for i in range(0, y.size, 16)]))
    field = np.exp(-1j * np.outer(y_px, y)) @ chords.reshape(y.size, -1)
    return field.reshape(y_px.size, x_offset_px.size, x_px.size) / math.pi


def reference_field(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: float,
    wavelength_nm: float,
    theta_x_mrad: ArrayLike,
    theta_y_mrad: ArrayLike,
    pupil_ellipse: ArrayLike | None = None,
    refine: float = 1.0,
    workers: int = 2,
) -> NDArray[np.complex128]:
    """Compute the complex field on a tensor grid of directions.

    Parameters
    ----------
    zernike_um : (n_terms,), um
    theta_x_mrad, theta_y_mrad : (nx,), (ny,)
        Directions, x right, y up; ``theta_x_mrad`` evenly spaced.
    pupil_ellipse : (5,), optional
        As in `compute.compute_psf_batch`.
    refine : float
        Factor on the number of nodes, for convergence tests.
    workers : int
        Threads.

    Returns
    -------
    field : (ny, nx) complex128
        Mean of exp(2 pi i / lambda (W - u.theta)) over the pupil.
    """
    pupil = _pupil(
        zernike_um, pupil_diameter_mm, wavelength_nm, np.eye(2), pupil_ellipse, None
    )
    theta_x = np.asarray(theta_x_mrad, dtype=np.float64)
    theta_y = np.asarray(theta_y_mrad, dtype=np.float64)
    return _field(pupil, theta_x, theta_y, np.zeros(1), refine, workers)[:, 0]


def _passed_light(pupil: _Pupil) -> float:
    """Return the mean squared amplitude over the pupil."""
    if pupil.per_mm2 == 0.0:
        return 1.0
    x, y, weight = _chord_nodes(64, 48)
    y = np.broadcast_to(y[:, None], x.shape)
    return float((weight * pupil.amplitude(x, y) ** 2).sum() / math.pi)


def reference_kernel(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: float,
    wavelength_nm: float,
    radius_px: int,
    pixel_pitch_mrad: ArrayLike | None = None,
    pixel_from_mrad: ArrayLike | None = None,
    pupil_ellipse: ArrayLike | None = None,
    stiles_crawford: StilesCrawford | None = None,
    refine: float = 1.0,
    workers: int = 2,
) -> NDArray[np.float64]:
    """Compute a wave-optical PSF integrated over pixels, float64.

    Parameters
    ----------
    zernike_um : (n_terms,), um
        Wavefront on the circle of the given diameter; tilt counts.
    radius_px : int
    pixel_pitch_mrad, pixel_from_mrad, pupil_ellipse, stiles_crawford
        As in `compute.compute_psf_batch`, for one PSF.
    refine : float
        Factor on all node counts, for convergence tests.
    workers : int
        Threads.

    Returns
    -------
    kernel : (2R+1, 2R+1) float64
        Image orientation.  Each pixel holds its share of the total light; the sum is
        below 1 by the light outside the square.

    Notes
    -----
    Checked against closed forms and an independent polar quadrature
    (tests/numerical/test_psf_reference.py): field to 1e-12, pixels to 1e-9 of the
    brightest.  The intensity is band-limited to the pupil's width over lambda, so
    Gauss-Legendre nodes inside a pixel converge faster than exponentially.
    """
    jacobian = checked_scale(pixel_pitch_mrad, pixel_from_mrad, 1)[0]
    apodization = (
        stiles_crawford.amplitude(np.array([wavelength_nm], dtype=np.float64))
        if stiles_crawford
        else None
    )
    pupil = _pupil(
        zernike_um,
        pupil_diameter_mm,
        wavelength_nm,
        jacobian,
        pupil_ellipse,
        apodization,
    )
    pixels = np.arange(-radius_px, radius_px + 1).astype(np.float64)
    # The phase of |E|² changes by at most 4 pi a / lambda per pixel, a the pupil's half
    # width; half a pixel is the unit of the Gauss-Legendre interval.
    half_width_um = np.hypot(*pupil.image_matrix.T)
    swing = 2.0 * math.pi * half_width_um / pupil.wavelength_um
    (node_x, weight_x), (node_y, weight_y) = (
        _gauss_legendre(math.ceil(refine * (b / 2.0 + 2.0 * b ** (1.0 / 3.0) + 4.0)))
        for b in swing
    )
    kernel = np.empty((pixels.size, pixels.size))
    y_px = (pixels[:, None] + node_y / 2.0).ravel()
    columns = max(1, VALUES_AT_A_TIME // (y_px.size * node_x.size))
    for first in range(0, pixels.size, columns):
        part = slice(first, first + columns)
        field = _field(pupil, pixels[part], y_px, node_x / 2.0, refine, workers)
        field = field.reshape(pixels.size, node_y.size, *field.shape[1:])
        intensity = field.real**2 + field.imag**2
        kernel[:, part] = np.einsum(
            "g,h,pghq->pq", weight_y / 2.0, weight_x / 2.0, intensity, optimize=True
        )
    area = math.pi * abs(float(np.linalg.det(pupil.image_matrix)))
    density = area / pupil.wavelength_um**2 / _passed_light(pupil)
    return kernel[::-1] * density
