"""Contrast sensitivity of the visual system, and its optical and neural parts.

The contrast sensitivity of the Standard Spatial Observer, measured with natural optics,
divided by the modulation transfer of the mean eye is the neural contrast sensitivity.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

OBSERVER_PUPIL_MM = 4.0
"""Natural pupil diameter of the ModelFest observers (displays of 30 cd/m²)."""

MEAN_EYE_NM = 555.0


def contrast_sensitivity(frequency_cpd: ArrayLike) -> NDArray[np.float64]:
    """Return the contrast sensitivity (...) with natural optics.

    References
    ----------
    Watson & Ahumada, J. Vision 5(9), 2005: the "HPmH" function of ModelFest.
    """
    cpd = np.abs(np.asarray(frequency_cpd, dtype=np.float64))
    high = 1.0 / np.cosh(np.minimum((cpd / 4.1726) ** 0.7786, 700.0))
    low = 1.0 / np.cosh(np.minimum(cpd / 1.3625, 700.0))
    return 373.08 * (high - 0.8493 * low)


def perfect_transfer(
    frequency_cpd: ArrayLike, *, pupil_diameter_mm: float, wavelength_nm: float
) -> NDArray[np.float64]:
    """Return the diffraction-limited modulation transfer (...) of a circular pupil."""
    cutoff_cpd = math.radians(1.0) * pupil_diameter_mm * 1e6 / wavelength_nm
    ratio = np.clip(np.abs(np.asarray(frequency_cpd)) / cutoff_cpd, 0.0, 1.0)
    transfer: NDArray[np.float64] = (
        2.0 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1.0 - ratio**2))
    )
    return transfer


def mean_eye_transfer(
    frequency_cpd: ArrayLike, *, pupil_diameter_mm: float
) -> NDArray[np.float64]:
    """Return the mean modulation transfer (...) of 200 best-corrected eyes at 555 nm.

    The formula is valid for pupils of 2 to 6 mm.

    References
    ----------
    Watson, J. Vision 13(6):18, 2013.
    """
    d = pupil_diameter_mm
    knee_cpd = 21.95 - 5.512 * d + 0.3922 * d**2
    perfect = perfect_transfer(
        frequency_cpd, pupil_diameter_mm=d, wavelength_nm=MEAN_EYE_NM
    )
    falloff = 1.0 + np.square(np.asarray(frequency_cpd) / knee_cpd)
    return np.sqrt(perfect) * falloff**-0.62


def neural_sensitivity(frequency_cpd: ArrayLike) -> NDArray[np.float64]:
    """Return the neural contrast sensitivity (...), without the optics."""
    cpd = np.asarray(frequency_cpd, dtype=np.float64)
    optics = mean_eye_transfer(cpd, pupil_diameter_mm=OBSERVER_PUPIL_MM)
    return contrast_sensitivity(cpd) / np.maximum(optics, 1e-3)
