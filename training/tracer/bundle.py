"""Rays through the cornea and through the lens of every eye, in either direction."""

import torch
from torch import Tensor

from training.tracer import eye as eyes
from training.tracer.eye import Eye
from training.tracer.surfaces import NEWTON_STEPS, cross_conic, cross_iterated

ORDER_TOLERANCE_MM = 1e-6
"""A leg shorter than minus this runs against the light: surfaces cross."""


def ratios(eye: Eye) -> list[Tensor]:
    """Return the indices before over behind each of the four surfaces, (B, 1)."""
    n = eye.indices
    return [n[:, i : i + 1] / n[:, i + 1 : i + 2] for i in range(4)]


def into_cornea(
    eye: Eye,
    point: Tensor,
    direction: Tensor,
    starts: tuple[Tensor | None, Tensor | None] = (None, None),
    steps: int = NEWTON_STEPS,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Trace from the anterior cornea's axes to behind the posterior one, in its axes.

    ``starts`` are initial distances (B, R) of Newton's steps to both surfaces. Returns
    points (B, 3, R) on both surfaces, direction behind and both distances.
    """
    n = ratios(eye)
    first, direction, reach = cross_iterated(
        eye.shapes[0], point, direction, n[0], 1.0, start=starts[0], steps=steps
    )
    point, direction = eyes.inward(eye.to_posterior, first, direction)
    second, direction, gap = cross_iterated(
        eye.shapes[1], point, direction, n[1], 1.0, start=starts[1], steps=steps
    )
    return first, second, direction, reach, gap


def into_lens(
    eye: Eye, point: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Trace from the stop's axes to behind the lens, in its posterior surface's axes.

    Returns points on both surfaces, direction behind and both distances.
    """
    n = ratios(eye)
    point, direction = eyes.inward(eye.to_lens, point, direction)
    third, direction, reach = cross_conic(eye.shapes[2], point, direction, n[2], 1.0)
    point, direction = eyes.inward(eye.to_lens_posterior, third, direction)
    fourth, direction, depth = cross_conic(eye.shapes[3], point, direction, n[3], 1.0)
    return third, fourth, direction, reach, depth


def out_of_lens(
    eye: Eye, point: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Trace from the posterior lens axes out to the stop plane.

    Returns points on the anterior and posterior surface, at the stop, direction there,
    and the distances to all three; the last may be negative.
    """
    n = ratios(eye)
    fourth, direction, rest = cross_conic(
        eye.shapes[3], point, direction, 1.0 / n[3], -1.0
    )
    point, direction = eyes.outward(eye.to_lens_posterior, fourth, direction)
    third, direction, depth = cross_conic(
        eye.shapes[2], point, direction, 1.0 / n[2], -1.0
    )
    point, direction = eyes.outward(eye.to_lens, third, direction)
    stop, reach = to_stop(point, direction)
    return third, fourth, stop, direction, (rest, depth, reach)


def out_of_cornea(
    eye: Eye, point: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Trace from the stop out into the air, in the axes of the anterior cornea.

    Returns points on the anterior and posterior surface, direction, and both distances.
    """
    n = ratios(eye)
    point, direction = eyes.outward(eye.to_stop, point, direction)
    second, direction, gap = cross_iterated(
        eye.shapes[1], point, direction, 1.0 / n[1], -1.0
    )
    point, direction = eyes.outward(eye.to_posterior, second, direction)
    first, direction, thickness = cross_iterated(
        eye.shapes[0], point, direction, 1.0 / n[0], -1.0
    )
    return first, second, direction, (gap, thickness)


def to_stop(point: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Trace rays in the stop's axes to its plane, also backward; point and distance."""
    t = -point[:, 2] / direction[:, 2]
    return torch.addcmul(point, t[:, None], direction), t


def inverse_2x2(matrix: Tensor) -> Tensor:
    """Return the inverse of (..., 2, 2); not finite where it is singular."""
    a, b = matrix[..., 0, 0], matrix[..., 0, 1]
    c, d = matrix[..., 1, 0], matrix[..., 1, 1]
    rows = torch.stack([d, -b, -c, a], -1).unflatten(-1, (2, 2))
    return rows / (a * d - b * c)[..., None, None]


def across(direction: Tensor) -> Tensor:
    """Return two unit vectors (B, 2, 3) perpendicular to a direction (B, 3, 1)."""
    dx, _, dz = direction[..., 0].unbind(-1)
    length, zero = torch.hypot(dx, dz), torch.zeros_like(dx)
    first = torch.stack([dz / length, zero, -dx / length], -1)
    return torch.stack([first, torch.linalg.cross(direction[..., 0], first)], 1)
