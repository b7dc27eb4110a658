"""Choice of the PSF engine: ray optics if its predicted error permits it.

The prediction is a fit to 2,600 random wavefronts (pure cylinders with a meridian in
focus, spherical aberration, coma, trefoil, higher orders and defocus; n = 16 to 400;
pupils of 2 to 7 mm, three wavelengths, three pixel sizes).  Images were filtered with
both engines, and the PSNR of 98 % of them exceeds the prediction.  The RMS without tilt
is a better predictor than the width of the spot, n = 2 g D / lambda, because a wide
spot may have most of its light in a narrow core (coma, caustics), where ray optics
fails.

Ray optics misplaces more light than wave optics where this choice permits it: 3.2 %
against 0.2 % on average, over the six presets at 3 to 6 mm, fields to 25 deg, -4 to
0.8 dpt, pixels of 0.73 mrad.  In images, little of that remains.  All PSFs together
misplace 1.9 % (keratoconus 2.2 %); with `tables.GEOMETRIC_FROM_DB` of 53, 55 and 57
instead of 51, it is 1.4, 0.9 and 0.5 %, for 10, 33 and 78 % more processor time.  A
choice that knew each PSF's error and time would reach 1.6 % for 3 % more time.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import inverse_monomial_matrix
from estimator.psf.survey import PupilSurvey
from estimator.psf.tables import (
    BASE_DB,
    CROSS_FADE_DB,
    GEOMETRIC_FROM_DB,
    PER_NARROW_DB,
    PER_PIXEL_DB,
    PER_RMS_DB,
)

WAVE_DB = 54.0
"""PSNR exceeded by wave optics, and by the ENZ series within its domain."""

_N_PLANE = 3
"""Number of terms of piston and tilt."""


def rms_waves_ratio(survey: PupilSurvey) -> NDArray[np.float64]:
    """Return the RMS (P,) of wavefronts without tilt over their pupils, in waves."""
    polynomial_um = survey.frames.disc_polynomial_um
    zernike_um = polynomial_um @ inverse_monomial_matrix(polynomial_um.shape[1])
    rms_um: NDArray[np.float64] = np.sqrt((zernike_um[:, _N_PLANE:] ** 2).sum(axis=1))
    return rms_um / (survey.frames.wavelength_nm / 1000.0)


def predicted_psnr_db(survey: PupilSurvey) -> NDArray[np.float64]:
    """Return the PSNR (P,) that ray-optical images exceed in 98 % of all cases."""
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
    """Return the weight (P,) of ray optics in each kernel: 0 is waves, 1 is rays."""
    above = (predicted_psnr_db(survey) - GEOMETRIC_FROM_DB) / CROSS_FADE_DB
    return np.clip(above, 0.0, 1.0)


def predicted_least_psnr_db(
    survey: PupilSurvey, geometric_ratio: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the PSNR (P,) that images with these kernels are predicted to exceed."""
    return np.where(geometric_ratio > 0.0, predicted_psnr_db(survey), WAVE_DB)
