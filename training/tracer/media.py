"""Refractive indices of the ocular media for wavelengths in a batch."""

import torch
from torch import Tensor

from estimator.eye.tracing import MEDIA_INWARDS
from estimator.optics import media
from estimator.optics.units import NM_PER_UM
from training.tracer.batches import constant

_POLE_UM2 = 0.028


@constant
def _dispersion(device: torch.device) -> Tensor:
    """Return (4, 5): 1, L², 1/(L² - 0.028) and its square to the media, air first."""
    # The formula is linear in these four terms: solve for them at four wavelengths, so
    # that the table of indices stays in one place.
    wavelength_nm = torch.tensor([400.0, 500.0, 650.0, 900.0], dtype=torch.float64)
    values = [media.refractive_index(m, wavelength_nm.numpy()) for m in MEDIA_INWARDS]
    indices = torch.stack([torch.from_numpy(v) for v in values], dim=-1)
    return torch.linalg.solve(_terms(wavelength_nm), indices).to(device)


def _terms(wavelength_nm: Tensor) -> Tensor:
    squared = (wavelength_nm / NM_PER_UM) ** 2
    inverse = 1.0 / (squared - _POLE_UM2)
    return torch.stack([torch.ones_like(squared), squared, inverse, inverse**2], dim=-1)


def refractive_indices(wavelength_nm: Tensor) -> Tensor:
    """Return indices (B, 5), float64, from the air inward, at wavelengths (B,) nm.

    Raises
    ------
    ValueError
        A wavelength outside 365 to 1014 nm.
    """
    low, high = media.WAVELENGTH_LIMITS_NM
    if not bool(((wavelength_nm >= low) & (wavelength_nm <= high)).all()):
        raise ValueError(
            f"wavelength {wavelength_nm} nm: allowed is {low:g} to {high:g} nm"
        )
    wavelength_nm = wavelength_nm.to(torch.float64)
    return _terms(wavelength_nm) @ _dispersion(wavelength_nm.device)
