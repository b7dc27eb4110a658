"""Known optics as layers before and after a network.

These layers compute in closed form what a network would otherwise have to learn:

- rotating the cornea rotates its offset terms;
- diameter and volume of the lens determine its radii;
- a coefficient of order n is proportional to the n-th power of the pupil;
- rotating the eye about its axis rotates the field.

They are part of the exported graph.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from estimator.eye.parameters import allowed_ranges, mean_vector
from training.eye_features import (
    EyeFeatures,
    PupilPowers,
    ZernikeRotation,
    rotated_pair,
)
from training.eye_prior import mean_eyes
from training.focus_features import FocusFeatures

SMALLEST_SINE = 1e-6
"""Sine of the eccentricity below which the azimuth of the field is set to 0."""


def _size_and_color(pupil_mm: Tensor, wavelength_nm: Tensor) -> list[Tensor]:
    """Return smooth functions of pupil and wavelength."""
    return [pupil_mm, pupil_mm**2, (500.0 / wavelength_nm) ** 2, wavelength_nm / 500.0]


class OnAxisFeatures(nn.Module):
    """Features of the discriminator's inputs (N, 47); coefficients scaled by pupil."""

    n_features = EyeFeatures.N_FEATURES + 4
    n_encoded = 27

    def __init__(self) -> None:
        super().__init__()
        self.eye, self.scale = EyeFeatures(), PupilPowers()

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 53)."""
        one, zero = torch.ones_like(x[:, 0]), torch.zeros_like(x[:, 0])
        eye = self.eye(x[:, :45], x[:, 45], x[:, 46], one, zero, zero)
        more = torch.stack(_size_and_color(x[:, 45], x[:, 46]), dim=1)
        return torch.cat([eye, more], dim=1)

    def decode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Convert scaled coefficients (N, 27) to those of the pupil."""
        return y * self.scale(x[:, 45])

    def encode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Invert `decode`."""
        return y / self.scale(x[:, 45])


class FieldFeatures(nn.Module):
    """Features of the aberration estimator's inputs (N, 49), with the field on +x.

    With u the direction to the source, at an angle alpha about the axis and an
    eccentricity of sine s and cosine c, the pupil's axes ex = u × y, ey = ex × u are at
    the angle beta to those of the rotated eye: tan beta = c tan alpha.
    """

    n_features = EyeFeatures.N_FEATURES + 4 + 3
    n_encoded = 33

    def __init__(self) -> None:
        super().__init__()
        self.eye, self.rotation, self.scale = (
            EyeFeatures(),
            ZernikeRotation(),
            PupilPowers(),
        )

    @staticmethod
    def _field(x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h_rad, v_rad = torch.deg2rad(x[:, 47]), torch.deg2rad(x[:, 48])
        ux, uy = torch.sin(h_rad) * torch.cos(v_rad), torch.sin(v_rad)
        sine = torch.sqrt(ux * ux + uy * uy)
        safe = torch.clamp(sine, min=SMALLEST_SINE)
        cos_alpha = torch.where(sine > SMALLEST_SINE, ux / safe, torch.ones_like(ux))
        sin_alpha = torch.where(sine > SMALLEST_SINE, uy / safe, torch.zeros_like(ux))
        cosine = torch.cos(h_rad) * torch.cos(v_rad)
        return sine, cosine, cos_alpha, sin_alpha

    @staticmethod
    def _beta(
        cosine: Tensor, cos_alpha: Tensor, sin_alpha: Tensor
    ) -> tuple[Tensor, Tensor]:
        length = torch.sqrt(cos_alpha**2 + (cosine * sin_alpha) ** 2)
        return cos_alpha / length, cosine * sin_alpha / length

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 56)."""
        sine, cosine, cos_alpha, sin_alpha = self._field(x)
        more = [*_size_and_color(x[:, 45], x[:, 46]), sine, sine**2, cosine]
        eye = self.eye(
            x[:, :45], x[:, 45], x[:, 46], cos_alpha, sin_alpha, sine / cosine
        )
        return torch.cat([eye, torch.stack(more, dim=1)], dim=1)

    def decode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Convert scaled values in rotated axes (N, 33) to the requested axes."""
        _, cosine, cos_alpha, sin_alpha = self._field(x)
        c, s = self._beta(cosine, cos_alpha, sin_alpha)
        zernike = self.rotation(y[:, :27] * self.scale(x[:, 45]), c, s)
        return torch.cat([zernike, self._rim(y[:, 27:] * x[:, 45:46], c, s)], dim=1)

    def encode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Invert `decode`."""
        _, cosine, cos_alpha, sin_alpha = self._field(x)
        c, s = self._beta(cosine, cos_alpha, sin_alpha)
        zernike = self.rotation(y[:, :27], c, -s) / self.scale(x[:, 45])
        return torch.cat([zernike, self._rim(y[:, 27:], c, -s) / x[:, 45:46]], dim=1)

    @staticmethod
    def _rim(rim: Tensor, c: Tensor, s: Tensor) -> Tensor:
        """Rotate radius, center and symmetric matrix (N, 6)."""
        radius, x, y, xx, xy, yy = rim.unbind(dim=1)
        x, y = rotated_pair(x, y, c, s)
        mean, along, across = 0.5 * (xx + yy), 0.5 * (xx - yy), xy
        along, across = rotated_pair(along, across, c * c - s * s, 2.0 * c * s)
        return torch.stack([radius, x, y, mean + along, across, mean - along], dim=1)


class MeasurementFeatures(nn.Module):
    """Features of the eye estimator's inputs (N, 27): coefficients over pupil powers.

    The network predicts the difference of an eye from the mean eye of its refraction.
    """

    n_features = 25 + 25 + 4
    n_encoded = 45

    def __init__(self) -> None:
        super().__init__()
        self.scale = PupilPowers(first=3)
        for name, bound in zip(("low", "high"), allowed_ranges().T, strict=True):
            bound = torch.from_numpy(bound).float()
            self.register_buffer(name, bound, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 54)."""
        more = torch.stack(_size_and_color(x[:, 25], x[:, 26]), dim=1)
        scaled = x[:, :25] / self.scale(x[:, 25])
        return torch.cat([x[:, :25], scaled, more], dim=1)

    @staticmethod
    def output_ranges() -> NDArray[np.float64]:
        """Return the ranges (45, 2) of differences, symmetric about the mean eye."""
        mean = mean_vector()[:, None]
        half = np.abs(allowed_ranges() - mean).max(axis=1)
        return np.stack([-half, half], axis=1)

    def decode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Convert differences (N, 45) to an eye within its allowed ranges."""
        return torch.minimum(torch.maximum(y + mean_eyes(x), self.low), self.high)

    def encode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Invert `decode` within the ranges."""
        return y - mean_eyes(x)


class RawFeatures(nn.Module):
    """The unchanged inputs, as in the paper."""

    def __init__(self, n_inputs: int, n_outputs: int):
        super().__init__()
        self.n_features, self.n_encoded = n_inputs, n_outputs

    def forward(self, x: Tensor) -> Tensor:
        """Return the inputs."""
        return x

    def decode(self, x: Tensor, y: Tensor, features: Tensor | None = None) -> Tensor:
        """Return the outputs."""
        return y

    encode = decode


PHYSICAL = {
    "discriminator": OnAxisFeatures,
    "eye": MeasurementFeatures,
    "focus": FocusFeatures,
    "aberration": FieldFeatures,
}


def make_features(kind: str, *, task: str, n_inputs: int, n_outputs: int) -> nn.Module:
    """Return the feature layers of a task; ``kind`` is ``raw`` or ``physical``."""
    if kind == "raw":
        return RawFeatures(n_inputs, n_outputs)
    if kind == "physical":
        return PHYSICAL[task]()
    raise ValueError(f"features '{kind}': allowed are raw and physical")
