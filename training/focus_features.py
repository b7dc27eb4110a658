"""Approximate focusing, as layers before and after the focused-eye estimator.

Newton steps find the lens that focuses the eye, from paraxial optics and the spherical
aberration of the centered eye. The network learns the residual, the effect of tilts,
decentrations and offset terms: a few hundredths of a diopter, smooth in all inputs.
"""

import math

import torch
from torch import Tensor, nn

from estimator.eye.assembly import (
    ANTERIOR_THICKNESS_RATIO,
    AQUEOUS,
    CAP_VOLUME_RATIO,
    DIAMETER,
    SMALLEST_AQUEOUS_MM,
    SMALLEST_DIAMETER_RATIO,
    VOLUME,
)
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from training.eye_features import EyeFeatures, lens_thickness_mm, named

BOUND_MARGIN_MM = 1e-4
"""Distance from a bound within which a change of the lens counts as bounded."""

N_STEPS = 2
STEP_MM = -0.2
"""Step of the difference quotient; shorter ones are inaccurate in float32."""

SLOPE_SHARES = (0.5, 2.0)
"""Range of the slope of the vergence over the paraxial one."""

WIDEST_RATIO = 1.03
"""Limit on the lens diameter during the search, over the relaxed one."""


class FocusFeatures(nn.Module):
    """Features of the inputs (N, 47) of the focused-eye estimator.

    The network predicts the error of the lens that these layers find. `decode` clamps
    the lens to its range and computes the aqueous thickness.
    """

    n_features = EyeFeatures.N_FEATURES + 5
    n_encoded = 1

    def __init__(self) -> None:
        super().__init__()
        self.eye = EyeFeatures()
        for name, place in (("diameter", DIAMETER), ("aqueous", AQUEOUS)):
            one = torch.zeros(45)
            one[place] = 1.0
            self.register_buffer(f"{name}_column", one, persistent=False)

    def _accommodated(self, eye: Tensor, change_mm: Tensor) -> Tensor:
        """Return eyes (N, 45) with lens diameters changed by (N,), volume kept."""
        aqueous_mm = _aqueous_change_mm(eye, change_mm)
        return (
            eye
            + change_mm[:, None] * self.diameter_column
            + aqueous_mm[:, None] * self.aqueous_column
        )

    def _centered(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return lens change, mm, its slope, mm/dpt, and the focus error, dpt (N,)."""
        eye, focus_dpt = x[:, :45], x[:, 46]
        lowest_mm, highest_mm = _change_range_mm(eye)
        highest_mm = highest_mm + (WIDEST_RATIO - 1.0) * named(eye, "lens_diameter_mm")
        color_nm = torch.full_like(focus_dpt, REFERENCE_WAVELENGTH_NM)
        paraxial, excess = self.eye.vergence_of(eye, x[:, 45], color_nm)
        change_mm = torch.zeros_like(focus_dpt)
        for step in range(N_STEPS + 1):
            found = self._accommodated(eye, change_mm)
            beside = self._accommodated(eye, change_mm + STEP_MM)
            at_dpt, more_dpt = 1e3 * paraxial(found), 1e3 * excess(found)
            slope = STEP_MM / (1e3 * paraxial(beside) - at_dpt)
            missed_dpt = focus_dpt - at_dpt - more_dpt
            if step == N_STEPS:
                break
            change_mm = change_mm + slope * missed_dpt
            change_mm = torch.minimum(torch.maximum(change_mm, lowest_mm), highest_mm)
        # Spherical aberration changes the slope, but must not change its sign.
        share = 1.0 + slope * (1e3 * excess(beside) - more_dpt) / STEP_MM
        return change_mm, slope / torch.clamp(share, *SLOPE_SHARES), missed_dpt

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 54); the last three are those of `_centered`."""
        change_mm, slope, missed_dpt = self._centered(x)
        one, zero = torch.ones_like(x[:, 0]), torch.zeros_like(x[:, 0])
        color_nm = torch.full_like(one, REFERENCE_WAVELENGTH_NM)
        focused = self._accommodated(x[:, :45], change_mm)
        eye = self.eye(focused, x[:, 45], color_nm, one, zero, zero)
        more = [x[:, 45], x[:, 45] ** 2, change_mm, slope, missed_dpt]
        return torch.cat([eye, torch.stack(more, dim=1)], dim=1)

    def decode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Convert the error (N, 1) to the changes of lens and aqueous (N, 2), mm."""
        features = self(x) if features is None else features
        found_mm, slope, missed_dpt = features[:, -3:].unbind(dim=1)
        change_mm = found_mm + slope * missed_dpt + y[:, 0]
        lowest_mm, highest_mm = _change_range_mm(x)
        change_mm = torch.minimum(torch.maximum(change_mm, lowest_mm), highest_mm)
        return torch.stack([change_mm, _aqueous_change_mm(x, change_mm)], dim=1)

    def encode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Invert `decode`, also for changes beyond the range of the lens."""
        features = self(x) if features is None else features
        found_mm, slope, missed_dpt = features[:, -3:].unbind(dim=1)
        return (y[:, 0] - found_mm - slope * missed_dpt)[:, None]


def is_within_reach(x: Tensor, y: Tensor) -> Tensor:
    """Return the rows (N,) whose change of the lens (N, 2) is not at a bound."""
    lowest_mm, highest_mm = _change_range_mm(x)
    above = y[:, 0] > lowest_mm + BOUND_MARGIN_MM
    return above & (y[:, 0] < highest_mm - BOUND_MARGIN_MM)


def _change_range_mm(eye: Tensor) -> tuple[Tensor, Tensor]:
    """Return the smallest and largest change (N,) of the lens diameter, mm."""
    lowest_mm = smallest_diameters_mm(eye[:, :45]) - named(eye, "lens_diameter_mm")
    return lowest_mm, torch.zeros_like(lowest_mm)


def _aqueous_change_mm(eye: Tensor, change_mm: Tensor) -> Tensor:
    diameter_mm = named(eye, "lens_diameter_mm")
    volume_mm3 = named(eye, "lens_volume_mm3")
    growth_mm = lens_thickness_mm(
        diameter_mm + change_mm, volume_mm3
    ) - lens_thickness_mm(diameter_mm, volume_mm3)
    return -ANTERIOR_THICKNESS_RATIO * growth_mm


def smallest_diameters_mm(vectors: Tensor) -> Tensor:
    """Compute `estimator.eye.assembly.smallest_diameter_mm` for a batch."""
    relaxed_mm, volume_mm3 = vectors[..., DIAMETER], vectors[..., VOLUME]
    room_mm = torch.clamp(vectors[..., AQUEOUS] - SMALLEST_AQUEOUS_MM, min=0.0)
    c_mm3 = 8.0 / math.pi * CAP_VOLUME_RATIO * ANTERIOR_THICKNESS_RATIO * volume_mm3
    fitting_mm = (relaxed_mm**-2 + room_mm / c_mm3) ** -0.5
    return torch.maximum(fitting_mm, SMALLEST_DIAMETER_RATIO * relaxed_mm)
