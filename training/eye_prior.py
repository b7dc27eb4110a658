"""The prior of the estimation in torch: what eyes of a refraction are like.

See `estimator.estimate.prior`.  25 coefficients leave 20 of the 45 parameters open;
an estimator that is only judged by them turns corneas and tilts lenses at random.
"""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from estimator.estimate import prior as estimation_prior
from estimator.networks.card import FIRST_TERM
from estimator.optics.prescription import C20
from estimator.optics.units import SPHERE_PER_C20


def mean_eyes(x: Tensor) -> Tensor:
    """Mean eyes (N, 45) of measurements (N, 27): 25 coefficients, pupil, wavelength."""
    refraction_dpt = -SPHERE_PER_C20 * x[:, C20 - FIRST_TERM] / (x[:, 25] / 2.0) ** 2
    low, high = estimation_prior.REFRACTION_LIMITS_DPT
    clipped_dpt = torch.clamp(refraction_dpt, low, high)
    start, slope, _ = _constants(x.dtype, x.device)
    return start + clipped_dpt[:, None] * slope


@cache
def _constants(dtype, device) -> tuple[Tensor, Tensor, Tensor]:
    """Mean eye at 0 dpt, its change with 1 dpt, and the deviations from it (45,)."""
    start, one = estimation_prior.mean_eyes(np.array([0.0, 1.0]))
    values = (start, one - start, estimation_prior.deviations())
    return tuple(torch.as_tensor(v, dtype=dtype, device=device) for v in values)


def squared_deviation(eyes: Tensor, x: Tensor) -> Tensor:
    """Mean over the 45 parameters (N,) of the squared deviation from the mean eye."""
    *_, deviations = _constants(x.dtype, x.device)
    unit = (eyes - mean_eyes(x)) / deviations
    return torch.mean(unit**2, dim=1)
