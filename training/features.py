"""What is known of the optics, put before and behind a network.

A plain network must learn from examples that turning the cornea turns its offsets, that
a lens of a diameter and a volume has such radii, that a coefficient of order n grows
with the n-th power of the pupil, and that an eye turned about its axis sees the field
turned.  All four are closed forms.  Layers here apply them, so that the network learns
the rest; they are part of the exported graph.
"""

import math

import numpy as np
import torch
from torch import Tensor, nn

from estimator.eye_parameters import OFFSET_SLICE, column
from estimator.lens_shape import CAP_VOLUME_RATIO, HEIGHT_RATIO, RIM_THICKNESS_MM
from estimator.zernike import N_TERMS, nm_from_index

PUPIL_MM = 6.0
"""Pupil to which coefficients are scaled; any constant would do."""

SMALLEST_SINE = 1e-6
"""Nearer to the axis than this the direction of the field means nothing."""


def _orders(first: int = 1) -> list[tuple[int, int]]:
    return [nm_from_index(j) for j in range(first, N_TERMS)]


class Turn(nn.Module):
    """Turn Zernike coefficients j = 1 to 27 about the axis.

    A term (n, m) at an angle phi mixes with (n, -m) by cos and sin of m phi; both share
    their norm, so the rule is the same for normalised and for plain polynomials.
    """

    def __init__(self):
        super().__init__()
        orders = _orders()
        partner = [orders.index((n, -m)) for n, m in orders]
        self.register_buffer("partner", torch.tensor(partner), persistent=False)
        self.register_buffer(
            "order_m", torch.tensor([abs(m) for _, m in orders]), persistent=False
        )
        # cosine term: c cos - s sin; sine term: s cos + c sin
        signs = [-1.0 if m > 0 else 1.0 if m < 0 else 0.0 for _, m in orders]
        self.register_buffer("sign", torch.tensor(signs), persistent=False)

    def forward(self, terms: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
        """Terms (N, 27) turned by the angle whose cosine and sine (N,) are given."""
        cosines, sines = [torch.ones_like(cosine)], [torch.zeros_like(sine)]
        for _ in range(6):
            c, s = cosines[-1], sines[-1]
            cosines.append(c * cosine - s * sine)
            sines.append(s * cosine + c * sine)
        c = torch.stack(cosines, dim=1)[:, self.order_m]
        s = torch.stack(sines, dim=1)[:, self.order_m]
        return terms * c + terms[:, self.partner] * (self.sign * s)


def _turned_pair(x: Tensor, y: Tensor, cosine: Tensor, sine: Tensor):
    return x * cosine - y * sine, x * sine + y * cosine


class EyeFeatures(nn.Module):
    """The eye as optics sees it, (N, 46), in axes turned by minus a given angle.

    Curvatures, thicknesses, fourth-order terms of the conics, offsets and posterior
    astigmatism turned to the eye's axes, lens position.
    """

    N_FEATURES = 46

    def __init__(self):
        super().__init__()
        self.turn = Turn()

    def forward(self, eye: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
        """Eyes (N, 45); ``cosine``, ``sine`` (N,) of the angle of the new x axis."""

        def of(name: str) -> Tensor:
            return eye[:, column(name)]

        columns = self._cornea(of, cosine, sine) + self._lens(of, cosine, sine)
        anterior_rad = torch.deg2rad(of("cornea_anterior_rotation_deg"))
        c, s = torch.cos(anterior_rad), torch.sin(anterior_rad)
        c, s = c * cosine + s * sine, s * cosine - c * sine
        offsets = self.turn(eye[:, OFFSET_SLICE], c, s)
        return torch.cat([torch.stack(columns, dim=1), offsets], dim=1)

    @staticmethod
    def _cornea(of, cosine: Tensor, sine: Tensor) -> list[Tensor]:
        front = 1.0 / of("cornea_anterior_radius_mm")
        back_x = front / of("cornea_posterior_radius_ratio")
        back_y = back_x / of("cornea_posterior_astigmatism_ratio")
        back, half = 0.5 * (back_x + back_y), 0.5 * (back_x - back_y)
        angle_rad = 2.0 * torch.deg2rad(of("cornea_posterior_rotation_deg"))
        oblique = half * torch.cos(angle_rad), half * torch.sin(angle_rad)
        twice_c, twice_s = cosine * cosine - sine * sine, 2.0 * cosine * sine
        along, across = _turned_pair(*oblique, twice_c, -twice_s)
        return [
            of("eye_length_mm"),
            of("cornea_thickness_mm"),
            front,
            back,
            along,
            across,
            of("cornea_anterior_conic_constant") * front**3,
            of("cornea_posterior_conic_constant") * back**3,
        ]

    @staticmethod
    def _lens(of, cosine: Tensor, sine: Tensor) -> list[Tensor]:
        diameter_mm = of("lens_diameter_mm")
        caps_mm3 = CAP_VOLUME_RATIO * of("lens_volume_mm3")
        thickness_mm = RIM_THICKNESS_MM + 8.0 * caps_mm3 / (math.pi * diameter_mm**2)
        rear = 64.0 * caps_mm3 / (math.pi * diameter_mm**4 * (1.0 + HEIGHT_RATIO))
        front = rear * HEIGHT_RATIO
        aqueous_mm = of("aqueous_thickness_mm")
        vitreous_mm = (
            of("eye_length_mm") - of("cornea_thickness_mm") - aqueous_mm - thickness_mm
        )
        shift = (of("lens_decentration_x_mm"), of("lens_decentration_y_mm"))
        about_x = torch.deg2rad(of("lens_tilt_about_x_deg"))
        about_y = torch.deg2rad(of("lens_tilt_about_y_deg"))
        # of the lens' axis; degrees do not turn as a vector does
        lean = (torch.sin(about_y) * torch.cos(about_x), -torch.sin(about_x))
        return [
            aqueous_mm,
            thickness_mm,
            vitreous_mm,
            front,
            rear,
            of("lens_anterior_conic_constant") * front**3,
            of("lens_posterior_conic_constant") * rear**3,
            *_turned_pair(*shift, cosine, -sine),
            *_turned_pair(*lean, cosine, -sine),
        ]


def _size_and_color(pupil_mm: Tensor, wavelength_nm: Tensor) -> list[Tensor]:
    """Smooth functions of pupil and wavelength."""
    return [pupil_mm, pupil_mm**2, (500.0 / wavelength_nm) ** 2, wavelength_nm / 500.0]


class OnAxisFeatures(nn.Module):
    """Inputs (N, 47) of the discriminator to features; coefficients by pupil."""

    n_features = EyeFeatures.N_FEATURES + 4

    def __init__(self):
        super().__init__()
        self.eye = EyeFeatures()
        self.scale = PupilPowers()

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 50)."""
        one, zero = torch.ones_like(x[:, 0]), torch.zeros_like(x[:, 0])
        more = torch.stack(_size_and_color(x[:, 45], x[:, 46]), dim=1)
        return torch.cat([self.eye(x[:, :45], one, zero), more], dim=1)

    def decode(self, x: Tensor, y: Tensor) -> Tensor:
        """From scaled coefficients (N, 27) to those of the pupil."""
        return y * self.scale(x[:, 45])

    def encode(self, x: Tensor, y: Tensor) -> Tensor:
        """Undo `decode`."""
        return y / self.scale(x[:, 45])


class PupilPowers(nn.Module):
    """(pupil / 6 mm)^n, (N, 27), for every coefficient."""

    def __init__(self, first: int = 1):
        super().__init__()
        orders = torch.tensor([n for n, _ in _orders(first)])
        self.register_buffer("order_n", orders, persistent=False)

    def forward(self, pupil_mm: Tensor) -> Tensor:
        """Powers for pupils (N,)."""
        ratio = pupil_mm / PUPIL_MM
        powers = [torch.ones_like(ratio)]
        for _ in range(6):
            powers.append(powers[-1] * ratio)
        return torch.stack(powers, dim=1)[:, self.order_n]


class FieldFeatures(nn.Module):
    """Inputs (N, 49) of the aberration estimator; the field is turned onto +x.

    With u the direction to the source, at an angle alpha about the axis and an
    eccentricity of sine s and cosine c, the pupil's axes ex = u × y, ey = ex × u stand
    at the angle beta to those of the turned eye: tan beta = c tan alpha.
    """

    n_features = EyeFeatures.N_FEATURES + 4 + 3

    def __init__(self):
        super().__init__()
        self.eye = EyeFeatures()
        self.turn = Turn()
        self.scale = PupilPowers()

    @staticmethod
    def _field(x: Tensor):
        h_rad, v_rad = torch.deg2rad(x[:, 47]), torch.deg2rad(x[:, 48])
        ux, uy = torch.sin(h_rad) * torch.cos(v_rad), torch.sin(v_rad)
        sine = torch.sqrt(ux * ux + uy * uy)
        safe = torch.clamp(sine, min=SMALLEST_SINE)
        cos_alpha = torch.where(sine > SMALLEST_SINE, ux / safe, torch.ones_like(ux))
        sin_alpha = torch.where(sine > SMALLEST_SINE, uy / safe, torch.zeros_like(ux))
        cosine = torch.cos(h_rad) * torch.cos(v_rad)
        return sine, cosine, cos_alpha, sin_alpha

    @staticmethod
    def _beta(cosine: Tensor, cos_alpha: Tensor, sin_alpha: Tensor):
        length = torch.sqrt(cos_alpha**2 + (cosine * sin_alpha) ** 2)
        return cos_alpha / length, cosine * sin_alpha / length

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 53)."""
        sine, cosine, cos_alpha, sin_alpha = self._field(x)
        more = [*_size_and_color(x[:, 45], x[:, 46]), sine, sine**2, cosine]
        eye = self.eye(x[:, :45], cos_alpha, sin_alpha)
        return torch.cat([eye, torch.stack(more, dim=1)], dim=1)

    def decode(self, x: Tensor, y: Tensor) -> Tensor:
        """From scaled values in turned axes (N, 33) to those asked for."""
        _, cosine, cos_alpha, sin_alpha = self._field(x)
        c, s = self._beta(cosine, cos_alpha, sin_alpha)
        zernike = self.turn(y[:, :27] * self.scale(x[:, 45]), c, s)
        return torch.cat([zernike, self._rim(y[:, 27:] * x[:, 45:46], c, s)], dim=1)

    def encode(self, x: Tensor, y: Tensor) -> Tensor:
        """Undo `decode`."""
        _, cosine, cos_alpha, sin_alpha = self._field(x)
        c, s = self._beta(cosine, cos_alpha, sin_alpha)
        zernike = self.turn(y[:, :27], c, -s) / self.scale(x[:, 45])
        return torch.cat([zernike, self._rim(y[:, 27:], c, -s) / x[:, 45:46]], dim=1)

    @staticmethod
    def _rim(rim: Tensor, c: Tensor, s: Tensor) -> Tensor:
        """Turn radius, centre and symmetric matrix (N, 6)."""
        radius, x, y, xx, xy, yy = rim.unbind(dim=1)
        x, y = _turned_pair(x, y, c, s)
        mean, along, across = 0.5 * (xx + yy), 0.5 * (xx - yy), xy
        along, across = _turned_pair(along, across, c * c - s * s, 2.0 * c * s)
        return torch.stack([radius, x, y, mean + along, across, mean - along], dim=1)


class FocusFeatures(nn.Module):
    """Inputs (N, 47) of the focused-eye estimator."""

    n_features = EyeFeatures.N_FEATURES + 3

    def __init__(self):
        super().__init__()
        self.eye = EyeFeatures()

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 49)."""
        one, zero = torch.ones_like(x[:, 0]), torch.zeros_like(x[:, 0])
        more = [x[:, 45], x[:, 45] ** 2, x[:, 46]]
        return torch.cat(
            [self.eye(x[:, :45], one, zero), torch.stack(more, dim=1)], dim=1
        )

    def decode(self, x: Tensor, y: Tensor) -> Tensor:
        """Nothing to undo."""
        return y

    encode = decode


class MeasurementFeatures(nn.Module):
    """Inputs (N, 27) of the eye estimator: coefficients over their powers of pupil."""

    n_features = 25 + 25 + 4

    def __init__(self):
        super().__init__()
        self.scale = PupilPowers(first=3)

    def forward(self, x: Tensor) -> Tensor:
        """Return features (N, 54)."""
        more = torch.stack(_size_and_color(x[:, 25], x[:, 26]), dim=1)
        scaled = x[:, :25] / self.scale(x[:, 25])
        return torch.cat([x[:, :25], scaled, more], dim=1)

    def decode(self, x: Tensor, y: Tensor) -> Tensor:
        """Nothing to undo."""
        return y

    encode = decode


class RawFeatures(nn.Module):
    """The inputs as they come, as in the paper."""

    def __init__(self, n_inputs: int):
        super().__init__()
        self.n_features = n_inputs

    def forward(self, x: Tensor) -> Tensor:
        """Return the inputs."""
        return x

    def decode(self, x: Tensor, y: Tensor) -> Tensor:
        """Nothing to undo."""
        return y

    encode = decode


PHYSICAL = {
    "discriminator": OnAxisFeatures,
    "eye": MeasurementFeatures,
    "focus": FocusFeatures,
    "aberration": FieldFeatures,
}


def make_features(kind: str, *, task: str, n_inputs: int) -> nn.Module:
    """Layers of a task; ``kind`` is ``raw`` or ``physical``."""
    if kind == "raw":
        return RawFeatures(n_inputs)
    if kind == "physical":
        return PHYSICAL[task]()
    raise ValueError(f"features '{kind}': allowed are raw and physical")


def moments(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (n,) of columns; 1 where a column is constant."""
    mean = values.mean(axis=0, dtype=np.float64)
    deviation = values.std(axis=0, dtype=np.float64)
    return mean, np.where(deviation > 0.0, deviation, 1.0)
