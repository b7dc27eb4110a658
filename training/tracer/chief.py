"""The chief ray: through the center of the stop, one per eye and field; float64.

There are few chief rays but every result depends on them, so they are traced in float64
whatever the precision of the bundle.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from training.tracer import eye as eyes
from training.tracer.eye import Eye
from training.tracer.rays import (
    ORDER_TOLERANCE_MM,
    cross_conic,
    into_cornea,
    into_lens,
    inverse_2x2,
    to_stop,
)

_START_MM = 30.0
_DIFFERENCE_MM = 1e-6
_STEPS = 25
_TOLERANCE_MM = 1e-12
_ACCEPTED_MM = 1e-9


class Axes(NamedTuple):
    """Axes of the pupil plane and the direction to the source, (B, 3, 1) each."""

    x: Tensor
    y: Tensor
    source: Tensor


class Solved(NamedTuple):
    """Intersection of the chief ray with the plane through the entrance pupil.

    ``start`` (B, 2, 1) mm, ``inverse`` (B, 2, 2) of the change at the stop with it,
    ``base_z`` (B, 1) mm of the plane's point on the axis, ``ok`` (B,).
    """

    start: Tensor
    inverse: Tensor
    base_z: Tensor
    ok: Tensor


class Chief(NamedTuple):
    """The chief ray of every eye; (B, 3, 1) in the axes of the respective surface.

    ``points`` are on the four surfaces, ``origin`` on the retina and ``direction``,
    inward, in the axes of the posterior lens. ``ok`` (B,) says where it passed.
    """

    points: tuple[Tensor, ...]
    origin: Tensor
    direction: Tensor
    ok: Tensor


def field_axes(h_deg: Tensor, v_deg: Tensor) -> Axes:
    """Return pupil axes at fields (B,) in degrees."""
    h, v = torch.deg2rad(h_deg), torch.deg2rad(v_deg)
    u = torch.stack([h.sin() * v.cos(), v.sin(), -h.cos() * v.cos()], dim=-1)
    length, zero = torch.hypot(u[:, 0], u[:, 2]), torch.zeros_like(h)
    x = torch.stack([-u[:, 2] / length, zero, u[:, 0] / length], dim=-1)
    y = torch.linalg.cross(x, u)
    return Axes(x[..., None], y[..., None], u[..., None])


def _entrance_pupil_z(eye: Eye) -> Tensor:
    """Return the paraxial image of the stop in air, (B, 1) mm; where aiming starts."""
    n = eye.indices
    assert eye.to_posterior.shift is not None
    assert eye.to_stop.shift is not None
    gaps = (-eye.to_posterior.shift[:, 2], -eye.to_stop.shift[:, 2])
    z, height, slope = gaps[0] + gaps[1], torch.zeros_like(gaps[0]), 1.0 / n[:, 2:3]
    for i in (1, 0):
        height, z = height - slope * gaps[i], z - gaps[i]
        shape = eye.shapes[i]
        curvature = 0.5 * (shape.curvature_x + shape.curvature_y)
        power = (n[:, i + 1 : i + 2] - n[:, i : i + 1]) * curvature
        slope = (n[:, i + 1 : i + 2] * slope + power * height) / n[:, i : i + 1]
    return z - height / slope


def _shoot(
    eye: Eye, axes: Axes, base_z: Tensor, start: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Trace parallel rays at ``start`` (B, 2, R) of the pupil plane to the stop.

    Returns points on both corneal surfaces, at the stop, the direction there, and the
    distances from the posterior cornea's neighbors to it, (B, R).
    """
    point = start[:, :1] * axes.x + start[:, 1:] * axes.y + _START_MM * axes.source
    point = torch.cat([point[:, :2], point[:, 2:] + base_z[:, None]], 1)
    direction = (-axes.source).expand_as(point)
    point, direction = eyes.inward(eye.to_cornea, point, direction)
    first, second, direction, reach, gap = into_cornea(eye, point, direction)
    point, direction = eyes.inward(eye.to_stop, second, direction)
    stop, depth = to_stop(point, direction)
    failed = torch.isnan(reach + gap)[:, None]
    return (
        first,
        second,
        torch.where(failed, torch.nan, stop),
        direction,
        (gap, depth),
    )


@torch.no_grad()
def solve_chief(eye: Eye, axes: Axes) -> Solved:
    """Aim at the center of the stop by Newton's method, with halved steps."""
    base_z, h = _entrance_pupil_z(eye), _DIFFERENCE_MM
    around = base_z.new_tensor([[0.0, h, 0.0], [0.0, 0.0, h]])
    best = base_z.new_zeros(len(base_z), 2, 1)
    miss = torch.full_like(base_z[:, 0], torch.inf)
    step, inverse = torch.zeros_like(best), torch.full_like(best @ best.mT, torch.nan)
    for _ in range(_STEPS):
        tried = best + step
        stop = _shoot(eye, axes, base_z, tried + around)[2][:, :2]
        found = torch.hypot(stop[:, 0, 0], stop[:, 1, 0])
        better = found < miss  # False where a ray failed
        mine = better[:, None, None]
        best, miss = torch.where(mine, tried, best), torch.where(better, found, miss)
        response = inverse_2x2((stop[..., 1:] - stop[..., :1]) / h)
        inverse = torch.where(mine, response, inverse)
        step = torch.where(mine, -response @ stop[..., :1], 0.5 * step)
        if not bool(((miss > _TOLERANCE_MM) & (step.abs().amax((1, 2)) > 0.0)).any()):
            break
    return Solved(best, inverse, base_z, miss < _ACCEPTED_MM)


def _attached(eye: Eye, axes: Axes, solved: Solved) -> Tensor:
    """Return the solution with its gradient: one Newton step from the solution."""
    if not torch.is_grad_enabled():
        return solved.start
    stop = _shoot(eye, axes, solved.base_z, solved.start)[2]
    return solved.start - solved.inverse @ stop[:, :2]


def trace_chief(eye: Eye, axes: Axes, solved: Solved) -> Chief:
    """Trace the solved ray to the retina; differentiable in the eye."""
    start = _attached(eye, axes, solved)
    first, second, stop, direction, (gap, deep) = _shoot(
        eye, axes, solved.base_z, start
    )
    third, fourth, direction, reach, depth = into_lens(eye, stop, direction)
    point, onwards = eyes.inward(eye.to_retina, fourth, direction)
    _, _, rest = cross_conic(eye.shapes[4], point, onwards, None)
    origin = fourth + rest[:, None] * direction
    legs = torch.stack([gap, deep + reach, depth, rest])
    ok = solved.ok & (legs >= -ORDER_TOLERANCE_MM).all(0)[:, 0]
    return Chief((first, second, third, fourth), origin, direction, ok)
