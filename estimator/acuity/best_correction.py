"""The sphere and cylinder with which a wavefront has the highest visual Strehl ratio.

The least-squares refraction flattens the wavefront, and with large higher-order
aberrations another sphere and cylinder give a better image: a ratio of 0.15 instead of
0.05 in the preset `keratoconus` through 5 mm.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import minimize

from estimator.acuity.predict import TILTS
from estimator.acuity.transfer import (
    HIGHEST_CPD,
    NM_PER_MM,
    UM_PER_MM,
    check_known,
    clear_pupil,
    grid_wavefront_um,
    neural_sensitivity,
)
from estimator.optics.pupil_screen import PupilScreen

SECOND_ORDER = slice(3, 6)
C20 = 1
"""Place of defocus in the second order."""

N_SAMPLES = 128
"""Samples across the circle: the ratio is within 0.0005 of `predict_acuity`."""

SCAN_DPT = np.arange(-8, 9) * 0.25
"""Spheres added to each start: the ratio has several peaks along the sphere."""

FIRST_STEP_DPT, LAST_STEP_DPT = 0.2, 0.01


def best_correction_um(
    zernike_um: NDArray[np.float64],
    *,
    zernike_radius_mm: float,
    wavelength_nm: float,
    pupil_ellipse: NDArray[np.float64] | None = None,
    pupil_screen: PupilScreen | None = None,
    n_samples: int = N_SAMPLES,
) -> NDArray[np.float64]:
    """Return a wavefront (n,) with sphere and cylinder that maximize visual Strehl.

    The search starts from the least-squares refraction and from the wavefront as it is.

    Parameters
    ----------
    zernike_um : (n_terms,)
    pupil_ellipse, pupil_screen : optional
        See `optical_transfer`.
    n_samples : int
        Number of samples across the circle.

    Raises
    ------
    ValueError
        A coefficient is not finite, or the screen is a lattice of lenslets.
    """
    check_known(zernike_um, pupil_screen)
    ratio_of = _visual_strehl(
        zernike_um,
        radius_mm=zernike_radius_mm,
        wavelength_nm=wavelength_nm,
        pupil_ellipse=pupil_ellipse,
        pupil_screen=pupil_screen,
        n_samples=n_samples,
    )
    um_per_dpt = zernike_radius_mm**2 / (4.0 * np.sqrt(3.0))
    starts_um = [np.zeros(3)]
    if np.any(zernike_um[SECOND_ORDER]):
        starts_um.append(zernike_um[SECOND_ORDER])
    found = [_peak(ratio_of, start_um, um_per_dpt) for start_um in starts_um]
    best_um = np.array(zernike_um, dtype=np.float64)
    best_um[SECOND_ORDER] = max(found, key=ratio_of)
    return best_um


def _peak(
    ratio_of: Callable[[NDArray[Any]], float],
    start_um: NDArray[np.float64],
    um_per_dpt: float,
) -> NDArray[np.float64]:
    """Return the second order (3,) of the peak that a search from a start reaches."""
    scanned_um = np.tile(start_um, (SCAN_DPT.size, 1))
    scanned_um[:, C20] += SCAN_DPT * um_per_dpt
    start_dpt = max(scanned_um, key=ratio_of) / um_per_dpt
    step_dpt = FIRST_STEP_DPT * np.vstack([np.zeros(3), np.eye(3)])
    peak = minimize(
        lambda second_dpt: -ratio_of(second_dpt * um_per_dpt),
        start_dpt,
        method="Nelder-Mead",
        options={
            "initial_simplex": start_dpt + step_dpt,
            "xatol": LAST_STEP_DPT,
            "fatol": 1e-4,
        },
    )
    return peak.x * um_per_dpt


def _visual_strehl(
    zernike_um: NDArray[np.float64],
    *,
    radius_mm: float,
    wavelength_nm: float,
    pupil_ellipse: NDArray[np.float64] | None,
    pupil_screen: PupilScreen | None,
    n_samples: int,
) -> Callable[[NDArray[Any]], float]:
    """Return the visual Strehl ratio of a wavefront as a function of its second order.

    It is proportional to the integral of the point-spread function times the transform
    of the neural sensitivity, which needs one Fourier transform instead of two.
    """
    step_mm = 2.0 * radius_mm / n_samples
    along_mm = np.asarray(
        (np.arange(n_samples) + 0.5) * step_mm - radius_mm, dtype=np.float64
    )
    clear = clear_pupil(
        along_mm,
        zernike_radius_mm=radius_mm,
        wavelength_nm=wavelength_nm,
        pupil_ellipse=pupil_ellipse,
        pupil_screen=pupil_screen,
    )
    per_mm_cpd = np.radians(1.0) * NM_PER_MM / wavelength_nm
    padded = (2 * n_samples,) * 2
    along_cpd = fft.fftfreq(padded[0], 1.0 / padded[0]) * step_mm * per_mm_cpd
    radial_cpd = np.hypot(along_cpd[:, None], along_cpd)
    weight = np.where(radial_cpd <= HIGHEST_CPD, neural_sensitivity(radial_cpd), 0.0)
    seen_by_nerves = fft.fft2(weight).real
    wave_um = wavelength_nm / UM_PER_MM
    tried_um = np.array(zernike_um, dtype=np.float64)
    tried_um[TILTS] = 0.0

    def ratio_of(second_um: NDArray[Any]) -> float:
        tried_um[SECOND_ORDER] = second_um
        wavefront_um = grid_wavefront_um(tried_um, along_mm / radius_mm)
        pupil = clear * np.exp(2j * np.pi * wavefront_um / wave_um)
        light = np.abs(fft.fft2(pupil, padded)) ** 2
        return float((light * seen_by_nerves).sum() / light.sum())

    return ratio_of
