"""Pupils in pixel coordinates t, in which pixels are unit squares.

With p = J theta for a Jacobian J (``pixel_from_mrad``), the kernel is |int exp(2 pi i
(W - p.t) / lambda)|² over t = J^-T u.  In t (um/px), an elliptical pupil is again an
ellipse, described by its bounding box and a shear.  PSFs are therefore computed
directly on the pixel grid, without resampling.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compiled import compiled_psfs

ELLIPSE_COLUMNS = 5
"""Center x, y, semi-major and semi-minor axis (mm), angle of the major axis (rad)."""


@dataclass(frozen=True)
class PupilFrames:
    """P pupils with their wavefronts, over the bounding box and over the unit disc.

    Attributes
    ----------
    box_polynomial_um : (P, n_terms), um
        Monomials of W over the bounding box, x and y in [-1, 1], without piston.
    disc_polynomial_um : (P, n_terms), um
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
    polynomial_um : (P, n_terms), um
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
    box, disc = np.empty(polynomial_um.shape), np.empty(polynomial_um.shape)
    half, shear = np.empty((count, 2)), np.empty(count)
    compiled_psfs().call(
        "frame_pupils",
        np.ascontiguousarray(polynomial_um, dtype=np.float64),
        np.ascontiguousarray(circle_radius_mm, dtype=np.float64),
        np.ascontiguousarray(pupil_ellipse, dtype=np.float64),
        jacobian,
        *(box, disc, half, shear),
    )
    return PupilFrames(
        box_polynomial_um=box,
        disc_polynomial_um=disc,
        half_width_um_per_px=half,
        shear_ratio=shear,
        log_amplitude=_log_amplitudes(apodization, jacobian, pupil_ellipse, half),
        wavelength_nm=wavelength_nm,
    )
