"""Losses: of outputs, and of estimated eyes by their wavefronts."""

import torch
from torch import Tensor, nn

from training.eye_prior import squared_deviation
from training.models import Network
from training.tasks import N_EYE, ZERNIKE_NAMES
from training.tracer.circle import zernike_of_eyes

N_ZERNIKE = len(ZERNIKE_NAMES)
RIM_WEIGHT = 0.1
"""Weight of errors of the rim in mm relative to errors of the wavefront in um."""

LARGEST_MISFIT_UM = 20.0
"""Limit to which errors of traced coefficients are clipped: some eyes form no image."""


def standard_loss(model: Network, x: Tensor, y: Tensor) -> Tensor:
    """Return the mean absolute error of targets (N, n) in standard units."""
    return torch.mean(torch.abs(model.standard_error(x, y)))


def physical_loss(model: Network, x: Tensor, y: Tensor) -> Tensor:
    """Return the mean absolute error in physical units; the rim has a small weight."""
    error = torch.abs(model(x) - y)
    if error.shape[1] <= N_ZERNIKE:
        return error.mean()
    return error[:, :N_ZERNIKE].mean() + RIM_WEIGHT * error[:, N_ZERNIKE:].mean()


def parameter_loss(model: Network, x: Tensor, y: Tensor) -> Tensor:
    """Return the mean absolute error of the 45 parameters: naive loss (paper, 7.1.3).

    ``y`` (N, 45 + 27) are the eye and its coefficients, which are ignored.
    """
    return standard_loss(model, x, y[:, :N_EYE])


class DiscriminatorLoss(nn.Module):
    """Loss of an estimated eye's coefficients by the discriminator (paper, 5.4)."""

    def __init__(self, discriminator: Network, *, prior_weight: float = 0.0):
        super().__init__()
        self.prior_weight = prior_weight
        self.discriminator = discriminator.eval().requires_grad_(False)

    def forward(self, model: Network, x: Tensor, y: Tensor) -> Tensor:
        """Return the mean absolute error (um) of 25 terms without tilt, plus prior."""
        eyes = model(x)
        found_um = self.discriminator(torch.cat([eyes, x[:, -2:]], dim=1))[:, 2:]
        misfit_um = torch.mean(torch.abs(found_um - x[:, :-2]))
        return misfit_um + _prior(eyes, x, self.prior_weight)


class TracerLoss(nn.Module):
    """Loss of an estimated eye's coefficients by ray tracing, to 1e-4 um (float32)."""

    def __init__(self, *, prior_weight: float = 0.0):
        super().__init__()
        self.prior_weight = prior_weight

    def forward(self, model: Network, x: Tensor, y: Tensor) -> Tensor:
        """Return the loss as in `DiscriminatorLoss`, without vignetted eyes."""
        eyes = model(x)
        found_um, is_traced = zernike_of_eyes(
            eyes.double(), x[:, -2].double(), x[:, -1].double(), ray_dtype=torch.float32
        )
        misfit_um = torch.abs(found_um[is_traced, 3:] - x[is_traced, :-2])
        misfit_um = torch.clamp(misfit_um, max=LARGEST_MISFIT_UM).mean()
        return misfit_um + _prior(eyes, x, self.prior_weight)


def _prior(eyes: Tensor, x: Tensor, weight: float) -> Tensor | float:
    """Return the loss of eyes (N, 45) by their deviation from the mean eye."""
    return weight * squared_deviation(eyes, x).mean() if weight else 0.0
