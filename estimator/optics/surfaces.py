"""Surfaces of an eye, and the packed float64 array that compiled code traces through.

An eye consists of refracting surfaces, from the anterior cornea inward, a stop plane, a
retina, and the media between them.  Its frame has its origin at the corneal apex, x to
the person's right, y up and z into the eye.

`pack_eye` returns the geometry for compiled code: one row per refracting surface, then
one for the retina.  `media_indices` returns the *index row* of a wavelength: the
refractive index in front of the first surface and behind each surface, followed by the
parameters of each gradient-index medium.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.forms import FORMS, Form
from estimator.optics.gradients import (
    GRADIENTS,
    INDEX_FUNCTIONS,
    Gradient,
    index_values,
)
from estimator.optics.media import Dispersion, refractive_index
from estimator.optics.zernike import (
    DEFAULT_ORDER,
    EXPONENTS,
    N_TERMS,
    monomial_matrix,
    norms,
)

# --- geometry: one row per refracting surface, the retina last ---------------------
CURVATURE_X, CURVATURE_Y, CONIC = 0, 1, 2
VERTEX = 3  # x, y, z of the vertex, mm
ROTATION = 6  # 3 x 3, row-major: surface axes to eye axes
FORM = 15  # REVOLVED, BICONIC, WITH_OFFSET, or a form of `forms`
IS_TURNED = 16  # 1 where ROTATION is not the identity
CLEAR_SQUARED = 17  # square of the clear radius, mm²
NEAR_GRADIENT = 18  # 1 where the medium on either side has a gradient
GRADIENT = 19  # column of the index row where the medium behind starts; 0: homogeneous
OFFSET = 20  # 28 monomial coefficients, mm, in the order of `horner_order`
STOP_Z = 48  # last row only: the stop plane, mm
N_BEFORE_STOP = 49  # last row only: number of surfaces in front of the stop
FORM_NUMBERS = 50  # parameters of a form of `forms`
HAS_OFFSET = 62  # 1 where offset terms add to a form of `forms`
ADDED_CURVATURE = 63  # mean curvature that a form of `forms` adds at the vertex, 1/mm
N_COLUMNS = 64
N_FORM_NUMBERS = HAS_OFFSET - FORM_NUMBERS

REVOLVED, BICONIC, WITH_OFFSET = 0, 1, 2
FIRST_FORM = 3  # of the table in `forms`

# --- index row, from the column that GRADIENT names --------------------------------
GRADIENT_FORM = 0  # position in `gradients.INDEX_FUNCTIONS`
GRADIENT_STEPS = 1  # steps of the integration through the medium
GRADIENT_NUMBERS = 2  # parameters of the gradient


OFFSET_RADIUS_MM = 6.2
"""Radius of the circle of the corneal offset terms: half of the paper's 12.4 mm."""

MAX_SURFACES = 20

MAX_STEPS = 1000

INDEX_LIMITS = (1.0, 5.0)

STOP_TOLERANCE_MM = 1e-6
"""Tolerance within which a vertex counts as in the stop plane, and thus behind it."""


@dataclass(frozen=True)
class Surface:
    """A refracting surface.

    The sag is z = (x²/Rx + y²/Ry) / (1 + sqrt(1 - (1+k)(x²/Rx² + y²/Ry²))) + offset, in
    axes with their origin at the vertex.  They are rotated (right-handed) by
    ``rotation_deg`` about the axis of the surface, then by ``tilt_deg`` about the eye's
    x and y axes.

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
    rotation_deg : float
    decentration_mm : (x, y)
        Position of the vertex across the axis.
    tilt_deg : (about x, about y)
    offset_mm : (28,) or None
        Unnormalized Zernike terms (OSA order) added to the sag, mm.
    offset_radius_mm : float
        Radius of the circle of the offset terms.
    clear_radius_mm : float
        Distance from the axis of the surface beyond which rays are clipped.
    form : Form or None
        Form that replaces the biconic; offset terms are added to it.
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
    form: Form | None = None


@dataclass(frozen=True)
class Retina:
    """The retina: a conic or biconic, concave toward the lens.

    Attributes
    ----------
    radius_mm : float or (Rx, Ry)
        Radii; their sign is ignored.
    z_mm : float
        Position of the posterior pole.
    conic_constant, rotation_deg, decentration_mm, tilt_deg, form
        See `Surface`.
    """

    radius_mm: float | tuple[float, float]
    conic_constant: float
    z_mm: float
    rotation_deg: float = 0.0
    decentration_mm: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    form: Form | None = None


@dataclass(frozen=True)
class EyeSurfaces:
    """Geometry and media of an eye.

    Attributes
    ----------
    surfaces : tuple of Surface
        Refracting surfaces, from the anterior cornea inward.
    stop_z_mm : float
        Position of the stop plane, whose aperture is a circle about the z axis.
    retina : Retina
    indices : mapping or None
        Constant refractive indices by medium.
    media : mapping or None
        Dispersions and gradients by medium.  Media in neither mapping have the
        dispersion of `optics.media`.
    """

    surfaces: tuple[Surface, ...]
    stop_z_mm: float
    retina: Retina
    indices: Mapping[str, float] | None = field(default=None)
    media: Mapping[str, Dispersion | Gradient] | None = field(default=None)

    @cached_property
    def packed(self) -> NDArray[np.float64]:
        """Return the result of `pack_eye`, read-only; grids and chief rays share it."""
        packed = pack_eye(self)
        packed.setflags(write=False)
        return packed


@cache
def horner_order() -> NDArray[np.int64]:
    """Return the indices (28,) in ``EXPONENTS`` of monomials in Horner's order.

    Powers of y descend from 6 to 0 and, for each of them, the powers of x.
    """
    position = {tuple(e): t for t, e in enumerate(EXPONENTS.tolist())}
    return np.array(
        [
            position[a, b]
            for b in range(DEFAULT_ORDER, -1, -1)
            for a in range(DEFAULT_ORDER - b, -1, -1)
        ]
    )


@cache
def _unnormalized_monomials() -> NDArray[np.float64]:
    return monomial_matrix() / norms()[:, None]


def offset_monomials(
    offset_mm: ArrayLike, *, offset_radius_mm: ArrayLike
) -> NDArray[Any]:
    """Return the monomial coefficients (..., 28) of offset terms, in Horner's order.

    Parameters
    ----------
    offset_mm : (..., 28)
        Unnormalized Zernike terms, index = j.
    offset_radius_mm : (...)
        Radius of their circle.
    """
    degree: NDArray[np.int64] = EXPONENTS.sum(axis=1)
    radius_mm = np.asarray(offset_radius_mm, dtype=np.float64)[..., None]
    monomials = np.asarray(offset_mm, dtype=np.float64) @ _unnormalized_monomials()
    return (monomials / radius_mm**degree)[..., horner_order()]


def rotation_matrix(
    *, rotation_deg: float, tilt_deg: tuple[float, float]
) -> NDArray[Any]:
    """Return the rotation matrix (3, 3) from the axes of a surface to the eye's.

    The rotations are about z, then x, then y.
    """
    angles = [math.radians(angle) for angle in (*tilt_deg, rotation_deg)]
    (cx, cy, cz), (sx, sy, sz) = map(math.cos, angles), map(math.sin, angles)
    # multiplied out: a product of three arrays takes ten times as long
    return np.array(
        [
            [cy * cz + sy * sx * sz, sy * sx * cz - cy * sz, sy * cx],
            [cx * sz, cx * cz, -sx],
            [cy * sx * sz - sy * cz, sy * sz + cy * sx * cz, cy * cx],
        ]
    )


def _pack_shape(
    row: NDArray[Any],
    radius_mm: tuple[float, float],
    conic: float,
    form: Form | None,
) -> None:
    row[CURVATURE_X], row[CURVATURE_Y] = (1.0 / r for r in radius_mm)
    row[CONIC] = conic
    row[ROTATION : ROTATION + 9] = np.eye(3).ravel()
    row[FORM] = REVOLVED if radius_mm[0] == radius_mm[1] else BICONIC
    row[CLEAR_SQUARED] = math.inf
    if form is not None:
        numbers = form.numbers()
        row[FORM] = FIRST_FORM + FORMS.index(type(form))
        row[FORM_NUMBERS : FORM_NUMBERS + len(numbers)] = numbers
        row[ADDED_CURVATURE] = form.added_curvature(
            (float(row[CURVATURE_X]), float(row[CURVATURE_Y]))
        )


def _pack_axes(
    row: NDArray[Any], rotation_deg: float, tilt_deg: tuple[float, float]
) -> None:
    plain = row[FORM] == REVOLVED and tilt_deg == (0.0, 0.0)
    if not plain and (rotation_deg != 0.0 or tilt_deg != (0.0, 0.0)):
        row[IS_TURNED] = 1.0
        row[ROTATION : ROTATION + 9] = rotation_matrix(
            rotation_deg=rotation_deg, tilt_deg=tilt_deg
        ).ravel()


def _pack_surface(surface: Surface, row: NDArray[Any]) -> None:
    _pack_shape(row, surface.radius_mm, surface.conic_constant, surface.form)
    row[VERTEX : VERTEX + 3] = (*surface.decentration_mm, surface.z_mm)
    row[CLEAR_SQUARED] = surface.clear_radius_mm**2
    if surface.offset_mm is not None and np.any(surface.offset_mm):
        if surface.form is None:
            row[FORM] = WITH_OFFSET
        else:
            row[HAS_OFFSET] = 1.0
        row[OFFSET : OFFSET + N_TERMS] = offset_monomials(
            surface.offset_mm, offset_radius_mm=surface.offset_radius_mm
        )
    _pack_axes(row, surface.rotation_deg, surface.tilt_deg)


def pack_eye(eye: EyeSurfaces) -> NDArray[np.float64]:
    """Pack the geometry of an eye into one array for compiled code.

    Returns
    -------
    packed : (n_surfaces + 1, N_COLUMNS)
        One row per refracting surface, then one for the retina; constants list the
        columns.  Refractive indices are separate (`media_indices`), because they change
        with wavelength.  Eyes with the same number of surfaces and the same gradients
        can be stacked to (n_eyes, n_surfaces + 1, N_COLUMNS).
    """
    packed = np.zeros((len(eye.surfaces) + 1, N_COLUMNS))
    for surface, row in zip(eye.surfaces, packed, strict=False):
        _pack_surface(surface, row)
    retina = eye.retina
    radii = np.broadcast_to(np.asarray(retina.radius_mm, dtype=np.float64), (2,))
    last = packed[-1]
    _pack_shape(last, tuple(-np.abs(radii)), retina.conic_constant, retina.form)
    last[VERTEX : VERTEX + 3] = (*retina.decentration_mm, retina.z_mm)
    _pack_axes(last, retina.rotation_deg, retina.tilt_deg)
    last[STOP_Z] = eye.stop_z_mm
    last[N_BEFORE_STOP] = sum(
        s.z_mm < eye.stop_z_mm - STOP_TOLERANCE_MM for s in eye.surfaces
    )
    column = len(eye.surfaces) + 1
    for i, gradient in _gradients(eye):
        packed[i, GRADIENT] = column
        packed[i : i + 2, NEAR_GRADIENT] = 1.0
        column += len(_gradient_columns(gradient, GRADIENT_LAYOUT_NM))
    return packed


GRADIENT_LAYOUT_NM = 555.0
"""Wavelength at which the parameters of a gradient are counted; any would do."""


def _gradients(eye: EyeSurfaces) -> list[tuple[int, Gradient]]:
    """Return the gradient-index media, each with the index of the surface in front."""
    media = eye.media
    if not media:
        return []
    found = []
    for i, surface in enumerate(eye.surfaces):
        medium = media.get(surface.medium_after)
        if isinstance(medium, GRADIENTS):
            found.append((i, medium))
    return found


def _gradient_columns(gradient: Gradient, wavelength_nm: float) -> NDArray[np.float64]:
    form = INDEX_FUNCTIONS.index(gradient.index)
    return np.array([form, gradient.steps, *gradient.numbers(wavelength_nm)])


def _check_indices(indices: NDArray[np.float64], names: list[str]) -> None:
    low, high = INDEX_LIMITS
    if low <= indices.min() and indices.max() <= high:
        return
    for i, name in enumerate(names[1:]):
        behind = indices[..., i + 1]
        if not (low <= behind.min() and behind.max() <= high):
            raise ValueError(
                f"surfaces[{i}].medium_after '{name}': index {behind}, allowed is "
                f"{low:g} to {high:g}"
            )


def media_indices(eye: EyeSurfaces, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
    """Return the index rows (..., n) of an eye at wavelengths (...).

    The first n_surfaces + 1 columns are the refractive indices of air and of the medium
    behind each surface (of a gradient, at the vertex).  The parameters of the gradients
    follow.

    Raises
    ------
    ValueError
        A medium is unknown, or a wavelength or an index is out of range.
    """
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    gradients = _gradients(eye)
    behind = dict(gradients)
    homogeneous = eye.media and {
        name: medium
        for name, medium in eye.media.items()
        if not isinstance(medium, GRADIENTS)
    }
    names = ["air", *(s.medium_after for s in eye.surfaces)]
    indices = np.stack(
        [
            np.vectorize(behind[i].vertex_index, otypes=[float])(wavelength_nm)
            if i in behind
            else refractive_index(
                name, wavelength_nm, indices=eye.indices, media=homogeneous
            )
            for i, name in enumerate(names, start=-1)
        ],
        axis=-1,
    )
    _check_indices(indices, names)
    if not gradients:
        return indices
    numbers = [
        np.concatenate([_gradient_columns(g, nm) for _, g in gradients])
        for nm in wavelength_nm.ravel().tolist()
    ]
    return np.concatenate(
        [indices, np.reshape(numbers, (*wavelength_nm.shape, -1))], axis=-1
    )


def check_eye(eye: EyeSurfaces) -> None:
    """Check the geometry of an eye.

    Raises
    ------
    ValueError
        The eye cannot be traced; the message names the surface and the invalid value.
    """
    if not 1 <= len(eye.surfaces) <= MAX_SURFACES:
        raise ValueError(
            f"{len(eye.surfaces)} surfaces: allowed are 1 to {MAX_SURFACES}"
        )
    depths_mm = [s.z_mm for s in eye.surfaces]
    for i, surface in enumerate(eye.surfaces):
        if 0.0 in surface.radius_mm or not all(r == r for r in surface.radius_mm):
            raise ValueError(
                f"surfaces[{i}].radius_mm {surface.radius_mm}: must not be 0 or nan"
            )
        if not math.isfinite(surface.conic_constant + surface.z_mm):
            raise ValueError(f"surfaces[{i}]: conic constant and z must be finite")
        if surface.offset_radius_mm <= 0.0 or surface.clear_radius_mm <= 0.0:
            raise ValueError(
                f"surfaces[{i}]: offset_radius_mm and clear_radius_mm must be positive"
            )
        _check_form(surface.form, f"surfaces[{i}].form")
        if i and surface.z_mm < depths_mm[i - 1]:
            raise ValueError(
                f"surfaces[{i}].z_mm {surface.z_mm:g}: must not lie in front of "
                f"surfaces[{i - 1}] ({depths_mm[i - 1]:g} mm)"
            )
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
        raise ValueError(f"retina.radius_mm {eye.retina.radius_mm}: must not be 0")
    _check_form(eye.retina.form, "retina.form")
    if eye.media:
        _check_gradients(eye)


def _check_form(form: Form | None, name: str) -> None:
    if form is None:
        return
    if not isinstance(form, FORMS):
        kinds = ", ".join(f.__name__ for f in FORMS)
        raise ValueError(f"{name} {form!r:.60}: allowed are {kinds}")
    numbers = form.numbers()
    if len(numbers) > N_FORM_NUMBERS or not all(map(math.isfinite, numbers)):
        raise ValueError(
            f"{name} {numbers}: allowed are at most {N_FORM_NUMBERS} finite numbers"
        )


def _check_gradients(eye: EyeSurfaces) -> None:
    """Check the position and the index of the gradient-index media."""
    depths_mm = [*(s.z_mm for s in eye.surfaces), eye.retina.z_mm]
    n_before = sum(z < eye.stop_z_mm - STOP_TOLERANCE_MM for z in depths_mm[:-1])
    for i, gradient in _gradients(eye):
        name = f"surfaces[{i}].medium_after '{eye.surfaces[i].medium_after}'"
        if i == n_before - 1:
            raise ValueError(
                f"{name}: the stop at {eye.stop_z_mm:g} mm lies in this gradient; the "
                "medium around the stop must be homogeneous"
            )
        if i == len(eye.surfaces) - 1:
            raise ValueError(f"{name}: the medium at the retina must be homogeneous")
        if not 1 <= gradient.steps <= MAX_STEPS:
            raise ValueError(
                f"{name}: {gradient.steps} steps, allowed are 1 to {MAX_STEPS}"
            )
        on_axis_mm = np.zeros((5, 3))
        on_axis_mm[:, 2] = np.linspace(0.0, depths_mm[i + 1] - depths_mm[i], 5)
        medium = _gradient_columns(gradient, GRADIENT_LAYOUT_NM)
        squares = index_values(medium, 0, on_axis_mm)[:, 0]
        low, high = INDEX_LIMITS
        for z_mm, squared in zip(on_axis_mm[:, 2], squares, strict=True):
            if not low**2 <= squared <= high**2:
                raise ValueError(
                    f"{name}: squared index {squared:.4g} on the axis at depth "
                    f"{z_mm:.3g} mm; the index must be {low:g} to {high:g}"
                )
