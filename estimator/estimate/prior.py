"""Prior of the estimation.

27 coefficients do not determine 45 parameters; among the eyes that fit, the prior
selects the one nearest to the mean eye of that refraction.
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
"""Range of refractions in which the two slopes above apply."""


@dataclass(frozen=True)
class Prior:
    """Independent normal prior in table order, in the units of the parameters."""

    _mean: NDArray[np.float64]
    _deviation: NDArray[np.float64]

    def to_unit(self, vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parameters (..., 45) in deviations from the mean."""
        return (vectors - self._mean) / self._deviation

    def from_unit(self, unit: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return parameters from deviations, the inverse of `to_unit`."""
        return self._mean + unit * self._deviation

    def unit_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the allowed ranges in deviations from the mean."""
        low, high = allowed_ranges().T
        return self.to_unit(low), self.to_unit(high)


def mean_eyes(refraction_dpt: ArrayLike) -> NDArray[np.float64]:
    """Return vectors (..., 45) of the mean eyes of spherical refractions (...), dpt.

    Refractions are clamped to `REFRACTION_LIMITS_DPT`.
    """
    clipped_dpt = np.clip(refraction_dpt, *REFRACTION_LIMITS_DPT)
    eyes = np.broadcast_to(mean_vector(), (*np.shape(clipped_dpt), N_PARAMETERS)).copy()
    eyes[..., column("eye_length_mm")] += LENGTH_PER_DPT_MM * clipped_dpt
    eyes[..., column("cornea_anterior_radius_mm")] += RADIUS_PER_DPT_MM * clipped_dpt
    return eyes


def deviations() -> NDArray[np.float64]:
    """Return standard deviations (45,) about a mean eye, each in its own unit."""
    return np.array([row.deviation for row in PARAMETERS])


def prior_for_refraction(refraction_dpt: float) -> Prior:
    """Return the prior around the mean eye of a spherical refraction M, dpt."""
    return Prior(mean_eyes(refraction_dpt), deviations())
