"""Prior of the estimation in torch: distribution of eyes with a given refraction.

See `estimator.estimate.problem`. 25 coefficients do not determine 45 parameters;
without a prior, an estimator rotates corneas and tilts lenses at random.
"""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from estimator.estimate import problem as estimation_prior
from estimator.networks.inference import FIRST_TERM
from estimator.optics.prescription import C20
from estimator.optics.units import SPHERE_PER_C20


def mean_eyes(x: Tensor) -> Tensor:
    """Return mean eyes (N, 45) for (N, 27): 25 coefficients, pupil, wavelength."""
    refraction_dpt = -SPHERE_PER_C20 * x[:, C20 - FIRST_TERM] / (x[:, 25] / 2.0) ** 2
    low, high = estimation_prior.REFRACTION_LIMITS_DPT
    clipped_dpt = torch.clamp(refraction_dpt, low, high)
    start, slope, _ = _constants(x.dtype, x.device)
    return start + clipped_dpt[:, None] * slope


@cache
def _constants(
    dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean eye at 0 dpt, its change per dpt, and the deviations (45,)."""
    start, one = estimation_prior.mean_eyes(np.array([0.0, 1.0]))
    values = (start, one - start, estimation_prior.deviations())
    return tuple(torch.as_tensor(v, dtype=dtype, device=device) for v in values)


def squared_deviation(eyes: Tensor, x: Tensor) -> Tensor:
    """Return the mean squared deviation (N,) of the 45 parameters from the mean eye."""
    *_, deviations = _constants(x.dtype, x.device)
    unit = (eyes - mean_eyes(x)) / deviations
    return torch.mean(unit**2, dim=1)
