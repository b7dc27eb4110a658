"""Spherical aberration of a centered eye, by a few rays in closed form, as a layer.

Rays from the axial point of the retina are refracted exactly at four conics, in one
meridian. The least-squares vergence over the pupil is an integral of their slopes
outside. Offset terms and tilts are ignored; a network learns their effect.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

NODES = (0.5 - math.sqrt(3.0 / 28.0), 0.5, 0.5 + math.sqrt(3.0 / 28.0))
"""q = r²/R² of the rays in the pupil: Gauss nodes of the weight q (1 - q)."""

MOMENTS = (1.0, 0.5, 0.3)
"""Integrals of 6 q (1 - q) q^k over 0..1."""

NODAL_DISTANCE_MM = 22.3
"""Approximate height in the pupil over slope at the retina."""

LARGEST_EXCESS = 0.015
"""Limit of the excess, 1/mm: above 15 dpt, rays have crossed or missed a surface."""

LEAST_ROOT = 1e-4
"""Lower bound of radicands: a ray that misses a surface becomes tangential to it."""


class Conic(NamedTuple):
    """A surface: vertex (N,) from the corneal one, mm; curvature and conic constant."""

    z_mm: Tensor
    curvature: Tensor
    conic: Tensor


class Rays(NamedTuple):
    """Positions and direction cosines (N, n_rays) in a meridian; light goes to -z."""

    z: Tensor
    r: Tensor
    along: Tensor
    across: Tensor


def _root(square: Tensor) -> Tensor:
    return torch.sqrt(torch.clamp(square, min=LEAST_ROOT))


def _refracted(rays: Rays, surface: Conic, ratio: Tensor) -> Rays:
    """Return rays behind a surface; ``ratio`` (N,) is the index before over behind."""
    vertex_mm, c, conic, ratio = (v[:, None] for v in (*surface, ratio))
    shape, z = 1.0 + conic, rays.z - vertex_mm
    a = c * (rays.across**2 + shape * rays.along**2)
    b = c * (rays.r * rays.across + shape * z * rays.along) - rays.along
    d = c * (rays.r**2 + shape * z**2) - 2.0 * z
    way = -d / (b + _root(b * b - a * d))
    z, r = z + way * rays.along, rays.r + way * rays.across
    normal_z, normal_r = c * shape * z - 1.0, c * r
    length = torch.sqrt(normal_z**2 + normal_r**2)
    normal_z, normal_r = normal_z / length, normal_r / length
    cosine = rays.along * normal_z + rays.across * normal_r
    bend = _root(1.0 - ratio**2 * (1.0 - cosine**2)) - ratio * cosine
    return Rays(
        z + vertex_mm,
        r,
        ratio * rays.along + bend * normal_z,
        ratio * rays.across + bend * normal_r,
    )


def excess_vergence(
    *,
    retina_mm: Tensor,
    surfaces: Sequence[Conic],
    indices: Sequence[Tensor],
    radius_mm: Tensor,
    pupil_z_mm: Tensor,
) -> Tensor:
    """Return the least-squares minus the paraxial vergence over the pupil (N,), 1/mm.

    For slopes s(r) = r g(q) toward the axis, with q = r²/R², the coefficient of Z(2,0)
    is sqrt(3) R times the integral of s (ρ² - ρ⁴) over ρ. The vergence is therefore the
    integral of 6 q (1 - q) g(q) over q. g is the parabola through three rays.

    Parameters
    ----------
    surfaces : of Conic
        In the order in which light from the retina meets them.
    indices : of (N,)
        From the vitreous to air, one more than surfaces.
    radius_mm, pupil_z_mm : (N,)
        Radius and plane of the entrance pupil.
    """
    slopes = [math.sqrt(node) / NODAL_DISTANCE_MM for node in NODES]
    slope = torch.stack([radius_mm * one for one in slopes], dim=1)
    length = torch.sqrt(1.0 + slope**2)
    start_mm = retina_mm[:, None].expand_as(slope)
    rays = Rays(start_mm, torch.zeros_like(slope), -1.0 / length, slope / length)
    for surface, (before, behind) in zip(surfaces, pairwise(indices), strict=True):
        rays = _refracted(rays, surface, before / behind)
    height_mm = rays.r + (pupil_z_mm[:, None] - rays.z) * rays.across / rays.along
    q = ((height_mm / radius_mm[:, None]) ** 2).unbind(dim=1)
    g = (-rays.across / height_mm).unbind(dim=1)
    first_01 = (g[1] - g[0]) / (q[1] - q[0])
    first_12 = (g[2] - g[1]) / (q[2] - q[1])
    second = (first_12 - first_01) / (q[2] - q[0])
    # Newton's form of g: its integral minus its value at the axis
    linear = first_01 * MOMENTS[1]
    excess = linear + second * (MOMENTS[2] - (q[0] + q[1]) * MOMENTS[1])
    return torch.clamp(excess, -LARGEST_EXCESS, LARGEST_EXCESS)
