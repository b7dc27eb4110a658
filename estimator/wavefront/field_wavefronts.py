"""Wavefronts over the visual field, as input of the PSF engines.

Wavefronts are interpolated as polynomials in mm of the pupil plane, which do not depend
on the circle of the fit.  The rim of a pupil is represented by its center and a
symmetric matrix, which vary smoothly even where the axes of the ellipse are equal.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics import prescription as rx
from estimator.optics.units import SPHERE_PER_C20, UM_PER_MM
from estimator.optics.zernike import (
    N_TERMS,
    exponents,
    inverse_monomial_matrix,
    monomial_degrees,
    wavefront_polynomial,
)

DEGREE: NDArray[np.int64] = monomial_degrees()
"""Degree of each of the default monomials, (28,)."""

TILT_Y, TILT_X = 1, 2
"""Index of C(1,-1) and C(1,1)."""

N_RIM = 5
"""Columns of a rim: x, y of the center and xx, xy, yy of the matrix, mm."""

N_SAMPLED, N_NEWTON_STEPS, NEWTON_STEP_RAD = 16, 4, 0.2
"""Search for the farthest point of a rim: number of samples, and number and largest
length of Newton steps."""

_ANGLES = 2.0 * np.pi * np.arange(N_SAMPLED) / N_SAMPLED


@dataclass(frozen=True)
class FieldWavefronts:
    """P wavefronts with their pupils, as arguments of `psf.compute.compute_psf_batch`.

    Attributes
    ----------
    zernike_um : (P, n_terms), um
        Coefficients on the circle; tilt is kept, piston is zero.
    circle_diameter_mm : (P,)
        Diameter of the circle about the chief ray that circumscribes the pupil.
    pupil_ellipse : (P, 5)
        Center x, y, semi-axes major, minor (mm) and angle of the major axis (rad).
    """

    zernike_um: NDArray[np.float64]
    circle_diameter_mm: NDArray[np.float64]
    pupil_ellipse: NDArray[np.float64]


def rim_from_ellipse(ellipse_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rims (..., 5), center and symmetric matrix, of ellipses (..., 5)."""
    x, y, major, minor, angle = np.moveaxis(ellipse_mm, -1, 0)
    cosine, sine = np.cos(angle), np.sin(angle)
    xx = major * cosine**2 + minor * sine**2
    yy = major * sine**2 + minor * cosine**2
    return np.stack([x, y, xx, (major - minor) * cosine * sine, yy], axis=-1)


def ellipse_from_rim(rim_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ellipses (..., 5) of rims (..., 5).

    Columns are center x, y, semi-major and semi-minor axis, mm, and the angle of the
    major axis, 0 to pi.
    """
    x, y, xx, xy, yy = np.moveaxis(rim_mm, -1, 0)
    mean, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy) % np.pi
    return np.stack([x, y, mean + half, mean - half, angle], axis=-1)


def circumscribed_radius_mm(rim_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the radius (...), mm, of the circumscribed circle about the chief ray."""
    x, y, xx, xy, yy = np.moveaxis(rim_mm[..., None], -2, 0)

    def rim_point(
        cosine: NDArray[np.float64], sine: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return x + xx * cosine + xy * sine, y + xy * cosine + yy * sine

    def half_square(angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return half the squared distance of a rim point from the chief ray."""
        px, py = rim_point(np.cos(angle), np.sin(angle))
        return 0.5 * (px * px + py * py)

    def derivatives(
        angle: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the first and second derivative of `half_square`."""
        cosine, sine = np.cos(angle), np.sin(angle)
        px, py = rim_point(cosine, sine)
        tx, ty = xy * cosine - xx * sine, yy * cosine - xy * sine
        second = tx * tx + ty * ty - px * (px - x) - py * (py - y)
        return px * tx + py * ty, second

    sampled = half_square(_ANGLES)
    angle = _ANGLES[np.argmax(sampled, axis=-1)][..., None]
    for _ in range(N_NEWTON_STEPS):
        first, second = derivatives(angle)
        is_concave = second < 0.0
        step = np.where(is_concave, -first / np.where(is_concave, second, 1.0), 0.0)
        angle = angle + np.clip(step, -NEWTON_STEP_RAD, NEWTON_STEP_RAD)
    highest = np.maximum(half_square(angle)[..., 0], sampled.max(axis=-1))
    return np.sqrt(2.0 * highest)


def polynomial_in_mm(
    zernike_um: NDArray[np.float64], radius_mm: ArrayLike
) -> NDArray[np.float64]:
    """Return monomials (..., n), um/mm^degree, of coefficients on circles (...)."""
    radius_mm = np.asarray(radius_mm, dtype=np.float64)[..., None]
    degree = monomial_degrees(zernike_um.shape[-1])
    return wavefront_polynomial(zernike_um) / radius_mm**degree


def zernike_from_polynomial(
    polynomial_um: NDArray[np.float64], radius_mm: ArrayLike
) -> NDArray[np.float64]:
    """Return coefficients (..., n_terms), um, on circles (...), of monomials in mm.

    Piston is zero.
    """
    radius_mm = np.asarray(radius_mm, dtype=np.float64)[..., None]
    n_terms = polynomial_um.shape[-1]
    scaled_um = polynomial_um * radius_mm ** monomial_degrees(n_terms)
    zernike_um = scaled_um @ inverse_monomial_matrix(n_terms)
    zernike_um[..., 0] = 0.0
    return zernike_um


@cache
def _curvatures(n_terms: int) -> NDArray[np.float64]:
    """Return xx, xy and yy derivatives (3, n, n_terms) of monomials in a circle."""
    radii = np.linspace(0.0, 1.0, 9)[:, None]
    x, y = (radii * circular(_ANGLES) for circular in (np.cos, np.sin))
    found = np.zeros((3, x.size, n_terms))
    for k, (a, b) in enumerate(exponents(n_terms).tolist()):
        for row, (i, j) in enumerate(((2, 0), (1, 1), (0, 2))):
            if a >= i and b >= j:
                factor = math.perm(a, i) * math.perm(b, j)
                found[row, :, k] = (factor * x ** (a - i) * y ** (b - j)).ravel()
    return found


def rays_cross(
    polynomial_um: NDArray[np.float64], *, depth_mm: float, radius_mm: float
) -> bool:
    """Return whether rays within a circle cross before a plane deeper in the eye.

    The wavefront has several values there, which no polynomial represents.

    Parameters
    ----------
    polynomial_um : (n_terms,), um/mm^degree
    """
    n_terms = polynomial_um.size
    scaled = polynomial_um * radius_mm ** (monomial_degrees(n_terms) - 2.0)
    xx, xy, yy = depth_mm / UM_PER_MM * (_curvatures(n_terms) @ scaled)
    area = (1.0 + xx) * (1.0 + yy) - xy**2
    return bool((area <= 0.0).any() or (xx + yy <= -2.0).any())


def c20_by_degree(polynomial_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return contributions (..., n), um, of degrees 2, 4 ... to C(2,0) on 1 mm radius.

    On a radius of r mm, the contribution of a degree is r**degree times as large.

    Parameters
    ----------
    polynomial_um : (..., n_terms), um/mm^degree
    """
    n_terms = polynomial_um.shape[-1]
    share = inverse_monomial_matrix(n_terms)[:, rx.C20] * polynomial_um
    own_degree = monomial_degrees(n_terms)
    degrees = range(2, int(own_degree[-1]) + 1, 2)
    sums = [share[..., degree == own_degree].sum(axis=-1) for degree in degrees]
    return np.stack(sums, axis=-1)


def correction_polynomial(
    correction: rx.Prescription | None, *, entrance_pupil_mm: float
) -> NDArray[np.float64]:
    """Return the monomials (28,), um/mm^degree, of a correction's power, to subtract.

    The power, in the plane of the entrance pupil, is the same at all fields.  Oblique
    aberrations of spectacle lenses depend on their shape and are not modeled.

    Parameters
    ----------
    correction : Prescription or None
    entrance_pupil_mm : float
        Depth of the entrance pupil behind the cornea.
    """
    if correction is None:
        return np.zeros(N_TERMS)
    zernike_um = rx.zernike_from_power_vector(
        *rx.power_vector(correction, depth_mm=entrance_pupil_mm), zernike_radius_mm=1.0
    )
    return polynomial_in_mm(zernike_um, 1.0)


def total_defocus_dpt(
    zernike_um: NDArray[np.float64], radius_mm: ArrayLike
) -> NDArray[np.float64]:
    """Return the least-squares M = -4 sqrt(3) C(2,0) / r² (...), dpt."""
    return -SPHERE_PER_C20 * zernike_um[..., rx.C20] / np.square(radius_mm)


def with_defocus(
    zernike_um: NDArray[np.float64],
    rim_mm: NDArray[np.float64],
    radius_mm: NDArray[np.float64],
    *,
    total_defocus_dpt: ArrayLike,
) -> FieldWavefronts:
    """Return P wavefronts whose least-squares defocus is replaced.

    Parameters
    ----------
    zernike_um : (P, n_terms)
    rim_mm : (P, 5)
    radius_mm : (P,)
        Radius of the circle of the coefficients.
    total_defocus_dpt : (P,)
    """
    zernike_um = zernike_um.copy()
    zernike_um[:, rx.C20] = -np.ravel(total_defocus_dpt) * radius_mm**2 / SPHERE_PER_C20
    return FieldWavefronts(
        zernike_um=zernike_um,
        circle_diameter_mm=2.0 * radius_mm,
        pupil_ellipse=ellipse_from_rim(rim_mm),
    )


def with_tilt(
    zernike_um: NDArray[np.float64],
    radius_mm: ArrayLike,
    shift_mrad: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return wavefronts (P, n) with a tilt that shifts their PSFs by (P, 2), mrad.

    A PSF is at +grad W (um/mm = mrad), and Z(1,1) = 2 x / r.
    """
    zernike_um = zernike_um.copy()
    tilt_um = 0.5 * np.asarray(radius_mm)[..., None] * shift_mrad
    zernike_um[..., [TILT_X, TILT_Y]] += tilt_um
    return zernike_um


def distinct_rows(
    *columns: NDArray[Any],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices (m,) of distinct rows of columns (n,), and the inverse (n,)."""
    number = np.zeros(columns[0].size, dtype=np.int64)
    for column in columns:
        if (column == column[:1]).all():
            continue  # in most calls, only one or two columns vary
        values, inverse = np.unique(column, return_inverse=True)
        number = np.unique(number * values.size + inverse, return_inverse=True)[1]
    return np.unique(number, return_index=True)[1], number
