"""Losses: direct, and of an estimated eye judged by what it does to light."""

import torch
from torch import Tensor, nn

from training.eye_prior import squared_deviation
from training.models import Network
from training.tasks import N_EYE, ZERNIKE_NAMES
from training.tracer.circle import zernike_of_eyes

N_ZERNIKE = len(ZERNIKE_NAMES)
RIM_WEIGHT = 0.1
"""Weight of an error of a pupil's rim in mm against one of the wavefront in um."""

LARGEST_MISFIT_UM = 20.0
"""A traced coefficient farther off counts as this: rays of a hopeless eye scatter."""


def standard_loss(model: Network, x: Tensor, y: Tensor) -> Tensor:
    """Mean absolute error of targets (N, n) in standard units."""
    return torch.mean(torch.abs(model.standard_error(x, y)))


def physical_loss(model: Network, x: Tensor, y: Tensor) -> Tensor:
    """Mean absolute error in physical units; the rim counts little."""
    error = torch.abs(model(x) - y)
    if error.shape[1] <= N_ZERNIKE:
        return error.mean()
    return error[:, :N_ZERNIKE].mean() + RIM_WEIGHT * error[:, N_ZERNIKE:].mean()


def parameter_loss(model: Network, x: Tensor, y: Tensor) -> Tensor:
    """Mean absolute error of the 45 parameters: the naive loss of the paper's 7.1.3.

    ``y`` (N, 45 + 27): the eye, and its coefficients, which this loss does not read.
    """
    return standard_loss(model, x, y[:, :N_EYE])


class DiscriminatorLoss(nn.Module):
    """The estimated eye's coefficients by a trained discriminator (paper, 5.4)."""

    def __init__(self, discriminator: Network, *, prior_weight: float = 0.0):
        super().__init__()
        self.prior_weight = prior_weight
        self.discriminator = discriminator.eval().requires_grad_(False)

    def forward(self, model: Network, x: Tensor, y: Tensor) -> Tensor:
        """Mean absolute error (um) of the 25 terms without tilt, and the prior."""
        eyes = model(x)
        found_um = self.discriminator(torch.cat([eyes, x[:, -2:]], dim=1))[:, 2:]
        misfit_um = torch.mean(torch.abs(found_um - x[:, :-2]))
        return misfit_um + _prior(eyes, x, self.prior_weight)


class TracerLoss(nn.Module):
    """The estimated eye's coefficients by ray tracing, to 1e-4 um (float32 rays)."""

    def __init__(self, *, prior_weight: float = 0.0):
        super().__init__()
        self.prior_weight = prior_weight

    def forward(self, model: Network, x: Tensor, y: Tensor) -> Tensor:
        """As `DiscriminatorLoss`; eyes that light does not pass are left out."""
        eyes = model(x)
        found_um, is_traced = zernike_of_eyes(
            eyes.double(), x[:, -2].double(), x[:, -1].double(), ray_dtype=torch.float32
        )
        misfit_um = torch.abs(found_um[is_traced, 3:] - x[is_traced, :-2])
        misfit_um = torch.clamp(misfit_um, max=LARGEST_MISFIT_UM).mean()
        return misfit_um + _prior(eyes, x, self.prior_weight)


def _prior(eyes: Tensor, x: Tensor, weight: float) -> Tensor | float:
    """Loss of eyes (N, 45) that differ from what eyes of that refraction are like."""
    return weight * squared_deviation(eyes, x).mean() if weight else 0.0
