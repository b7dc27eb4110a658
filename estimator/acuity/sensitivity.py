"""Contrast sensitivity of people: total, optical and neural.

The Standard Spatial Observer's contrast sensitivity is that of many people with their
natural optics; divided by the mean eye's modulation transfer it is that of the retina
and the brain alone.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

OBSERVER_PUPIL_MM = 4.0
"""Natural pupils of the observers of the ModelFest displays (30 cd/m²)."""

MEAN_EYE_NM = 555.0


def contrast_sensitivity(frequency_cpd: ArrayLike) -> NDArray[np.float64]:
    """Return the contrast sensitivity (...) of people with their natural optics.

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
    """Return the modulation transfer (...) of a round pupil without aberrations."""
    cutoff_cpd = math.radians(1.0) * pupil_diameter_mm * 1e6 / wavelength_nm
    ratio = np.clip(np.abs(np.asarray(frequency_cpd)) / cutoff_cpd, 0.0, 1.0)
    transfer: NDArray[np.float64] = (
        2.0 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1.0 - ratio**2))
    )
    return transfer


def mean_eye_transfer(
    frequency_cpd: ArrayLike, *, pupil_diameter_mm: float
) -> NDArray[np.float64]:
    """Return the mean modulation transfer (...) of 200 best corrected eyes, 555 nm.

    References
    ----------
    Watson, J. Vision 13(6):18, 2013: pupils of 2 to 6 mm.
    """
    d = pupil_diameter_mm
    knee_cpd = 21.95 - 5.512 * d + 0.3922 * d**2
    perfect = perfect_transfer(
        frequency_cpd, pupil_diameter_mm=d, wavelength_nm=MEAN_EYE_NM
    )
    fall = 1.0 + np.square(np.asarray(frequency_cpd) / knee_cpd)
    return np.sqrt(perfect) * fall**-0.62


def neural_sensitivity(frequency_cpd: ArrayLike) -> NDArray[np.float64]:
    """Return the contrast sensitivity (...) of retina and brain without the optics."""
    cpd = np.asarray(frequency_cpd, dtype=np.float64)
    optics = mean_eye_transfer(cpd, pupil_diameter_mm=OBSERVER_PUPIL_MM)
    return contrast_sensitivity(cpd) / np.maximum(optics, 1e-3)
