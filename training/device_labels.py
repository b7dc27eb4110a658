"""Labels of the domains of `tasks`, traced on a GPU by `training.tracer`."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from estimator.eye.assembly import AQUEOUS, DIAMETER
from training.tasks import LENS_DIAMETER_MARGINS, N_EYE, Domain
from training.tracer.accommodation import (
    accommodated_eyes,
    focus_of_eyes,
    smallest_diameters_mm,
)
from training.tracer.circle import refraction_of_eyes, zernike_of_eyes
from training.tracer.field import field_aberrations_of_eyes


@torch.no_grad()
def label_on_device(
    domain: Domain, inputs: NDArray[np.float64], device: torch.device
) -> NDArray[np.float64]:
    """Label inputs (n, n_inputs) like ``domain.label``: targets (n, n_targets).

    Vignetted rows are nan. Rays are traced in float64.

    Raises
    ------
    ValueError
        The domain is not supported.
    """
    columns = torch.as_tensor(inputs, dtype=torch.float64, device=device)
    makers = {"on_axis": _on_axis, "field": _field, "focus": _focus, "lens": _lens}
    if domain.name not in makers:
        raise ValueError(f"domain '{domain.name}': allowed are {', '.join(makers)}")
    targets, is_traced = makers[domain.name](columns, domain)
    targets = torch.where(is_traced[:, None], targets, torch.nan)
    return targets.cpu().numpy()


def _on_axis(columns: Tensor, _domain: Domain) -> tuple[Tensor, Tensor]:
    zernike_um, is_traced = zernike_of_eyes(
        columns[:, :N_EYE], columns[:, N_EYE], columns[:, N_EYE + 1]
    )
    return zernike_um[:, 1:], is_traced


def _field(columns: Tensor, _domain: Domain) -> tuple[Tensor, Tensor]:
    found = field_aberrations_of_eyes(columns[:, :N_EYE], *columns[:, N_EYE:].T)
    parts = (
        found.zernike_um[:, 1:],
        found.zernike_radius_mm[:, None],
        found.ellipse_mm,
    )
    return torch.cat(parts, dim=1), found.ok


def _focus(columns: Tensor, domain: Domain) -> tuple[Tensor, Tensor]:
    """Label focus rows; each eye has ``n_repeats`` rows, as in `datasets.draw`."""
    eyes = columns[:: domain.n_repeats]
    focus_dpt = columns[:, -1].reshape(len(eyes), domain.n_repeats)
    found = focus_of_eyes(eyes[:, :N_EYE], eyes[:, N_EYE], focus_dpt)
    changes = (found.lens_diameter_change_mm, found.aqueous_thickness_change_mm)
    targets = torch.stack([change.flatten() for change in changes], dim=1)
    return targets, torch.all(torch.isfinite(targets), dim=1)


def _lens(columns: Tensor, _domain: Domain) -> tuple[Tensor, Tensor]:
    eyes, pupil_mm = columns[:, :N_EYE], columns[:, N_EYE]
    widest, least = LENS_DIAMETER_MARGINS.ravel().tolist()
    widest_mm = widest * eyes[:, DIAMETER]
    room_mm = least * smallest_diameters_mm(eyes) - widest_mm
    focused = accommodated_eyes(eyes, widest_mm + columns[:, -1] * room_mm)
    refraction_dpt, is_traced = refraction_of_eyes(focused, pupil_mm)
    changes_mm = (focused - eyes)[:, [DIAMETER, AQUEOUS]]
    return torch.cat([-refraction_dpt[:, None], changes_mm], dim=1), is_traced
