"""What is known of an eye before its wavefront is: the prior of estimation.

27 coefficients cannot fix 45 parameters; among the eyes that fit, the prior picks the
one nearest to what eyes of that refraction are like.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.parameters import (
    N_PARAMETERS,
    PARAMETERS,
    allowed_ranges,
    column,
    mean_vector,
)

LENGTH_PER_DPT_MM = -0.299
RADIUS_PER_DPT_MM = 0.022
"""Myopia is mostly a long eye: axial length and anterior corneal radius against the
spherical refraction (Atchison 2006)."""

REFRACTION_LIMITS_DPT = (-12.0, 6.0)
"""Refractions that the two lines above are used for."""


@dataclass(frozen=True)
class Prior:
    """Independent normal prior in table order; each number in its parameter's unit."""

    _mean: NDArray[np.float64]
    _deviation: NDArray[np.float64]

    def to_unit(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Parameters (..., 45) in deviations from the mean."""
        return (vectors - self._mean) / self._deviation

    def from_unit(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Inverse of `to_unit`."""
        return self._mean + unit * self._deviation

    def unit_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Give the allowed ranges in deviations from the mean."""
        low, high = allowed_ranges().T
        return self.to_unit(low), self.to_unit(high)


def mean_eyes(refraction_dpt: ArrayLike) -> NDArray[np.float64]:
    """Vectors (..., 45) of the mean eyes of spherical refractions (...), dpt.

    Refractions count within `REFRACTION_LIMITS_DPT`.
    """
    clipped_dpt = np.clip(refraction_dpt, *REFRACTION_LIMITS_DPT)
    eyes = np.broadcast_to(mean_vector(), (*np.shape(clipped_dpt), N_PARAMETERS)).copy()
    eyes[..., column("eye_length_mm")] += LENGTH_PER_DPT_MM * clipped_dpt
    eyes[..., column("cornea_anterior_radius_mm")] += RADIUS_PER_DPT_MM * clipped_dpt
    return eyes


def deviations() -> NDArray[np.float64]:
    """Give standard deviations (45,) about a mean eye, each in its own unit."""
    return np.array([row.deviation for row in PARAMETERS])


def prior_for_refraction(refraction_dpt: float) -> Prior:
    """Prior around the mean eye of this spherical refraction M, dpt."""
    return Prior(mean_eyes(refraction_dpt), deviations())
