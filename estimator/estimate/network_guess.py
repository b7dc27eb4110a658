"""Guess of the eye network: an eye with about the measured wavefront."""

import numpy as np
from numpy.typing import NDArray

from estimator.eye.parameters import allowed_ranges
from estimator.networks.inference import network_eye
from estimator.optics.zernike import N_TERMS
from estimator.profiles.parse import EyeProfile


def network_guess(profile: EyeProfile) -> NDArray[np.float64]:
    """Return parameters (45,) within their allowed ranges.

    Only the profile's leading measurement is used, which is on the axis.

    Raises
    ------
    NetworkUnavailable
        No weights, or a wavefront outside the training ranges.
    """
    vector = network_eye(
        profile.zernike_um[:N_TERMS],
        pupil_diameter_mm=profile.pupil_diameter_mm,
        wavelength_nm=profile.wavelength_nm,
    )
    return np.clip(vector, *allowed_ranges().T)
