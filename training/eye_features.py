"""Optical features of an eye: closed-form functions of the 45 parameters, as layers.

They are rotated and shifted offset terms, curvatures and paraxial vergences.
"""

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor, nn

from estimator.eye.assembly import (
    CAP_VOLUME_RATIO,
    HEIGHT_RATIO,
    RIM_THICKNESS_MM,
)
from estimator.eye.parameters import OFFSET_RADIUS_MM, OFFSET_SLICE, column
from estimator.optics.media import refractive_index
from estimator.optics.surfaces import horner_order, offset_monomials
from estimator.optics.zernike import (
    DEFAULT_ORDER,
    EXPONENTS,
    N_TERMS,
    index_from_nm,
    inverse_monomial_matrix,
    nm_from_index,
)
from training.meridional import Conic, excess_vergence

PUPIL_MM = 6.0
"""Pupil diameter to which coefficients are scaled; any constant would do."""

ENTRANCE_PUPIL_RATIO = 0.86
"""Approximate depth of the entrance pupil over that of the stop."""

DEFOCUS = index_from_nm(2, 0) - 1
"""Index of C(2,0) in terms from j = 1 on."""

INDEX_RANGE_NM = (450.0, 900.0)


def _orders(first: int = 1) -> list[tuple[int, int]]:
    return [nm_from_index(j) for j in range(first, N_TERMS)]


class ZernikeRotation(nn.Module):
    """Rotate Zernike coefficients j = 1 to 27 about the axis.

    A rotation by phi mixes the terms (n, m) and (n, -m) by cos and sin of m phi. Both
    have the same norm, so this is valid for normalized and unnormalized polynomials.
    """

    def __init__(self) -> None:
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
        """Rotate terms (N, 27) by the angle whose cosine and sine (N,) are given."""
        cosines, sines = [torch.ones_like(cosine)], [torch.zeros_like(sine)]
        for _ in range(6):
            c, s = cosines[-1], sines[-1]
            cosines.append(c * cosine - s * sine)
            sines.append(s * cosine + c * sine)
        c = torch.stack(cosines, dim=1)[:, self.order_m]
        s = torch.stack(sines, dim=1)[:, self.order_m]
        return terms * c + terms[:, self.partner] * (self.sign * s)


def rotated_pair(
    x: Tensor, y: Tensor, cosine: Tensor, sine: Tensor
) -> tuple[Tensor, Tensor]:
    """Rotate vectors (N,), (N,) by the angle whose cosine and sine are given."""
    return x * cosine - y * sine, x * sine + y * cosine


class Shift(nn.Module):
    """Corneal offset terms on the footprint of the light of a field.

    At the point (x + a u, b v) of the disc of the offset terms, their sum is again a
    polynomial of degree 6 in (u, v) of the pupil, with coefficients (N, 27).
    """

    DEGREE = DEFAULT_ORDER

    def __init__(self) -> None:
        super().__init__()
        n, n_terms = self.DEGREE + 1, len(EXPONENTS)
        powers_of = torch.as_tensor(EXPONENTS)
        place = torch.zeros(n_terms, n * n, dtype=torch.float64)
        place[torch.arange(n_terms), powers_of[:, 0] * n + powers_of[:, 1]] = 1.0
        offsets = [
            offset_monomials(row, offset_radius_mm=1.0) for row in np.eye(N_TERMS)
        ]
        order = np.argsort(horner_order())
        to_monomials = torch.as_tensor(np.array(offsets)[1:, order])
        to_zernike = torch.tensor(inverse_monomial_matrix())[:, 1:]
        k, p = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
        binomials = torch.tensor(
            [[float(math.comb(j, i)) for j in range(n)] for i in range(n)]
        )
        for name, values in (
            ("to_grid", (to_monomials @ place).float()),
            ("from_grid", (place.T @ to_zernike).float()),
            ("binomials", binomials),
            ("gap", torch.clamp(p - k, min=0)),
        ):
            self.register_buffer(name, values, persistent=False)

    def forward(self, offsets: Tensor, x: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Map unnormalized terms (N, 27) to normalized; ``x``, ``a``, ``b`` (N,)."""
        n = self.DEGREE + 1
        grid = (offsets @ self.to_grid).reshape(-1, n, n)
        moved = self.binomials * _powers(x)[:, self.gap] * _powers(a)[:, :, None]
        grid = torch.bmm(moved, grid) * _powers(b)[:, None, :]
        return grid.reshape(-1, n * n) @ self.from_grid


def _powers(x: Tensor) -> Tensor:
    """Return the powers 0 to 6 (N, 7)."""
    powers = [torch.ones_like(x)]
    for _ in range(DEFAULT_ORDER):
        powers.append(powers[-1] * x)
    return torch.stack(powers, dim=1)


class EyeFeatures(nn.Module):
    """Optical features (N, 49) of eyes, in axes rotated by minus a given angle.

    Features are curvatures, thicknesses, fourth-order terms of the conics, posterior
    astigmatism, lens position, paraxial vergence of light from the retina (mean, along,
    across), and offset terms on the footprint of the pupil.
    """

    N_FEATURES = 8 + 11 + 3 + 27

    def __init__(self) -> None:
        super().__init__()
        self.rotation, self.shift, self.scale = (
            ZernikeRotation(),
            Shift(),
            PupilPowers(),
        )

    def forward(
        self,
        eye: Tensor,
        pupil_mm: Tensor,
        wavelength_nm: Tensor,
        cosine: Tensor,
        sine: Tensor,
        tangent: Tensor,
    ) -> Tensor:
        """Return features of eyes (N, 45).

        ``cosine``, ``sine`` (N,) are those of the angle of the new x axis; ``tangent``
        (N,) that of the field's eccentricity, toward the new x axis.
        """
        cornea, lens = _cornea(eye, cosine, sine), _lens(eye, cosine, sine)
        offsets = self.rotation(
            eye[:, OFFSET_SLICE], *_offset_rotation(eye, cosine, sine)
        )
        vergence = _vergence(cornea, lens, _apex(offsets), _indices(wavelength_nm))
        x, a = _footprint(cornea, lens, tangent)
        half = 0.5 * pupil_mm / OFFSET_RADIUS_MM
        met = self.shift(offsets, x / OFFSET_RADIUS_MM, half * a, half)
        columns = torch.stack([*cornea.values(), *lens.values(), *vergence], dim=1)
        return torch.cat([columns, met / self.scale(pupil_mm)], dim=1)

    def vergence_of(
        self, eye: Tensor, pupil_mm: Tensor, wavelength_nm: Tensor
    ) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
        """Return functions for the vergence, 1/mm, of eyes with other lenses.

        Both return the mean vergence (N,), outside the eye, of light from the retina.
        The first is paraxial. The second is the least-squares excess over the pupil: of
        the offset terms, to first order, and of the spherical aberration of the
        centered eye.
        """
        one, zero = torch.ones_like(wavelength_nm), torch.zeros_like(wavelength_nm)
        cornea, indices = _cornea(eye, one, zero), _indices(wavelength_nm)
        offsets = self.rotation(eye[:, OFFSET_SLICE], *_offset_rotation(eye, one, zero))
        apex, radius_mm = _apex(offsets), 0.5 * pupil_mm
        half = radius_mm / OFFSET_RADIUS_MM
        defocus_mm = self.shift(offsets, zero, half, half)[:, DEFOCUS]
        over_pupil = 4.0 * math.sqrt(3.0) * defocus_mm / radius_mm**2
        of_offsets = (indices[0] - 1.0) * (over_pupil - apex[0])

        def paraxial(other: Tensor) -> Tensor:
            return _vergence(cornea, _lens(other, one, zero), apex, indices)[0]

        def excess(other: Tensor) -> Tensor:
            lens = _lens(other, one, zero)
            return of_offsets + excess_vergence(
                retina_mm=cornea["length"],
                surfaces=_centered(other, cornea, lens, apex[0]),
                indices=(*indices[::-1], one),
                radius_mm=radius_mm,
                pupil_z_mm=_pupil_depth_mm(cornea, lens),
            )

        return paraxial, excess


def named(eye: Tensor, name: str) -> Tensor:
    """Return one parameter (N,) of eyes (N, 45 or more)."""
    return eye[:, column(name)]


def _offset_rotation(
    eye: Tensor, cosine: Tensor, sine: Tensor
) -> tuple[Tensor, Tensor]:
    angle_rad = torch.deg2rad(named(eye, "cornea_anterior_rotation_deg"))
    c, s = torch.cos(angle_rad), torch.sin(angle_rad)
    return c * cosine + s * sine, s * cosine - c * sine


def _cornea(eye: Tensor, cosine: Tensor, sine: Tensor) -> dict[str, Tensor]:
    front = 1.0 / named(eye, "cornea_anterior_radius_mm")
    back_x = front / named(eye, "cornea_posterior_radius_ratio")
    back_y = back_x / named(eye, "cornea_posterior_astigmatism_ratio")
    back, half = 0.5 * (back_x + back_y), 0.5 * (back_x - back_y)
    angle_rad = 2.0 * torch.deg2rad(named(eye, "cornea_posterior_rotation_deg"))
    oblique = half * torch.cos(angle_rad), half * torch.sin(angle_rad)
    twice_c, twice_s = cosine * cosine - sine * sine, 2.0 * cosine * sine
    along, across = rotated_pair(*oblique, twice_c, -twice_s)
    return {
        "length": named(eye, "eye_length_mm"),
        "thickness": named(eye, "cornea_thickness_mm"),
        "front": front,
        "back": back,
        "along": along,
        "across": across,
        "front_conic": named(eye, "cornea_anterior_conic_constant") * front**3,
        "back_conic": named(eye, "cornea_posterior_conic_constant") * back**3,
    }


def _lens(eye: Tensor, cosine: Tensor, sine: Tensor) -> dict[str, Tensor]:
    diameter_mm = named(eye, "lens_diameter_mm")
    thickness_mm = lens_thickness_mm(diameter_mm, named(eye, "lens_volume_mm3"))
    caps_mm3 = CAP_VOLUME_RATIO * named(eye, "lens_volume_mm3")
    rear = 64.0 * caps_mm3 / (math.pi * diameter_mm**4 * (1.0 + HEIGHT_RATIO))
    front = rear * HEIGHT_RATIO
    aqueous_mm = named(eye, "aqueous_thickness_mm")
    before_mm = named(eye, "cornea_thickness_mm") + aqueous_mm + thickness_mm
    about_x = torch.deg2rad(named(eye, "lens_tilt_about_x_deg"))
    about_y = torch.deg2rad(named(eye, "lens_tilt_about_y_deg"))
    shift = (named(eye, "lens_decentration_x_mm"), named(eye, "lens_decentration_y_mm"))
    # of the lens axis; degrees do not rotate as a vector does
    lean = (torch.sin(about_y) * torch.cos(about_x), -torch.sin(about_x))
    x, y = rotated_pair(*shift, cosine, -sine)
    lean_x, lean_y = rotated_pair(*lean, cosine, -sine)
    return {
        "aqueous": aqueous_mm,
        "thickness": thickness_mm,
        "vitreous": named(eye, "eye_length_mm") - before_mm,
        "front": front,
        "rear": rear,
        "front_conic": named(eye, "lens_anterior_conic_constant") * front**3,
        "rear_conic": named(eye, "lens_posterior_conic_constant") * rear**3,
        "x": x,
        "y": y,
        "lean_x": lean_x,
        "lean_y": lean_y,
    }


def lens_thickness_mm(diameter_mm: Tensor, volume_mm3: Tensor) -> Tensor:
    """Return the lens thickness (N,), as in `estimator.eye.assembly.lens_shape`."""
    caps_mm3 = CAP_VOLUME_RATIO * volume_mm3
    return RIM_THICKNESS_MM + 8.0 * caps_mm3 / (math.pi * diameter_mm**2)


Tensor3 = tuple[Tensor, Tensor, Tensor]


def _transferred(vergence: Tensor3, reduced_mm: Tensor) -> Tensor3:
    """Return the vergence (mean, along, across) after ``reduced_mm``: V / (1 - d V)."""
    mean, along, across = vergence
    square = along**2 + across**2
    scale = 1.0 / ((1.0 - reduced_mm * mean) ** 2 - reduced_mm**2 * square)
    transferred = mean - reduced_mm * (mean**2 - square)
    return transferred * scale, along * scale, across * scale


def _vergence(
    cornea: dict[str, Tensor],
    lens: dict[str, Tensor],
    apex: Sequence[Tensor],
    indices: Sequence[Tensor],
) -> Tensor3:
    """Return the paraxial vergence, 1/mm, of light from the retina outside the eye."""
    n_cornea, n_aqueous, n_lens, n_vitreous = indices
    zero = torch.zeros_like(n_lens)
    rear = (n_lens - n_vitreous) * lens["rear"] - n_vitreous / lens["vitreous"]
    light = _transferred((rear, zero, zero), lens["thickness"] / n_lens)
    power = (n_lens - n_aqueous) * lens["front"]
    light = _transferred((light[0] + power, *light[1:]), lens["aqueous"] / n_aqueous)
    step = n_aqueous - n_cornea
    back = (cornea["back"], cornea["along"], cornea["across"])
    light = tuple(v + step * c for v, c in zip(light, back, strict=True))
    mean, along, across, height_mm = apex
    light = _transferred(light, (cornea["thickness"] - height_mm) / n_cornea)
    front = (cornea["front"] + mean, along, across)
    return tuple(v + (n_cornea - 1.0) * c for v, c in zip(light, front, strict=True))


def _apex(offsets: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the offsets' apical curvature, 1/mm (mean, along, across); height, mm."""
    matrix = torch.as_tensor(_apex_matrix(), dtype=offsets.dtype)
    return tuple((offsets @ matrix.to(offsets.device)).unbind(dim=1))


@cache
def _apex_matrix() -> np.ndarray:
    """Return the map from offsets (27) to mean curvature, along, across, height."""
    terms = offset_monomials(np.eye(N_TERMS), offset_radius_mm=OFFSET_RADIUS_MM)
    terms = terms[1:, np.argsort(horner_order())]
    place = {tuple(e): t for t, e in enumerate(EXPONENTS.tolist())}
    xx, xy, yy, one = (terms[:, place[e]] for e in ((2, 0), (1, 1), (0, 2), (0, 0)))
    return np.stack([xx + yy, xx - yy, xy, one], axis=1)


def _centered(
    eye: Tensor,
    cornea: dict[str, Tensor],
    lens: dict[str, Tensor],
    offset_curvature: Tensor,
) -> list[Conic]:
    """Return the surfaces without tilts and offsets, from the retina outward."""
    before_mm = cornea["thickness"] + lens["aqueous"]
    surfaces = (
        ("lens_posterior", before_mm + lens["thickness"], -lens["rear"]),
        ("lens_anterior", before_mm, lens["front"]),
        ("cornea_posterior", cornea["thickness"], cornea["back"]),
        ("cornea_anterior", 0.0 * before_mm, cornea["front"] + offset_curvature),
    )
    return [
        Conic(z_mm, curvature, named(eye, f"{name}_conic_constant"))
        for name, z_mm, curvature in surfaces
    ]


def _pupil_depth_mm(cornea: dict[str, Tensor], lens: dict[str, Tensor]) -> Tensor:
    return ENTRANCE_PUPIL_RATIO * (cornea["thickness"] + lens["aqueous"])


def _indices(wavelength_nm: Tensor) -> list[Tensor]:
    """Return indices (N,) of cornea, aqueous, lens and vitreous: a cubic fit."""
    t = (500.0 / wavelength_nm) ** 2
    return [((c[0] * t + c[1]) * t + c[2]) * t + c[3] for c in _index_coefficients()]


@cache
def _index_coefficients() -> list[list[float]]:
    grid_nm = np.linspace(*INDEX_RANGE_NM, 200)
    media = ("cornea", "aqueous", "lens", "vitreous")
    return [
        np.polyfit((500.0 / grid_nm) ** 2, refractive_index(m, grid_nm), 3).tolist()
        for m in media
    ]


def _footprint(
    cornea: dict[str, Tensor], lens: dict[str, Tensor], tangent: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the chief ray's position on the cornea, mm, and the footprint's stretch.

    The chief ray is aimed at the entrance pupil. On an inclined cornea, the footprint
    of the pupil is longer along the field.
    """
    depth_mm = _pupil_depth_mm(cornea, lens)
    x = torch.zeros_like(tangent)
    for _ in range(3):
        x = (depth_mm - 0.5 * x * x * cornea["front"]) * tangent
    sine = x * cornea["front"]
    cosine = torch.sqrt(1.0 - torch.clamp(sine * sine, max=0.99))
    # cos(inclination) / cos(eccentricity - inclination)
    stretch = cosine * torch.sqrt(1.0 + tangent**2) / (cosine + sine * tangent)
    return x, stretch


class PupilPowers(nn.Module):
    """(pupil / 6 mm)^n, (N, 27), for every coefficient."""

    def __init__(self, first: int = 1):
        super().__init__()
        orders = torch.tensor([n for n, _ in _orders(first)])
        self.register_buffer("order_n", orders, persistent=False)

    def forward(self, pupil_mm: Tensor) -> Tensor:
        """Return the powers for pupils (N,)."""
        return _powers(pupil_mm / PUPIL_MM)[:, self.order_n]
