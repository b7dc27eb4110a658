"""Rays through one surface of every eye: distance, normal, refraction.

Rays are (B, 3, R): position (mm) and direction cosines, in the surface's own axes. A
ray that fails becomes nan and stays so; no exception is raised.
"""

import torch
from torch import Tensor

from training.tracer.eye import Shape

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


def _conic_distance(
    c: Tensor, k: Tensor, point: Tensor, direction: Tensor, sense: float
) -> Tensor:
    """Return the distance (B, R) from the vertex plane to a conic of revolution.

    To its vertex sheet; nan where there is none. ``c``, ``k`` (B, 1); ``sense`` is 1
    for inward rays and -1 for outward ones. From farther away the same formula would
    cancel to 1e-4 mm in float32.
    """
    x, y, _ = point.unbind(1)
    dx, dy, dz = direction.unbind(1)
    a = c * (1.0 + k * dz * dz)
    b = c * (x * dx + y * dy) - dz
    d = c * (x * x + y * y)
    return sense * d / ((b * b - a * d).sqrt() - sense * b)


def _newton(shape: Shape, point: Tensor, direction: Tensor, t: Tensor) -> Tensor:
    here = torch.addcmul(point, t[:, None], direction)
    z, zx, zy, _ = sag(shape, here[:, 0], here[:, 1])
    dx, dy, dz = direction.unbind(1)
    return t - (here[:, 2] - z) / (dz - zx * dx - zy * dy)


def _start(shape: Shape, point: Tensor, direction: Tensor, sense: float) -> Tensor:
    c = 0.5 * (shape.curvature_x + shape.curvature_y)
    point, there = _to_vertex_plane(point, direction)
    t = _conic_distance(c, shape.conic, point, direction, sense)
    return there + torch.where(torch.isnan(t), 0.0, t)


def _bend(direction: Tensor, normal: Tensor, ratio: Tensor, sense: float) -> Tensor:
    """Apply Snell's law; ``ratio`` (B, 1) is the index before over that behind."""
    inverse = (normal * normal).sum(1).rsqrt()
    cosine = (direction * normal).sum(1) * inverse
    root = (1.0 - ratio * ratio * (1.0 - cosine * cosine)).sqrt()
    push = (sense * root - ratio * cosine) * inverse
    return ratio[:, None] * direction + push[:, None] * normal


def cross_conic(
    shape: Shape, point: Tensor, direction: Tensor, ratio: Tensor | None, sense: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Trace rays to a conic of revolution and refract them there.

    If ``ratio`` is None, rays are not refracted. Returns point, direction and distance
    (B, R).
    """
    c, k = shape.curvature_x, shape.conic
    point, there = _to_vertex_plane(point, direction)
    t = _conic_distance(c, k, point, direction, sense)
    point, t = torch.addcmul(point, t[:, None], direction), there + t
    if ratio is None:
        return point, direction, t
    x, y, z = point.unbind(1)
    up = 1.0 - c * (1.0 + k) * z
    normal = torch.stack([-c * x, -c * y, up], 1)
    t = torch.where(up > 0.0, t, torch.nan)
    return point, _bend(direction, normal, ratio, sense), t


def cross_iterated(
    shape: Shape,
    point: Tensor,
    direction: Tensor,
    ratio: Tensor,
    sense: float,
    *,
    start: Tensor | None = None,
    steps: int = NEWTON_STEPS,
) -> tuple[Tensor, Tensor, Tensor]:
    """Like `cross_conic`, for a biconic or offset surface, by Newton steps.

    ``start`` (B, R) are initial distances. Only the last step keeps a graph: from a
    converged distance it has the complete derivative.
    """
    with torch.no_grad():
        t = _start(shape, point, direction, sense) if start is None else start
        for _ in range(steps - 1):
            t = _newton(shape, point, direction, t)
    t = _newton(shape, point, direction, t)
    point = torch.addcmul(point, t[:, None], direction)
    _, zx, zy, radicand = sag(shape, point[:, 0], point[:, 1])
    normal = torch.stack([-zx, -zy, torch.ones_like(zx)], 1)
    t = torch.where(radicand > 0.0, t, torch.nan)
    return point, _bend(direction, normal, ratio, sense), t
