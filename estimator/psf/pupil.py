"""Pupils in pixel coordinates t, in which pixels are unit squares.

With p = J theta for a Jacobian J (``pixel_from_mrad``), the kernel is |int exp(2 pi i
(W - p.t) / lambda)|² over t = J^-T u.  In t (um/px), an elliptical pupil is again an
ellipse, described by its bounding box and a shear.  PSFs are therefore computed
directly on the pixel grid, without resampling.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.optics.zernike import EXPONENTS, N_TERMS

ELLIPSE_COLUMNS = 5
"""Center x, y, semi-major and semi-minor axis (mm), angle of the major axis (rad)."""


@dataclass(frozen=True)
class PupilFrames:
    """P pupils with their wavefronts, over the bounding box and over the unit disc.

    Attributes
    ----------
    box_polynomial_um : (P, 28), um
        Monomials of W over the bounding box, x and y in [-1, 1], without piston.
    disc_polynomial_um : (P, 28), um
        Monomials of W over the unit disc w.  The point of the box is
        (w_x, r w_x + s w_y) with r = ``shear_ratio`` and s = sqrt(1 - r²).
    half_width_um_per_px : (P, 2)
        Half sides of the box in t.  A derivative by box coordinates divided by it is a
        slope in pixels.
    shear_ratio : (P,)
        r; in box coordinates, the pupil is x² - 2 r x y + y² <= 1 - r².
    log_amplitude : (P, 6)
        Apodization exp(c0 + c1 x + c2 y + c3 x² + c4 x y + c5 y²) over the box.
    wavelength_nm : (P,)
    """

    box_polynomial_um: NDArray[np.float64]
    disc_polynomial_um: NDArray[np.float64]
    half_width_um_per_px: NDArray[np.float64]
    shear_ratio: NDArray[np.float64]
    log_amplitude: NDArray[np.float64]
    wavelength_nm: NDArray[np.float64]


def _bos_nodes() -> NDArray[np.float64]:
    """Return 28 nodes that determine a polynomial of degree 6: rings of 13, 9, 5, 1."""
    points = [
        (radius * math.cos(angle), radius * math.sin(angle))
        for radius, count in ((1.0, 13), (0.78, 9), (0.43, 5), (0.0, 1))
        for angle in 2.0 * math.pi * np.arange(count) / count
    ]
    return np.array(points)


def _monomials(points: NDArray[Any]) -> NDArray[np.float64]:
    return points[:, :1] ** EXPONENTS[:, 0] * points[:, 1:] ** EXPONENTS[:, 1]


NODES = _bos_nodes()
FROM_NODES = np.ascontiguousarray(np.linalg.inv(_monomials(NODES)))
_POWER_X = np.ascontiguousarray(EXPONENTS[:, 0])
_POWER_Y = np.ascontiguousarray(EXPONENTS[:, 1])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _substitute(
    source: NDArray[np.float64],
    matrix: NDArray[np.float64],
    shift: NDArray[np.float64],
    nodes: NDArray[np.float64],
    from_nodes: NDArray[np.float64],
    power_x: NDArray[np.int64],
    power_y: NDArray[np.int64],
    out: NDArray[np.float64],
) -> None:
    """Write the monomials of source(shift + matrix w) to ``out``, from node values."""
    values = np.zeros(source.size)
    xs, ys = np.empty(7), np.empty(7)
    xs[0] = ys[0] = 1.0
    for k in range(nodes.shape[0]):
        x = shift[0] + matrix[0, 0] * nodes[k, 0] + matrix[0, 1] * nodes[k, 1]
        y = shift[1] + matrix[1, 0] * nodes[k, 0] + matrix[1, 1] * nodes[k, 1]
        for i in range(1, 7):
            xs[i] = xs[i - 1] * x
            ys[i] = ys[i - 1] * y
        for j in range(source.size):
            values[k] += source[j] * xs[power_x[j]] * ys[power_y[j]]
    out[:] = 0.0
    for j in range(source.size):
        for k in range(source.size):
            out[j] += from_nodes[j, k] * values[k]
    out[0] = 0.0


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _frames(
    polynomial: NDArray[np.float64],
    radius: NDArray[np.float64],
    jacobian: NDArray[np.float64],
    ellipse: NDArray[np.float64],
    tables: tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]],
    box: NDArray[np.float64],
    disc: NDArray[np.float64],
    half: NDArray[np.float64],
    shear: NDArray[np.float64],
) -> None:
    """Fill the arrays of `PupilFrames`."""
    nodes, from_nodes, power_x, power_y = tables
    matrix, shift, lower = np.empty((2, 2)), np.empty(2), np.zeros((2, 2))
    lower[0, 0] = 1.0
    zero = np.zeros(2)
    for p in range(polynomial.shape[0]):
        cx, cy, major, minor, angle = ellipse[p]
        cosine, sine = math.cos(angle), math.sin(angle)
        exx = major * major * cosine * cosine + minor * minor * sine * sine
        eyy = major * major * sine * sine + minor * minor * cosine * cosine
        exy = (major * major - minor * minor) * cosine * sine
        j = jacobian[p]
        det = j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]
        # Inverse transpose of J: from the pupil's u to t.
        txx, txy = j[1, 1] / det, -j[1, 0] / det
        tyx, tyy = -j[0, 1] / det, j[0, 0] / det
        sxx = txx * txx * exx + 2.0 * txx * txy * exy + txy * txy * eyy
        syy = tyx * tyx * exx + 2.0 * tyx * tyy * exy + tyy * tyy * eyy
        sxy = txx * tyx * exx + (txx * tyy + txy * tyx) * exy + txy * tyy * eyy
        half[p, 0], half[p, 1] = math.sqrt(sxx), math.sqrt(syy)
        shear[p] = sxy / (half[p, 0] * half[p, 1])
        for i in range(2):
            for q in range(2):
                matrix[i, q] = j[q, i] * half[p, q] / radius[p]
        shift[0], shift[1] = cx / radius[p], cy / radius[p]
        is_same = shift[0] == 0.0 and shift[1] == 0.0 and shear[p] == 0.0
        is_same = is_same and abs(matrix[0, 1]) + abs(matrix[1, 0]) == 0.0
        is_same = is_same and abs(matrix[0, 0] - 1.0) + abs(matrix[1, 1] - 1.0) < 1e-14
        if is_same:
            for k in range(1, polynomial.shape[1]):
                box[p, k] = polynomial[p, k]
            box[p, 0] = 0.0
        else:
            _substitute(
                polynomial[p],
                matrix,
                shift,
                nodes,
                from_nodes,
                power_x,
                power_y,
                box[p],
            )
        if shear[p] == 0.0:
            for k in range(box.shape[1]):
                disc[p, k] = box[p, k]
        else:
            lower[1, 0] = shear[p]
            lower[1, 1] = math.sqrt(1.0 - shear[p] * shear[p])
            _substitute(
                box[p], lower, zero, nodes, from_nodes, power_x, power_y, disc[p]
            )


def _log_amplitudes(
    apodization: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
    jacobian: NDArray[np.float64],
    ellipse: NDArray[np.float64],
    half: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the coefficients (P, 6) of -k |u - u0|² over the boxes.

    The apodization is k (P,), mm^-2, and u0 (P, 2), mm.
    """
    log_amplitude = np.zeros((ellipse.shape[0], 6))
    if apodization is None:
        return log_amplitude
    per_mm2, centre_mm = apodization
    offset = ellipse[:, :2] - centre_mm
    matrix = np.swapaxes(jacobian, 1, 2) * half[:, None, :]
    square = np.swapaxes(matrix, 1, 2) @ matrix
    linear = np.einsum("pi,pij->pj", offset, matrix)
    log_amplitude[:, 0] = (offset**2).sum(axis=1)
    log_amplitude[:, 1:3] = 2.0 * linear
    log_amplitude[:, 3], log_amplitude[:, 5] = square[:, 0, 0], square[:, 1, 1]
    log_amplitude[:, 4] = 2.0 * square[:, 0, 1]
    return -per_mm2[:, None] * log_amplitude


def pupil_ellipses(
    pupil_ellipse: NDArray[np.float64] | None, circle_radius_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ellipses (P, 5), see `ELLIPSE_COLUMNS`; by default, the circles."""
    if pupil_ellipse is not None:
        return pupil_ellipse
    found = np.zeros((circle_radius_mm.size, ELLIPSE_COLUMNS))
    found[:, 2:4] = circle_radius_mm[:, None]
    return found


def pupil_frames(
    polynomial_um: NDArray[np.float64],
    *,
    circle_radius_mm: NDArray[np.float64],
    wavelength_nm: NDArray[np.float64],
    pixel_from_mrad: NDArray[np.float64],
    pupil_ellipse: NDArray[np.float64] | None = None,
    apodization: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> PupilFrames:
    """Convert pupils to pixel coordinates.

    Parameters
    ----------
    polynomial_um : (P, 28), um
        Monomials on the unit circle; piston is ignored.
    circle_radius_mm, wavelength_nm : (P,)
    pixel_from_mrad : (P, 2, 2)
        Jacobian from visual angle (x right, y up) to pixels (x right, y up).
    pupil_ellipse : (P, 5), optional
        See `ELLIPSE_COLUMNS`; the whole circle by default.
    apodization : ((P,), (P, 2)), optional
        k in mm^-2 and u0 in mm of the amplitude exp(-k |u - u0|²).
    """
    count = polynomial_um.shape[0]
    pupil_ellipse = pupil_ellipses(pupil_ellipse, circle_radius_mm)
    jacobian = np.ascontiguousarray(pixel_from_mrad, dtype=np.float64)
    box, disc = np.empty((count, N_TERMS)), np.empty((count, N_TERMS))
    half, shear = np.empty((count, 2)), np.empty(count)
    _frames(
        np.ascontiguousarray(polynomial_um, dtype=np.float64),
        np.ascontiguousarray(circle_radius_mm, dtype=np.float64),
        jacobian,
        np.ascontiguousarray(pupil_ellipse, dtype=np.float64),
        (NODES, FROM_NODES, _POWER_X, _POWER_Y),
        box,
        disc,
        half,
        shear,
    )
    return PupilFrames(
        box_polynomial_um=box,
        disc_polynomial_um=disc,
        half_width_um_per_px=half,
        shear_ratio=shear,
        log_amplitude=_log_amplitudes(apodization, jacobian, pupil_ellipse, half),
        wavelength_nm=wavelength_nm,
    )
