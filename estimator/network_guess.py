"""The eye network's answer to a profile: an eye of about the measured wavefront."""

import numpy as np
from numpy.typing import NDArray

from estimator.eye_parameters import allowed_ranges
from estimator.network_card import NetworkUnavailable
from estimator.networks import network_eye
from estimator.profiles import EyeProfile


class NoAxialMeasurement(NetworkUnavailable):
    """The network knows wavefronts of the axis only, and none was measured there."""


def network_guess(profile: EyeProfile) -> NDArray[np.float64]:
    """Parameters (45,) within their allowed ranges, from the first axial measurement.

    Raises
    ------
    NetworkUnavailable
        No weights, no measurement on the axis, or one out of the training ranges.
    """
    axial = [m for m in profile.measurements if m.is_on_axis]
    if not axial:
        raise NoAxialMeasurement("no measurement on the axis")
    vector = network_eye(
        axial[0].zernike_um,
        pupil_diameter_mm=axial[0].pupil_diameter_mm,
        wavelength_nm=axial[0].wavelength_nm,
    )
    return np.clip(vector, *allowed_ranges().T)
