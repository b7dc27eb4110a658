"""Conversion of the 45 parameters to surfaces, for one eye or packed batches.

The shape of the lens follows from its diameter and volume.  Two conic caps that meet at
the equator cannot represent a real lens, which has a thick rounded rim.  Two rules, A
and C, assign part of the volume to the caps and a thickness to the rim.

The accommodating lens shrinks at constant volume, which steepens both surfaces (rule
C).  The part before the equator gets thicker, which moves the anterior pole and the
stop forward and makes the aqueous thinner.  The eye length does not change.

The anterior surface takes part in this deformation: scaled by s across the axis and by
1/s² along it, a conic remains a conic, with 1 + k scaled by s⁶.  The posterior surface
keeps its conic constant.  In stretched lenses of monkeys, too, the anterior conic
constant became less negative with accommodation and the posterior one did not change
(de Castro et al., Invest Ophthalmol Vis Sci 54:6197, 2013).  Lenses with a gradient
index have been fitted with the opposite change (-1/2 per diopter: Navarro, J Vis
14(7):21, 2014); in this homogeneous one it would double the fall of C(4,0).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.parameters import (
    OFFSET_RADIUS_MM,
    OFFSET_SLICE,
    EyeParameters,
    RetinaShape,
    column,
)
from estimator.optics import surfaces as packing
from estimator.optics.surfaces import (
    EyeSurfaces,
    Retina,
    Surface,
    offset_monomials,
    rotation_matrix,
)

HEIGHT_RATIO = 0.60
"""Ratio of the anterior cap's height to the posterior cap's."""

CAP_VOLUME_RATIO = 0.677
"""Fraction of the volume in the two caps (rule C)."""

RIM_THICKNESS_MM = 1.0
"""Thickness between the two caps (rule C); with the constants above it gives Navarro's
lens for a diameter of 9.5 mm and 157.5 mm³."""

ANTERIOR_THICKNESS_RATIO = HEIGHT_RATIO / (1.0 + HEIGHT_RATIO)
"""Fraction of the thickness, rim included, that lies before the equator."""


@dataclass(frozen=True)
class LensShape:
    """Vertex radii and central thickness; arrays if the inputs were arrays."""

    anterior_radius_mm: float | NDArray[np.float64]
    posterior_radius_mm: float | NDArray[np.float64]
    thickness_mm: float | NDArray[np.float64]

    @property
    def anterior_thickness_mm(self) -> float | NDArray[np.float64]:
        """Return the thickness before the equator."""
        return self.thickness_mm * ANTERIOR_THICKNESS_RATIO


def lens_shape(*, diameter_mm: ArrayLike, volume_mm3: ArrayLike) -> LensShape:
    """Return the lens shape by rule C, the paraboloid-equivalent volume.

    h_A + h_P = 8 eta V / (pi D²), R_P = -pi D⁴ (1 + tau) / (64 eta V), R_A = -R_P / tau
    with tau = h_A / h_P.  The solution always exists and is monotonic in D.  The conic
    constants shape only the surfaces.

    Raises
    ------
    ValueError
        A diameter or volume is not positive.
    """
    diameter_mm = np.asarray(diameter_mm, dtype=np.float64)[()]
    volume_mm3 = np.asarray(volume_mm3, dtype=np.float64)[()]
    if not (np.all(diameter_mm > 0) and np.all(volume_mm3 > 0)):
        raise ValueError(
            f"lens diameter {diameter_mm} mm, volume {volume_mm3} mm³: "
            "both must be positive"
        )
    cap_volume_mm3 = CAP_VOLUME_RATIO * volume_mm3
    heights_mm = 8.0 * cap_volume_mm3 / (math.pi * diameter_mm**2)
    posterior_radius_mm = (
        -math.pi * diameter_mm**4 * (1.0 + HEIGHT_RATIO) / (64.0 * cap_volume_mm3)
    )
    return LensShape(
        anterior_radius_mm=-posterior_radius_mm / HEIGHT_RATIO,
        posterior_radius_mm=posterior_radius_mm,
        thickness_mm=RIM_THICKNESS_MM + heights_mm,
    )


def compat_lens_shape(
    *,
    diameter_mm: float,
    volume_mm3: float,
    anterior_conic_constant: float,
    posterior_conic_constant: float,
) -> LensShape:
    """Return the lens shape by rule A, for comparison with published tables only.

    Its cap volume has a sign error for hyperboloids, kept here on purpose.

    Raises
    ------
    ValueError
        No pair of caps has this volume.
    """
    from scipy.optimize import brentq  # takes 20 MB, for this rule alone

    rim_mm = 10.0 / (diameter_mm - 4.0)
    cap_volume_mm3 = 0.3 * rim_mm * volume_mm3

    def cap_height_mm(volume_mm3: float, conic_constant: float) -> float:
        return _compat_cap_height_mm(
            volume_mm3, conic_constant=conic_constant, diameter_mm=diameter_mm
        )

    def ratio_error_mm(anterior_mm3: float) -> float:
        anterior_mm = cap_height_mm(anterior_mm3, anterior_conic_constant)
        rest_mm3 = cap_volume_mm3 - anterior_mm3
        posterior_mm = cap_height_mm(rest_mm3, posterior_conic_constant)
        return anterior_mm - HEIGHT_RATIO * posterior_mm

    tiny_mm3 = 1e-6 * cap_volume_mm3
    anterior_mm3 = brentq(
        ratio_error_mm, tiny_mm3, cap_volume_mm3 - tiny_mm3, xtol=1e-13, rtol=1e-15
    )
    heights_mm = (
        cap_height_mm(anterior_mm3, anterior_conic_constant),
        cap_height_mm(cap_volume_mm3 - anterior_mm3, posterior_conic_constant),
    )
    radii_mm = [
        (1.0 + conic) * height / 2.0 + diameter_mm**2 / (8.0 * height)
        for conic, height in zip(
            (anterior_conic_constant, posterior_conic_constant), heights_mm, strict=True
        )
    ]
    return LensShape(
        anterior_radius_mm=radii_mm[0],
        posterior_radius_mm=-radii_mm[1],
        thickness_mm=sum(heights_mm) + rim_mm,
    )


def _compat_cap_height_mm(
    volume_mm3: float, *, conic_constant: float, diameter_mm: float
) -> float:
    """Solve V = (pi/8) D² h (5 b h² + .75 D²)/(6 b h² + .75 D²) for the height h."""
    from scipy.optimize import brentq

    b = 1.0 + conic_constant
    square = 0.75 * diameter_mm**2

    def volume_error_mm3(h: float) -> float:
        bracket = (5.0 * b * h * h + square) / (6.0 * b * h * h + square)
        return math.pi / 8.0 * diameter_mm**2 * h * bracket - volume_mm3

    # the bracket's pole bounds the root for a hyperboloid; an ellipsoid's h is below D
    highest_mm = diameter_mm / math.sqrt(-8.0 * b) if b < 0.0 else diameter_mm
    return brentq(
        volume_error_mm3, 1e-12, highest_mm * (1.0 - 1e-12), xtol=1e-14, rtol=1e-15
    )


N_SURFACES = 4
CORNEA_ANTERIOR, CORNEA_POSTERIOR, LENS_ANTERIOR, LENS_POSTERIOR, RETINA = range(5)

_Numbers = float | NDArray[np.float64]
"""One number, or one for each eye (P,)."""


def eye_surfaces(
    parameters: EyeParameters,
    *,
    retina: RetinaShape | None = None,
    lens_rule: str = "C",
) -> EyeSurfaces:
    """Return the surfaces of one eye.

    Parameters
    ----------
    parameters : EyeParameters
        Relaxed or accommodated eye (other lens diameter and aqueous thickness).
    retina : RetinaShape, optional
        Shape of the retina; by default a sphere of radius eye length / 2.
    lens_rule : {"C", "compat"}
        Rule of the lens shape; ``compat`` is the rule of the published data sets
        (rule A).

    Raises
    ------
    ValueError
        The lens rule is unknown.

    Notes
    -----
    The stop is the plane of the lens's undisplaced anterior pole and stays centered;
    the lens is decentered and tilted as one body about its anterior vertex.
    """
    p = parameters
    anterior_mm = p.cornea_anterior_radius_mm
    posterior_mm = anterior_mm * p.cornea_posterior_radius_ratio
    cornea = (
        Surface(
            radius_mm=(anterior_mm, anterior_mm),
            conic_constant=p.cornea_anterior_conic_constant,
            z_mm=0.0,
            medium_after="cornea",
            rotation_deg=p.cornea_anterior_rotation_deg,
            offset_mm=p.cornea_offset_mm,
            offset_radius_mm=OFFSET_RADIUS_MM,
        ),
        Surface(
            radius_mm=(
                posterior_mm,
                posterior_mm * p.cornea_posterior_astigmatism_ratio,
            ),
            conic_constant=p.cornea_posterior_conic_constant,
            z_mm=p.cornea_thickness_mm,
            medium_after="aqueous",
            rotation_deg=p.cornea_posterior_rotation_deg,
        ),
    )
    stop_z_mm = p.cornea_thickness_mm + p.aqueous_thickness_mm
    shape = retina or RetinaShape(radius_mm=p.eye_length_mm / 2.0)
    return EyeSurfaces(
        surfaces=cornea + _lens_surfaces(p, stop_z_mm, lens_rule),
        stop_z_mm=stop_z_mm,
        retina=Retina(
            radius_mm=shape.radius_mm,
            conic_constant=shape.conic_constant,
            z_mm=p.eye_length_mm,
        ),
    )


def _lens_surfaces(
    p: EyeParameters, pole_z_mm: float, lens_rule: str
) -> tuple[Surface, Surface]:
    size = {"diameter_mm": p.lens_diameter_mm, "volume_mm3": p.lens_volume_mm3}
    if lens_rule == "C":
        shape = lens_shape(**size)
    elif lens_rule == "compat":
        shape = compat_lens_shape(
            **size,
            anterior_conic_constant=p.lens_anterior_conic_constant,
            posterior_conic_constant=p.lens_posterior_conic_constant,
        )
    else:
        raise ValueError(f"lens rule '{lens_rule}': allowed are C and compat")
    tilt_deg = (p.lens_tilt_about_x_deg, p.lens_tilt_about_y_deg)
    axis = rotation_matrix(rotation_deg=0.0, tilt_deg=tilt_deg)[:, 2]
    vertex_mm = np.array(
        [p.lens_decentration_x_mm, p.lens_decentration_y_mm, pole_z_mm]
    )
    rear_mm = vertex_mm + float(shape.thickness_mm) * axis
    anterior = Surface(
        radius_mm=(float(shape.anterior_radius_mm),) * 2,
        conic_constant=p.lens_anterior_conic_constant,
        z_mm=pole_z_mm,
        medium_after="lens",
        decentration_mm=(p.lens_decentration_x_mm, p.lens_decentration_y_mm),
        tilt_deg=tilt_deg,
    )
    posterior = Surface(
        radius_mm=(float(shape.posterior_radius_mm),) * 2,
        conic_constant=p.lens_posterior_conic_constant,
        z_mm=float(rear_mm[2]),
        medium_after="vitreous",
        decentration_mm=(float(rear_mm[0]), float(rear_mm[1])),
        tilt_deg=tilt_deg,
    )
    return anterior, posterior


def pack_eyes(
    vectors: NDArray[np.float64], *, retina: RetinaShape | None = None
) -> NDArray[np.float64]:
    """Pack many eyes at once, like `pack_eye(eye_surfaces(...))` without objects.

    Parameters
    ----------
    vectors : (P, 45)
        Parameters in table order; lens rule C.

    Returns
    -------
    packed : (P, 5, N_COLUMNS)
        Surfaces in the layout of `estimator.optics.surfaces.pack_eye`.
    """

    def given(name: str) -> NDArray[np.float64]:
        return vectors[:, column(name)]

    packed = np.zeros((len(vectors), N_SURFACES + 1, packing.N_COLUMNS))
    packed[:, :, packing.ROTATION : packing.ROTATION + 9] = np.eye(3).ravel()
    packed[:, :, packing.CLEAR_SQUARED] = math.inf
    packed[:, RETINA, packing.CLEAR_SQUARED] = math.inf
    anterior_mm = given("cornea_anterior_radius_mm")
    posterior_mm = anterior_mm * given("cornea_posterior_radius_ratio")
    across_mm = posterior_mm * given("cornea_posterior_astigmatism_ratio")
    _set_shape(
        packed[:, CORNEA_ANTERIOR],
        (anterior_mm, anterior_mm),
        given("cornea_anterior_conic_constant"),
    )
    _set_shape(
        packed[:, CORNEA_POSTERIOR],
        (posterior_mm, across_mm),
        given("cornea_posterior_conic_constant"),
    )
    _set_offsets(packed[:, CORNEA_ANTERIOR], vectors[:, OFFSET_SLICE])
    for surface, name in (
        (CORNEA_ANTERIOR, "cornea_anterior_rotation_deg"),
        (CORNEA_POSTERIOR, "cornea_posterior_rotation_deg"),
    ):
        turns = _turn_about_z(given(name))
        packed[:, surface, packing.ROTATION : packing.ROTATION + 9] = turns
        packed[:, surface, packing.IS_TURNED] = given(name) != 0.0
    packed[:, CORNEA_POSTERIOR, packing.VERTEX + 2] = given("cornea_thickness_mm")
    stop_z_mm = given("cornea_thickness_mm") + given("aqueous_thickness_mm")
    _set_lens(packed, given, stop_z_mm)
    _set_retina(packed[:, RETINA], given("eye_length_mm"), stop_z_mm, retina)
    return packed


def _set_shape(
    rows: NDArray[np.float64],
    radii_mm: tuple[_Numbers, _Numbers],
    conic_constant: _Numbers,
) -> None:
    rows[:, packing.CURVATURE_X] = 1.0 / radii_mm[0]
    rows[:, packing.CURVATURE_Y] = 1.0 / radii_mm[1]
    rows[:, packing.CONIC] = conic_constant
    rows[:, packing.FORM] = np.where(
        radii_mm[0] == radii_mm[1], packing.REVOLVED, packing.BICONIC
    )


def _set_offsets(rows: NDArray[np.float64], offsets_mm: NDArray[np.float64]) -> None:
    terms_mm = np.concatenate([np.zeros((len(rows), 1)), offsets_mm], axis=1)
    rows[:, packing.OFFSET : packing.OFFSET + terms_mm.shape[1]] = offset_monomials(
        terms_mm, offset_radius_mm=OFFSET_RADIUS_MM
    )
    rows[:, packing.FORM] = np.where(
        np.any(offsets_mm != 0.0, axis=1), packing.WITH_OFFSET, rows[:, packing.FORM]
    )


def _turn_about_z(angles_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return row-major rotation matrices (P, 9)."""
    cosine, sine = np.cos(np.radians(angles_deg)), np.sin(np.radians(angles_deg))
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    rows = (cosine, -sine, zero, sine, cosine, zero, zero, zero, one)
    return np.stack(rows, axis=-1)


def _lens_turns(
    about_x_deg: NDArray[np.float64], about_y_deg: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return row-major matrices (P, 9) of a rotation about x, then about y."""
    cx, sx = np.cos(np.radians(about_x_deg)), np.sin(np.radians(about_x_deg))
    cy, sy = np.cos(np.radians(about_y_deg)), np.sin(np.radians(about_y_deg))
    zero = np.zeros_like(cx)
    rows = (cy, sy * sx, sy * cx, zero, cx, -sx, -sy, cy * sx, cy * cx)
    return np.stack(rows, axis=-1)


def _set_lens(
    packed: NDArray[np.float64],
    given: Callable[[str], NDArray[np.float64]],
    stop_z_mm: NDArray[np.float64],
) -> None:
    shape = lens_shape(
        diameter_mm=given("lens_diameter_mm"), volume_mm3=given("lens_volume_mm3")
    )
    about_x_deg, about_y_deg = (
        given("lens_tilt_about_x_deg"),
        given("lens_tilt_about_y_deg"),
    )
    turns = _lens_turns(about_x_deg, about_y_deg)
    axis = turns.reshape(-1, 3, 3)[:, :, 2]
    vertex_mm = np.stack(
        [
            given("lens_decentration_x_mm"),
            given("lens_decentration_y_mm"),
            stop_z_mm,
        ],
        axis=-1,
    )
    for surface, radius_mm, conic, depth_mm in (
        (LENS_ANTERIOR, shape.anterior_radius_mm, "lens_anterior_conic_constant", 0.0),
        (
            LENS_POSTERIOR,
            shape.posterior_radius_mm,
            "lens_posterior_conic_constant",
            cast("NDArray[np.float64]", shape.thickness_mm)[:, None],
        ),
    ):
        rows = packed[:, surface]
        _set_shape(rows, (radius_mm, radius_mm), given(conic))
        rows[:, packing.VERTEX : packing.VERTEX + 3] = vertex_mm + depth_mm * axis
        rows[:, packing.ROTATION : packing.ROTATION + 9] = turns
        rows[:, packing.IS_TURNED] = (about_x_deg != 0.0) | (about_y_deg != 0.0)


def _set_retina(
    rows: NDArray[np.float64],
    eye_length_mm: NDArray[np.float64],
    stop_z_mm: NDArray[np.float64],
    retina: RetinaShape | None,
) -> None:
    shape = retina or RetinaShape(radius_mm=math.nan)
    radius_mm = -(eye_length_mm / 2.0 if retina is None else shape.radius_mm)
    radius_mm = np.broadcast_to(radius_mm, eye_length_mm.shape)
    conic_constant = 0.0 if retina is None else shape.conic_constant
    _set_shape(rows, (radius_mm, radius_mm), conic_constant)
    rows[:, packing.VERTEX + 2] = eye_length_mm
    rows[:, packing.STOP_Z] = stop_z_mm
    rows[:, packing.N_BEFORE_STOP] = 2.0


SMALLEST_DIAMETER_RATIO = 0.84
"""Ratio of the smallest lens diameter to the relaxed one.  The search of Csoba & Kunkli
2023 stopped at 0.91, where most of its published targets lie."""

SMALLEST_AQUEOUS_MM = 1.0
"""Depth of the anterior chamber below which the lens would press on the cornea."""

DIAMETER = column("lens_diameter_mm")
VOLUME = column("lens_volume_mm3")
AQUEOUS = column("aqueous_thickness_mm")
ANTERIOR_CONIC = column("lens_anterior_conic_constant")


def accommodated_vectors(
    vector: NDArray[np.float64],
    *,
    lens_diameter_mm: ArrayLike,
    keeps_conics: bool = False,
) -> NDArray[np.float64]:
    """Return vectors (P, 45) of one relaxed eye with lens diameters (P,).

    With ``keeps_conics`` they are those of `resized_eyes`.
    """
    lens_diameter_mm = np.atleast_1d(np.asarray(lens_diameter_mm, dtype=np.float64))
    vectors = np.repeat(vector[None], lens_diameter_mm.size, axis=0)
    change = resized_eyes if keeps_conics else accommodated_eyes
    return change(vectors, lens_diameter_mm)


def accommodated_eyes(
    vectors: NDArray[np.float64], lens_diameter_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return relaxed eyes (P, 45) accommodated to lens diameters (P,)."""
    focused = resized_eyes(vectors, lens_diameter_mm)
    focused[:, ANTERIOR_CONIC] = accommodated_conic_constant(
        vectors[:, ANTERIOR_CONIC],
        diameter_ratio=lens_diameter_mm / vectors[:, DIAMETER],
    )
    return focused


def accommodated_conic_constant(
    conic_constant: NDArray[np.float64], *, diameter_ratio: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return anterior conic constants (...) of lenses with smaller diameters.

    Parameters
    ----------
    conic_constant : (...)
        Of the relaxed lens.
    diameter_ratio : (...)
        Diameter over that of the relaxed lens; 1 returns the same bits.
    """
    return conic_constant + (1.0 + conic_constant) * (diameter_ratio**6 - 1.0)


def resized_eyes(
    vectors: NDArray[np.float64], lens_diameter_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return eyes (P, 45) with other lens diameters (P,) at constant volume.

    The conic constants do not change: the focus network was trained on such eyes.
    """
    volume_mm3 = vectors[:, VOLUME]
    relaxed = lens_shape(diameter_mm=vectors[:, DIAMETER], volume_mm3=volume_mm3)
    shape = lens_shape(diameter_mm=lens_diameter_mm, volume_mm3=volume_mm3)
    focused = vectors.copy()
    focused[:, DIAMETER] = lens_diameter_mm
    focused[:, AQUEOUS] -= shape.anterior_thickness_mm - relaxed.anterior_thickness_mm
    return focused


def accommodated(
    parameters: EyeParameters, *, lens_diameter_mm: float, keeps_conics: bool = False
) -> EyeParameters:
    """Return the same eye, accommodated to a lens diameter.

    With ``keeps_conics`` it is that of `resized_eyes`.

    Raises
    ------
    ValueError
        The diameter is not positive.
    """
    vectors = accommodated_vectors(
        parameters.to_vector(),
        lens_diameter_mm=lens_diameter_mm,
        keeps_conics=keeps_conics,
    )
    return replace(
        parameters,
        lens_diameter_mm=float(vectors[0, DIAMETER]),
        aqueous_thickness_mm=float(vectors[0, AQUEOUS]),
        lens_anterior_conic_constant=float(vectors[0, ANTERIOR_CONIC]),
    )


def smallest_diameter_mm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest lens diameters (...) of relaxed eyes (..., 45).

    The limit is `SMALLEST_DIAMETER_RATIO` of the relaxed diameter, or the diameter that
    leaves the chamber `SMALLEST_AQUEOUS_MM` deep: the lens thickens before its equator
    by c (1/D² - 1/D0²), c = 8 eta V tau / (pi (1 + tau)), see `lens_shape`.
    """
    relaxed_mm, volume_mm3 = vectors[..., DIAMETER], vectors[..., VOLUME]
    room_mm = np.maximum(vectors[..., AQUEOUS] - SMALLEST_AQUEOUS_MM, 0.0)
    c_mm3 = 8.0 / math.pi * CAP_VOLUME_RATIO * ANTERIOR_THICKNESS_RATIO * volume_mm3
    fitting_mm = (relaxed_mm**-2 + room_mm / c_mm3) ** -0.5
    return np.maximum(fitting_mm, SMALLEST_DIAMETER_RATIO * relaxed_mm)
