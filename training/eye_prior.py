"""The prior of the estimation in torch: what eyes of a refraction are like.

See `estimator.estimation_prior`.  25 coefficients leave 20 of the 45 parameters open;
an estimator that is only judged by them turns corneas and tilts lenses at random.
"""

from functools import cache

import numpy as np
import torch
from torch import Tensor

from estimator import estimation_prior
from estimator.network_card import FIRST_TERM
from estimator.prescription import C20
from estimator.units import SPHERE_PER_C20


def mean_eyes(x: Tensor) -> Tensor:
    """Mean eyes (N, 45) of measurements (N, 27): 25 coefficients, pupil, wavelength."""
    refraction_dpt = -SPHERE_PER_C20 * x[:, C20 - FIRST_TERM] / (x[:, 25] / 2.0) ** 2
    low, high = estimation_prior.REFRACTION_LIMITS_DPT
    clipped_dpt = torch.clamp(refraction_dpt, low, high)
    start, slope = (torch.as_tensor(v, device=x.device) for v in _line())
    return start.to(x.dtype) + clipped_dpt[:, None] * slope.to(x.dtype)


@cache
def _line() -> tuple[np.ndarray, np.ndarray]:
    """Mean eye of a refraction: its value at 0 dpt and its change with 1 dpt."""
    start, one = estimation_prior.mean_eyes(np.array([0.0, 1.0]))
    return start, one - start


def squared_deviation(eyes: Tensor, x: Tensor) -> Tensor:
    """Mean over the 45 parameters (N,) of the squared deviation from the mean eye."""
    deviations = torch.as_tensor(estimation_prior.deviations(), device=x.device)
    unit = (eyes - mean_eyes(x)) / deviations.to(eyes.dtype)
    return torch.mean(unit**2, dim=1)
