"""Choice of the PSF engine: ray optics where its predicted error permits it.

The rule is a fit.  2,600 random wavefronts (pure cylinders with a meridian in focus,
spherical aberration, coma, trefoil and higher orders, defocus; n = 16 to 400; pupils 2
to 7 mm, three wavelengths, three pixel sizes) were filtered with both engines; 98 % of
them lie above the prediction (bench_psf.py --switch repeats it).  The tilt-free RMS is
a better predictor than the spot's width n = 2 g D / lambda, because a wide spot may
hold most of its light in a narrow core (coma, caustics), where rays fail.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import monomial_matrix
from estimator.psf.survey import PupilSurvey

BASE_DB = 41.56
PER_RMS_DB = 7.40
PER_PIXEL_DB = 5.88
PER_NARROW_DB = 2.58
"""PSNR of ray optics: base, and increments per decade of the RMS in waves; the pixel in
lambda/D; one plus the RMS slope, lambda/D, across the spot's narrow side (a meridian in
focus)."""

GEOMETRIC_FROM_DB = 51.0
CROSS_FADE_DB = 0.5
"""Above the first the engines are blended; from their sum on only rays are traced.  The
fade is narrow, because a blended kernel costs both; the step it bridges is below 50 dB
anyway."""

WAVE_DB = 54.0
"""PSNR exceeded by images filtered with the wave method, or the ENZ series in its
domain."""

_N_PLANE = 3
"""Piston and tilts."""


def rms_waves_ratio(survey: PupilSurvey) -> NDArray[np.float64]:
    """Return the tilt-free RMS (P,) of wavefronts over their pupils, in wavelengths."""
    zernike_um = survey.frames.disc_polynomial_um @ np.linalg.inv(monomial_matrix())
    rms_um: NDArray[np.float64] = np.sqrt((zernike_um[:, _N_PLANE:] ** 2).sum(axis=1))
    return rms_um / (survey.frames.wavelength_nm / 1000.0)


def predicted_psnr_db(survey: PupilSurvey) -> NDArray[np.float64]:
    """Return the PSNR (P,) that ray-optical images exceed in 98 of 100 cases."""
    pixel_ratio = 1.0 / survey.unit_px.max(axis=1)
    rms = np.maximum(rms_waves_ratio(survey), 1e-6)
    psnr_db: NDArray[np.float64] = (
        BASE_DB
        + PER_RMS_DB * np.log10(rms)
        + PER_PIXEL_DB * np.log10(pixel_ratio)
        + PER_NARROW_DB * np.log10(1.0 + survey.narrow_ratio)
    )
    return psnr_db


def geometric_shares(survey: PupilSurvey) -> NDArray[np.float64]:
    """Return the share (P,) of ray optics in each kernel: 0 waves, 1 rays."""
    above = (predicted_psnr_db(survey) - GEOMETRIC_FROM_DB) / CROSS_FADE_DB
    return np.clip(above, 0.0, 1.0)


def predicted_least_psnr_db(
    survey: PupilSurvey, geometric_ratio: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the PSNR (P,) that images filtered with these kernels should exceed."""
    return np.where(geometric_ratio > 0.0, predicted_psnr_db(survey), WAVE_DB)
