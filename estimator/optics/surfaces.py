"""Surfaces of an eye, and the packed float64 array that compiled code traces through.

An eye consists of refracting surfaces from the anterior cornea inward, a stop plane, a
retina and the media between them.  Its frame has the origin at the corneal apex, x to
the person's right, y up, z into the eye.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.media import refractive_index
from estimator.optics.zernike import (
    EXPONENTS,
    MAX_RADIAL_ORDER,
    N_TERMS,
    monomial_matrix,
    nm_from_index,
)

OFFSET_RADIUS_MM = 6.2
"""Circle of the corneal offset terms (half of the 12.4 mm of the paper's model)."""

MAX_SURFACES = 20

# --- the packed form: one row per refracting surface, the retina last --------------
CURVATURE_X, CURVATURE_Y, CONIC = 0, 1, 2
VERTEX = 3  # x, y, z of the vertex, mm
ROTATION = 6  # 3 x 3, row-major: surface axes to eye axes
FORM = 15  # 0 conic of revolution, 1 biconic, 2 with offset terms
IS_TURNED = 16  # 1 where ROTATION is not the identity
CLEAR_SQUARED = 17  # square of the clear radius, mm²
OFFSET = 18  # 28 monomial coefficients, mm, in the order of `horner_order`
STOP_Z = 46  # last row only: the stop plane, mm
N_BEFORE_STOP = 47  # last row only: number of surfaces in front of the stop
N_COLUMNS = 48

REVOLVED, BICONIC, WITH_OFFSET = 0, 1, 2

STOP_TOLERANCE_MM = 1e-6
"""A surface whose vertex lies in the stop plane comes after the stop."""


@dataclass(frozen=True)
class Surface:
    """One refracting surface.

    z = (x²/Rx + y²/Ry) / (1 + sqrt(1 - (1+k)(x²/Rx² + y²/Ry²))) + offset, in axes that
    originate at the vertex, rotated by ``rotation_deg`` about the surface's own axis,
    then by ``tilt_deg`` about the eye's x, then y axis (right-handed).

    Attributes
    ----------
    radius_mm : (Rx, Ry)
        Radii, positive where the center of curvature lies toward the retina; may be
        inf.
    conic_constant : float
        k: 0 sphere, -1 paraboloid.
    z_mm : float
        Position of the vertex.
    medium_after : str
        Medium behind the surface.
    rotation_deg, decentration_mm, tilt_deg
        Orientation and position; the vertex is at (decentration_mm, z_mm).
    offset_mm : (28,) or None
        Unnormalized Zernike terms (OSA order) added to the sag, mm.
    offset_radius_mm : float
        Circle of the offset terms.
    clear_radius_mm : float
        Distance from the surface's axis beyond which rays are clipped.
    """

    radius_mm: tuple[float, float]
    conic_constant: float
    z_mm: float
    medium_after: str
    rotation_deg: float = 0.0
    decentration_mm: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    offset_mm: NDArray[np.float64] | None = None
    offset_radius_mm: float = OFFSET_RADIUS_MM
    clear_radius_mm: float = math.inf


@dataclass(frozen=True)
class Retina:
    """The retina: a conic about the eye's axis, concave toward the lens.

    ``radius_mm`` is one radius or (Rx, Ry); its sign is ignored, because no retina
    bulges inward.  ``z_mm`` is the position of its pole.
    """

    radius_mm: float | tuple[float, float]
    conic_constant: float
    z_mm: float


@dataclass(frozen=True)
class EyeSurfaces:
    """An eye ready to trace.

    Attributes
    ----------
    surfaces : tuple of Surface
        In the order light meets them.
    stop_z_mm : float
        Plane of the iris; its opening is a circle about the z axis.
    retina : Retina
    indices : mapping or None
        Constant refractive indices by medium; None uses the dispersion of `media`.
    """

    surfaces: tuple[Surface, ...]
    stop_z_mm: float
    retina: Retina
    indices: Mapping[str, float] | None = field(default=None)


@cache
def horner_order() -> NDArray[np.int64]:
    """Return positions in ``EXPONENTS`` of the monomials in the order of Horner's rule.

    Powers of y fall from 6 to 0, and within each the powers of x.
    """
    position = {tuple(e): t for t, e in enumerate(EXPONENTS.tolist())}
    return np.array(
        [
            position[a, b]
            for b in range(MAX_RADIAL_ORDER, -1, -1)
            for a in range(MAX_RADIAL_ORDER - b, -1, -1)
        ]
    )


@cache
def _unnormalized_monomials() -> NDArray[np.float64]:
    norms = [
        math.sqrt((2 - (m == 0)) * (n + 1))
        for n, m in (nm_from_index(j) for j in range(N_TERMS))
    ]
    matrix: NDArray[np.float64] = monomial_matrix() / np.array(norms)[:, None]
    return matrix


def offset_monomials(
    offset_mm: ArrayLike, *, offset_radius_mm: ArrayLike
) -> NDArray[Any]:
    """Return coefficients (..., 28) of x^a y^b, mm, in Horner's order, of offset terms.

    Parameters
    ----------
    offset_mm : (..., 28), mm
        Unnormalized Zernike terms, index = j.
    offset_radius_mm : (...), mm
    """
    degree: NDArray[np.int64] = EXPONENTS.sum(axis=1)
    radius_mm = np.asarray(offset_radius_mm, dtype=np.float64)[..., None]
    monomials = np.asarray(offset_mm, dtype=np.float64) @ _unnormalized_monomials()
    return (monomials / radius_mm**degree)[..., horner_order()]


def rotation_matrix(
    *, rotation_deg: float, tilt_deg: tuple[float, float]
) -> NDArray[Any]:
    """Return the rotation (3, 3) from surface to eye axes: about z, then x, then y."""

    def turn(angle_deg: float, i: int, j: int) -> NDArray[np.float64]:
        matrix = np.eye(3)
        cosine, sine = (
            math.cos(math.radians(angle_deg)),
            math.sin(math.radians(angle_deg)),
        )
        matrix[i, i] = matrix[j, j] = cosine
        matrix[j, i], matrix[i, j] = sine, -sine
        return matrix

    about_z = turn(rotation_deg, 0, 1)
    return turn(tilt_deg[1], 2, 0) @ turn(tilt_deg[0], 1, 2) @ about_z


def _pack_shape(
    row: NDArray[Any], radius_mm: tuple[float, float], conic: float
) -> None:
    row[CURVATURE_X], row[CURVATURE_Y] = (1.0 / r for r in radius_mm)
    row[CONIC] = conic
    row[ROTATION : ROTATION + 9] = np.eye(3).ravel()
    row[FORM] = REVOLVED if radius_mm[0] == radius_mm[1] else BICONIC
    row[CLEAR_SQUARED] = math.inf


def _pack_surface(surface: Surface, row: NDArray[Any]) -> None:
    _pack_shape(row, surface.radius_mm, surface.conic_constant)
    row[VERTEX : VERTEX + 3] = (*surface.decentration_mm, surface.z_mm)
    row[CLEAR_SQUARED] = surface.clear_radius_mm**2
    if surface.offset_mm is not None and np.any(surface.offset_mm):
        row[FORM] = WITH_OFFSET
        row[OFFSET : OFFSET + N_TERMS] = offset_monomials(
            surface.offset_mm, offset_radius_mm=surface.offset_radius_mm
        )
    plain = row[FORM] == REVOLVED and surface.tilt_deg == (0.0, 0.0)
    if not plain and (surface.rotation_deg != 0.0 or surface.tilt_deg != (0.0, 0.0)):
        row[IS_TURNED] = 1.0
        row[ROTATION : ROTATION + 9] = rotation_matrix(
            rotation_deg=surface.rotation_deg, tilt_deg=surface.tilt_deg
        ).ravel()


def pack_eye(eye: EyeSurfaces) -> NDArray[np.float64]:
    """Pack the geometry of an eye into one array for compiled code.

    Returns
    -------
    packed : (n_surfaces + 1, 48)
        One row per refracting surface, then the retina; columns as named at the top
        of this file.  Refractive indices are passed separately (`media_indices`),
        because one geometry serves many wavelengths.  Eyes with the same number of
        surfaces stack to (n_eyes, n_surfaces + 1, 48).
    """
    packed = np.zeros((len(eye.surfaces) + 1, N_COLUMNS))
    for surface, row in zip(eye.surfaces, packed, strict=False):
        _pack_surface(surface, row)
    retina = eye.retina
    radii = np.broadcast_to(np.asarray(retina.radius_mm, dtype=np.float64), (2,))
    last = packed[-1]
    _pack_shape(last, tuple(-np.abs(radii)), retina.conic_constant)
    last[VERTEX + 2] = retina.z_mm
    last[STOP_Z] = eye.stop_z_mm
    last[N_BEFORE_STOP] = sum(
        s.z_mm < eye.stop_z_mm - STOP_TOLERANCE_MM for s in eye.surfaces
    )
    return packed


def media_indices(eye: EyeSurfaces, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
    """Return indices (..., n_surfaces + 1): air first, then behind each surface."""
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    names = ["air", *(s.medium_after for s in eye.surfaces)]
    return np.stack(
        [refractive_index(n, wavelength_nm, indices=eye.indices) for n in names],
        axis=-1,
    )


def check_eye(eye: EyeSurfaces) -> None:
    """Raise if an eye cannot be traced at all.

    Raises
    ------
    ValueError
        Names the surface and the invalid value.
    """
    if not 1 <= len(eye.surfaces) <= MAX_SURFACES:
        raise ValueError(
            f"{len(eye.surfaces)} surfaces: allowed are 1 to {MAX_SURFACES}"
        )
    depths_mm = [s.z_mm for s in eye.surfaces]
    for i, surface in enumerate(eye.surfaces):
        if 0.0 in surface.radius_mm or not all(r == r for r in surface.radius_mm):
            raise ValueError(f"surfaces[{i}].radius_mm {surface.radius_mm}: not 0")
        if not math.isfinite(surface.conic_constant + surface.z_mm):
            raise ValueError(f"surfaces[{i}]: conic constant and z must be finite")
        if surface.offset_radius_mm <= 0.0 or surface.clear_radius_mm <= 0.0:
            raise ValueError(f"surfaces[{i}]: radii of circles must be positive")
    if depths_mm != sorted(depths_mm):
        raise ValueError(f"surfaces at z {depths_mm} mm: must go inward in order")
    if not depths_mm[0] + STOP_TOLERANCE_MM < eye.stop_z_mm < eye.retina.z_mm:
        raise ValueError(
            f"stop at {eye.stop_z_mm:g} mm: must lie behind the first surface "
            f"({depths_mm[0]:g} mm) and before the retina ({eye.retina.z_mm:g} mm)"
        )
    if eye.retina.z_mm <= depths_mm[-1]:
        raise ValueError(
            f"retina at {eye.retina.z_mm:g} mm: must lie behind the last surface "
            f"({depths_mm[-1]:g} mm)"
        )
    if not np.all(np.asarray(eye.retina.radius_mm, dtype=float)):
        raise ValueError(f"retina.radius_mm {eye.retina.radius_mm}: not 0")
