"""Eyes drawn from the prior of the estimation (`estimator.estimate.problem`).

The ranges of Table 2 contain improbable eyes and exclude long, myopic ones. The service
estimates eyes with this prior, so these are the eyes for which it uses the networks.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from estimator.estimate.problem import REFRACTION_LIMITS_DPT, deviations, mean_eyes
from estimator.eye.assembly import (
    AQUEOUS,
    DIAMETER,
    SMALLEST_AQUEOUS_MM,
    SMALLEST_DIAMETER_RATIO,
    resized_eyes,
    smallest_diameter_mm,
)
from estimator.eye.parameters import allowed_ranges

LEAST_PROBABILITY = 1e-4
"""Normal deviates are truncated at this probability, 3.7 standard deviations."""

RELAXED_RATIO = 0.5
"""Fraction of relaxed eyes, if eyes may be accommodated."""


def population_eyes(
    unit: NDArray[np.float64], refraction_unit: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return eyes (n, 45) within their allowed ranges.

    Parameters
    ----------
    unit : (n, 45)
        Uniform in 0..1: the cumulative probability of each parameter.
    refraction_unit : (n,)
        The same for the refraction, uniform over `REFRACTION_LIMITS_DPT`.
    """
    low_dpt, high_dpt = REFRACTION_LIMITS_DPT
    means = mean_eyes(low_dpt + (high_dpt - low_dpt) * refraction_unit)
    normal = ndtri(np.clip(unit, LEAST_PROBABILITY, 1.0 - LEAST_PROBABILITY))
    return np.clip(means + deviations() * normal, *allowed_ranges().T)


def partly_accommodated_eyes(
    eyes: NDArray[np.float64], used_unit: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return eyes (n, 45), half of them accommodated.

    ``used_unit`` (n,) is in 0..1: up to `RELAXED_RATIO`, eyes are relaxed; above, the
    lens diameter is uniform over its range.  The conic constants, which are inputs of
    the networks, are those of the relaxed eyes.
    """
    used = np.maximum(used_unit - RELAXED_RATIO, 0.0) / (1.0 - RELAXED_RATIO)
    relaxed_mm = eyes[:, DIAMETER]
    shrunk_mm = used * (smallest_diameter_mm(eyes) - relaxed_mm)
    return resized_eyes(eyes, relaxed_mm + shrunk_mm)


def population_ranges(*, is_focused: bool) -> NDArray[np.float64]:
    """Return the ranges (45, 2) of population eyes, with or without accommodation."""
    ranges = allowed_ranges()
    if is_focused:
        ranges[DIAMETER, 0] *= SMALLEST_DIAMETER_RATIO
        ranges[AQUEOUS, 0] = min(ranges[AQUEOUS, 0], SMALLEST_AQUEOUS_MM)
    return ranges
