"""From the 45 parameters to surfaces, as tensors over a batch of eyes.

Rays are in the axes of the current surface, so that coordinates stay small and float32
keeps its digits. The frames, from the air inward: the two surfaces of the cornea, the
stop (axes of the eye, origin at its center), the two surfaces of the lens, the retina
(axes of the eye, origin at its pole).
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from estimator.eye import assembly as rule
from estimator.eye import parameters
from estimator.eye.tracing import MEDIA_INWARDS
from estimator.optics import media
from estimator.optics.surfaces import horner_order, offset_monomials
from estimator.optics.units import NM_PER_UM
from estimator.optics.zernike import DEFAULT_ORDER, EXPONENTS, N_TERMS

CPU_CHUNK, GPU_CHUNK = 512, 8192


_Result = TypeVar("_Result")


def constant(function: Callable[..., _Result]) -> Callable[..., _Result]:
    """Cache a function's result, as tensors that any later graph may hold.

    Tensors created within ``torch.inference_mode`` could not be.
    """
    return cache(torch.inference_mode(False)(function))


def in_chunks(
    work: Callable[..., tuple[Tensor, ...]],
    arguments: tuple[Tensor, ...],
    chunk: int | None,
) -> tuple[Tensor, ...]:
    """Run ``work`` over parts of the first axis and concatenate the results.

    Raises
    ------
    ValueError
        Arguments of different lengths.
    """
    count, device = len(arguments[0]), arguments[0].device
    if any(len(argument) != count for argument in arguments):
        raise ValueError(f"batches of {[len(a) for a in arguments]}: must be equal")
    if chunk is None:
        chunk = CPU_CHUNK if device.type == "cpu" else GPU_CHUNK
    if count <= chunk:
        return work(*arguments)
    parts = [
        work(*(argument[i : i + chunk] for argument in arguments))
        for i in range(0, count, chunk)
    ]
    return tuple(torch.cat(pieces) for pieces in zip(*parts, strict=True))


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


_N_POWERS = DEFAULT_ORDER + 1


class Shape(NamedTuple):
    """One surface of every eye, z(x, y) about its vertex.

    ``curvature_x``, ``curvature_y`` (1/mm) and ``conic`` are (B, 1); ``offset``
    (B, 14, 7) maps the powers of x to z and dz/dx as polynomials in y.
    """

    curvature_x: Tensor
    curvature_y: Tensor
    conic: Tensor
    offset: Tensor | None


class Step(NamedTuple):
    """Step to the next frame: p' = turn p + shift; (B, 3, 3) or None, and (B, 3, 1)."""

    turn: Tensor | None
    shift: Tensor | None


class Eye(NamedTuple):
    """A batch of eyes, each at one wavelength.

    ``shapes`` are the four surfaces and the retina. ``to_cornea`` leads from the eye's
    frame to the anterior cornea's, the others one frame inward each. ``indices`` are
    (B, 5), air first.
    """

    shapes: tuple[Shape, ...]
    to_cornea: Step
    to_posterior: Step
    to_stop: Step
    to_lens: Step
    to_lens_posterior: Step
    to_retina: Step
    indices: Tensor


def mapped(function: Callable[[Tensor], Tensor], tree: Any) -> Any:
    """Apply ``function`` to every tensor of nested tuples."""
    if tree is None or isinstance(tree, Tensor):
        return None if tree is None else function(tree)
    parts = [mapped(function, part) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)


@constant
def _offset_map(device: torch.device) -> Tensor:
    """Return (27, 98): offsets in mm to the flattened ``Shape.offset``."""
    terms = np.eye(N_TERMS)[1:]
    by_monomial = np.zeros((N_TERMS - 1, _N_POWERS, _N_POWERS + 1))
    horner = offset_monomials(terms, offset_radius_mm=parameters.OFFSET_RADIUS_MM)
    for column, (a, b) in enumerate(EXPONENTS[horner_order()].tolist()):
        by_monomial[:, b, a] = horner[:, column]
    power = np.arange(1, _N_POWERS + 1)
    rows = [by_monomial[:, :, :-1], by_monomial[:, :, 1:] * power]
    return torch.from_numpy(np.stack(rows, 1).reshape(N_TERMS - 1, -1)).to(device)


def lens_shape(diameter_mm: Tensor, volume_mm3: Tensor) -> tuple[Tensor, ...]:
    """Return anterior and posterior radii and thickness, mm, by `lens_shape` rule C."""
    cap_mm3 = rule.CAP_VOLUME_RATIO * volume_mm3
    heights_mm = 8.0 * cap_mm3 / (torch.pi * diameter_mm**2)
    posterior_mm = (
        -torch.pi * diameter_mm**4 * (1.0 + rule.HEIGHT_RATIO) / (64.0 * cap_mm3)
    )
    thickness_mm = rule.RIM_THICKNESS_MM + heights_mm
    return -posterior_mm / rule.HEIGHT_RATIO, posterior_mm, thickness_mm


def _turn_about_z(angle_deg: Tensor) -> Tensor:
    angle_rad = torch.deg2rad(angle_deg)
    cosine, sine = angle_rad.cos(), angle_rad.sin()
    zero, one = torch.zeros_like(cosine), torch.ones_like(cosine)
    rows = (cosine, -sine, zero, sine, cosine, zero, zero, zero, one)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _lens_turn(about_x_deg: Tensor, about_y_deg: Tensor) -> Tensor:
    x_rad, y_rad = torch.deg2rad(about_x_deg), torch.deg2rad(about_y_deg)
    cx, sx, cy, sy = x_rad.cos(), x_rad.sin(), y_rad.cos(), y_rad.sin()
    rows = (cy, sy * sx, sy * cx, 0.0 * cx, cx, -sx, -sy, cy * sx, cy * cx)
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _shift(*parts: Tensor) -> Tensor:
    return torch.stack(parts, dim=-1)[..., None]


def pack_eyes(vectors: Tensor, wavelength_nm: Tensor) -> Eye:
    """Return surfaces of eyes (B, 45) at wavelengths (B,) nm; float64, differentiable.

    The retina is the sphere of radius eye length / 2; the lens follows rule C.
    """
    vectors = vectors.to(torch.float64)
    given = dict(zip(parameters.PARAMETER_NAMES, vectors.unbind(-1), strict=True))
    zero = torch.zeros_like(vectors[:, 0])
    anterior_mm, posterior_mm, depth_mm = lens_shape(
        given["lens_diameter_mm"], given["lens_volume_mm3"]
    )
    cornea_turn = _turn_about_z(given["cornea_anterior_rotation_deg"])
    posterior_turn = _turn_about_z(given["cornea_posterior_rotation_deg"])
    lens_turn = _lens_turn(
        given["lens_tilt_about_x_deg"], given["lens_tilt_about_y_deg"]
    )
    pole_mm = _shift(
        given["lens_decentration_x_mm"], given["lens_decentration_y_mm"], zero
    )
    # The retina's pole relative to the lens, on the undisplaced axis of the eye.
    behind_stop_mm = (
        given["eye_length_mm"]
        - given["cornea_thickness_mm"]
        - given["aqueous_thickness_mm"]
    )
    depth = _shift(zero, zero, depth_mm)
    rear_mm = pole_mm + lens_turn @ depth
    return Eye(
        shapes=_shapes(given, vectors, anterior_mm, posterior_mm),
        to_cornea=Step(cornea_turn.mT, None),
        to_posterior=Step(
            posterior_turn.mT @ cornea_turn,
            -_shift(zero, zero, given["cornea_thickness_mm"]),
        ),
        to_stop=Step(
            posterior_turn, -_shift(zero, zero, given["aqueous_thickness_mm"])
        ),
        to_lens=Step(lens_turn.mT, -lens_turn.mT @ pole_mm),
        to_lens_posterior=Step(None, -depth),
        to_retina=Step(lens_turn, rear_mm - _shift(zero, zero, behind_stop_mm)),
        indices=refractive_indices(wavelength_nm),
    )


def _shapes(
    given: dict[str, Tensor],
    vectors: Tensor,
    lens_anterior_mm: Tensor,
    lens_posterior_mm: Tensor,
) -> tuple[Shape, ...]:
    def shape(
        radius_x_mm: Tensor,
        radius_y_mm: Tensor,
        conic: Tensor,
        offset: Tensor | None = None,
    ) -> Shape:
        columns = (1.0 / radius_x_mm, 1.0 / radius_y_mm, conic)
        return Shape(
            *cast(tuple[Tensor, Tensor, Tensor], (c[:, None] for c in columns)), offset
        )

    front_mm = given["cornea_anterior_radius_mm"]
    back_mm = front_mm * given["cornea_posterior_radius_ratio"]
    across_mm = back_mm * given["cornea_posterior_astigmatism_ratio"]
    retina_mm = -given["eye_length_mm"] / 2.0
    offsets_mm = vectors[:, parameters.OFFSET_SLICE]
    offset = offsets_mm @ _offset_map(vectors.device)
    return (
        shape(
            front_mm,
            front_mm,
            given["cornea_anterior_conic_constant"],
            offset.unflatten(-1, (2 * _N_POWERS, _N_POWERS)),
        ),
        shape(back_mm, across_mm, given["cornea_posterior_conic_constant"]),
        shape(
            lens_anterior_mm, lens_anterior_mm, given["lens_anterior_conic_constant"]
        ),
        shape(
            lens_posterior_mm, lens_posterior_mm, given["lens_posterior_conic_constant"]
        ),
        shape(retina_mm, retina_mm, torch.zeros_like(retina_mm)),
    )


def turned(turn: Tensor, vector: Tensor) -> Tensor:
    """Multiply (B, 3, 3) by (B, 3, R); faster than small matrix products."""
    x, y, z = vector.split(1, dim=1)
    first = turn[:, :, :1] * x
    return torch.addcmul(torch.addcmul(first, turn[:, :, 1:2], y), turn[:, :, 2:], z)


def inward(step: Step, *vectors: Tensor) -> tuple[Tensor, ...]:
    """Transform a point, and then directions, (B, 3, R) into the next frame."""
    point, *directions = vectors
    if step.turn is not None:
        point = turned(step.turn, point)
        directions = [turned(step.turn, d) for d in directions]
    if step.shift is not None:
        point = point + step.shift
    return point, *directions
