"""Rays through the cornea and through the lens of every eye.

Rays are (B, 3, R): position (mm) and direction cosines, in the axes of a surface. A ray
that fails becomes nan and stays so; no exception is raised.

Optical paths of a bundle relative to its chief ray, without cancellation.

An eye is 32 mm of optical path, of which float32 keeps 0.002 um. So every leg is
computed as a difference from the chief ray's leg: with e the difference of the two legs
as vectors, |v| - |c| = e.(v + c) / (|v| + |c|), where nothing large cancels.

Points are x, y in the axes of each surface. By Fermat's principle the path does not
change, to first order, when a point slides along its surface: an error of the points
enters squared, and points without gradient still give the exact gradient.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from training.tracer import eye as eyes
from training.tracer.eye import Eye, Shape

NEWTON_STEPS = 5
"""Steps from the intersection with the conic; they exhaust float64."""

_SMALLEST_RADICAND = 1e-12


def _powers(x: Tensor) -> Tensor:
    x2 = x * x
    x3 = x2 * x
    return torch.stack([torch.ones_like(x), x, x2, x3, x2 * x2, x2 * x3, x3 * x3], 1)


def sag(shape: Shape, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return height z (B, R) mm at x, y (B, R), its slopes, and the conic's radicand.

    Where the radicand is not positive there is no surface, and z has no meaning.
    """
    cx, cy, k1 = shape.curvature_x, shape.curvature_y, 1.0 + shape.conic
    px, py = cx * x, cy * y
    radicand = 1.0 - k1 * (px * px + py * py)
    root = radicand.clamp(min=_SMALLEST_RADICAND).sqrt()
    below = 1.0 / (1.0 + root)
    top = px * x + py * y
    common = top * k1 * below * below / root
    z = top * below
    zx = px * (2.0 * below + common * cx)
    zy = py * (2.0 * below + common * cy)
    if shape.offset is not None:
        by_y = torch.bmm(shape.offset, _powers(x)).unflatten(1, (2, -1))
        total, up, slope = by_y[:, :, -1], y[:, None], None
        for power in range(by_y.shape[2] - 2, -1, -1):
            so_far = total[:, 0]
            slope = so_far if slope is None else torch.addcmul(so_far, slope, y)
            total = torch.addcmul(by_y[:, :, power], total, up)
        z, zx, zy = z + total[:, 0], zx + total[:, 1], zy + slope
    return z, zx, zy, radicand


def _to_vertex_plane(point: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    t = -point[:, 2] / direction[:, 2]
    return torch.addcmul(point, t[:, None], direction), t


def _conic_distance(c: Tensor, k: Tensor, point: Tensor, direction: Tensor) -> Tensor:
    """Return the distance (B, R) from the vertex plane to a conic of revolution.

    To its vertex sheet; nan where there is none. ``c``, ``k`` (B, 1). From farther away
    the same formula would cancel to 1e-4 mm in float32.
    """
    x, y, _ = point.unbind(1)
    dx, dy, dz = direction.unbind(1)
    a = c * (1.0 + k * dz * dz)
    b = c * (x * dx + y * dy) - dz
    d = c * (x * x + y * y)
    return d / ((b * b - a * d).sqrt() - b)


def _newton(shape: Shape, point: Tensor, direction: Tensor, t: Tensor) -> Tensor:
    here = torch.addcmul(point, t[:, None], direction)
    z, zx, zy, _ = sag(shape, here[:, 0], here[:, 1])
    dx, dy, dz = direction.unbind(1)
    return t - (here[:, 2] - z) / (dz - zx * dx - zy * dy)


def _start(shape: Shape, point: Tensor, direction: Tensor) -> Tensor:
    c = 0.5 * (shape.curvature_x + shape.curvature_y)
    point, there = _to_vertex_plane(point, direction)
    t = _conic_distance(c, shape.conic, point, direction)
    return there + torch.where(torch.isnan(t), 0.0, t)


def _bend(direction: Tensor, normal: Tensor, ratio: Tensor) -> Tensor:
    """Apply Snell's law; ``ratio`` (B, 1) is the index before over that behind."""
    inverse = (normal * normal).sum(1).rsqrt()
    cosine = (direction * normal).sum(1) * inverse
    root = (1.0 - ratio * ratio * (1.0 - cosine * cosine)).sqrt()
    push = (root - ratio * cosine) * inverse
    return ratio[:, None] * direction + push[:, None] * normal


def cross_conic(
    shape: Shape, point: Tensor, direction: Tensor, ratio: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Trace rays to a conic of revolution and refract them there.

    If ``ratio`` is None, rays are not refracted. Returns point, direction and distance
    (B, R).
    """
    c, k = shape.curvature_x, shape.conic
    point, there = _to_vertex_plane(point, direction)
    t = _conic_distance(c, k, point, direction)
    point, t = torch.addcmul(point, t[:, None], direction), there + t
    if ratio is None:
        return point, direction, t
    x, y, z = point.unbind(1)
    up = 1.0 - c * (1.0 + k) * z
    normal = torch.stack([-c * x, -c * y, up], 1)
    t = torch.where(up > 0.0, t, torch.nan)
    return point, _bend(direction, normal, ratio), t


def cross_iterated(
    shape: Shape,
    point: Tensor,
    direction: Tensor,
    ratio: Tensor,
    *,
    start: Tensor | None = None,
    steps: int = NEWTON_STEPS,
) -> tuple[Tensor, Tensor, Tensor]:
    """Like `cross_conic`, for a biconic or offset surface, by Newton steps.

    ``start`` (B, R) are initial distances. Only the last step keeps a graph: from a
    converged distance it has the complete derivative.
    """
    with torch.no_grad():
        t = _start(shape, point, direction) if start is None else start
        for _ in range(steps - 1):
            t = _newton(shape, point, direction, t)
    t = _newton(shape, point, direction, t)
    point = torch.addcmul(point, t[:, None], direction)
    _, zx, zy, radicand = sag(shape, point[:, 0], point[:, 1])
    normal = torch.stack([-zx, -zy, torch.ones_like(zx)], 1)
    t = torch.where(radicand > 0.0, t, torch.nan)
    return point, _bend(direction, normal, ratio), t


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
        eye.shapes[0], point, direction, n[0], start=starts[0], steps=steps
    )
    point, direction = eyes.inward(eye.to_posterior, first, direction)
    second, direction, gap = cross_iterated(
        eye.shapes[1], point, direction, n[1], start=starts[1], steps=steps
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
    third, direction, reach = cross_conic(eye.shapes[2], point, direction, n[2])
    point, direction = eyes.inward(eye.to_lens_posterior, third, direction)
    fourth, direction, depth = cross_conic(eye.shapes[3], point, direction, n[3])
    return third, fourth, direction, reach, depth


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


def _from_chief(shape: Shape, points: Tensor, chief: Tensor) -> tuple[Tensor, Tensor]:
    """Return ray points minus the chief's (B, 3, R), and the latter (B, 3, 1)."""
    z = sag(shape, points[:, 0], points[:, 1])[0]
    chief_z = sag(shape, chief[:, 0], chief[:, 1])[0]
    there = torch.cat([chief[:, :2], chief_z[:, None]], 1)
    away = torch.stack(
        [points[:, 0] - chief[:, 0], points[:, 1] - chief[:, 1], z - chief_z], 1
    )
    return away, there


def _longer(away: Tensor, chief_leg: Tensor) -> Tensor:
    """Return the length of ``chief_leg + away`` minus that of ``chief_leg``, (B, R)."""
    leg = chief_leg + away
    lengths = leg.square().sum(1).sqrt() + chief_leg.square().sum(1).sqrt()
    return (away * (leg + chief_leg)).sum(1) / lengths


def extra_path(
    eye: Eye, points: Sequence[Tensor], chief_points: Sequence[Tensor], origin: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the path from ``origin`` to the anterior cornea minus the chief ray's.

    Parameters
    ----------
    points : 4 of (B, 2 or more, R), mm
        x, y on the four surfaces, in their axes.
    chief_points : 4 of (B, 2 or more, 1), mm
    origin : (B, 3, 1), mm
        Retinal point, in the axes of the posterior lens.

    Returns
    -------
    path_mm : (B, R)
        Optical path difference.
    away_mm : (B, 3, R)
        Points on the anterior cornea minus the chief ray's.
    """
    placed = [
        _from_chief(shape, ray, chief)
        for shape, ray, chief in zip(eye.shapes, points, chief_points, strict=False)
    ]
    links = ((eye.to_posterior,), (eye.to_stop, eye.to_lens), (eye.to_lens_posterior,))
    path = 0.0
    for i, link in enumerate(links):
        (away, here), (next_away, there) = placed[i], placed[i + 1]
        for step in link:
            here, away = eyes.inward(step, here, away)
        leg = _longer(next_away - away, there - here)
        path = path + eye.indices[:, i + 1 : i + 2] * leg
    away, here = placed[3]
    path = path + eye.indices[:, 4:5] * _longer(-away, origin - here)
    return path, placed[0][0]


_SMALLEST_SHARE = 1e-3
_ALLOWED_GROWTH = 2.0
"""A step that enlarges the miss by more than this is halved."""


@torch.no_grad()
def broyden(
    miss_of: Callable[[Tensor], Tensor],
    start: Tensor,
    inverse: Tensor,
    *,
    tolerance: Tensor | float,
    n_steps: int,
) -> tuple[Tensor, Tensor]:
    """Solve ``miss_of(unknowns) = 0``.

    Parameters
    ----------
    miss_of : callable
        Maps unknowns (B, 2, R) to misses (B, 2, R); nan where a ray fails.
    start : (B, 2, R)
    inverse : (B, 2, 2)
        Initial inverse of the change of the miss with the unknowns.
    tolerance : scalar or (B, 1) or (R,)
        Length of the miss at which a ray has converged.
    n_steps : int

    Returns
    -------
    unknowns : (B, 2, R)
    miss : (B, R)
        Remaining length; inf where no ray passed.
    """
    unknowns = start
    rows = [inverse[:, i, j, None].expand_as(start[:, 0]) for i, j in _CELLS]
    best = miss_of(start)
    left = _length(best)
    step = _apply(rows, best)
    share = torch.ones_like(left)
    for _ in range(n_steps):
        todo = (left >= tolerance) & (share > _SMALLEST_SHARE)
        if not bool(todo.any()):
            break
        # A converged ray stays, so that the last call evaluates every ray's solution.
        moved = torch.where(todo[:, None], share[:, None] * step, 0.0)
        tried = miss_of(unknowns + moved)
        length = _length(tried)
        taken = todo & (length < _ALLOWED_GROWTH * left)
        change = tried - best
        rows = [
            torch.where(taken, new, old)
            for new, old in zip(_update(rows, moved, change), rows, strict=True)
        ]
        mine = taken[:, None]
        unknowns = torch.where(mine, unknowns + moved, unknowns)
        best, left = torch.where(mine, tried, best), torch.where(taken, length, left)
        step = torch.where(mine, _apply(rows, best), step)
        share = torch.where(taken, 1.0, torch.where(todo, 0.5 * share, share))
    return unknowns, left


_CELLS = ((0, 0), (0, 1), (1, 0), (1, 1))


def _length(miss: Tensor) -> Tensor:
    return torch.hypot(miss[:, 0], miss[:, 1]).nan_to_num(torch.inf)


def _apply(rows: list[Tensor], miss: Tensor) -> Tensor:
    """Return the step (B, 2, R) that would undo a miss."""
    a, b, c, d = rows
    x, y = miss.unbind(1)
    return torch.stack([-(a * x + b * y), -(c * x + d * y)], 1)


def _update(rows: list[Tensor], moved: Tensor, change: Tensor) -> tuple[Tensor, ...]:
    """Sherman-Morrison update: the inverse maps the change to the step."""
    a, b, c, d = rows
    (da, db), (cx, cy) = moved.unbind(1), change.unbind(1)
    va, vb = da * a + db * c, da * b + db * d
    scale = va * cx + vb * cy
    usable = (scale != 0.0) & torch.isfinite(scale)
    ea = torch.where(usable, (da - a * cx - b * cy) / scale, 0.0)
    eb = torch.where(usable, (db - c * cx - d * cy) / scale, 0.0)
    return a + ea * va, b + ea * vb, c + eb * va, d + eb * vb


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
