"""Profiles that give the eye by its surfaces, or fail to name their kind.

Pseudophakic eyes come from biometry and the geometry of an implant.  The cornea follows
from keratometry: the anterior radius from the keratometer's index, the posterior one
from a ratio.  The aberrations of a measured cornea are reproduced by offsets of its
anterior surface.  The implant is placed by Olsen's C constant (Olsen & Hoffmann, J.
Cataract Refract. Surg. 40, 764, 2014): the position of its center in the capsule of the
natural lens, or at a given depth.
"""

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, structs
from numpy.typing import NDArray

from estimator.corrections.worn_lens import replaces_lens
from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import EyeParameters
from estimator.eye.surface_eye import SurfaceModel
from estimator.note import Note
from estimator.optics.media import AbbeNumber, Constant
from estimator.optics.prescription import power_vector_from_zernike
from estimator.optics.surfaces import (
    EyeSurfaces,
    Retina,
    Surface,
    check_eye,
    media_indices,
    pack_eye,
    rotation_matrix,
)
from estimator.optics.units import MM_PER_M, REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import DEFAULT_ORDER, N_TERMS, norms
from estimator.profiles import bodies, given_bodies
from estimator.profiles.coefficients import coefficients_um
from estimator.profiles.common_fields import common_fields
from estimator.profiles.correction_bodies import IntraocularBody
from estimator.profiles.eye_profile import SURFACES_PUPIL_MM, EyeProfile
from estimator.profiles.given_bodies import ImplantBody, PseudophakicBody
from estimator.profiles.surfaces import published_eye, radii_mm, surface_model
from estimator.profiles.synteyes import with_drawn_eye
from estimator.profiles.validation import convert

LABEL_INDEX = 1.336
"""Index of the aqueous in which the power of an implant is labeled (ISO 11979-2)."""

SMALLEST_GAP_MM = 0.1
"""Distance of the iris from the implant."""

SOLVED_DPT = (20.0, 22.0)
"""First two powers of an implant that is solved."""

MAX_POWER_STEPS, POWER_TOLERANCE_DPT = 12, 1e-6

HIGHER_ORDERS = range(6, N_TERMS)
MAX_CORNEA_STEPS = 8
CORNEA_TOLERANCE_UM = 1e-6

Numbers = NDArray[np.float64]


def pseudophakic_model(
    body: PseudophakicBody, cornea_um: Numbers | None
) -> SurfaceModel:
    """Return the eye of a body.

    Parameters
    ----------
    body : PseudophakicBody
    cornea_um : (28,) or None
        Measured aberrations of the whole cornea in the eye frame, on the circle of
        ``body.cornea_pupil_diameter_mm``; orders below 3 are ignored, because they
        follow from keratometry.

    Raises
    ------
    ProfileError
        Fields contradict each other, or the surfaces cannot be traced.
    """
    anterior, posterior = _cornea(body)
    center_mm = _center_mm(body)
    front, back = _implant(body.implant, center_mm)
    stop_z_mm = _stop_z_mm(body, front.z_mm)
    eye = EyeSurfaces(
        surfaces=(anterior, posterior, front, back),
        stop_z_mm=stop_z_mm,
        retina=_retina(body),
        media={"implant": _material(body.implant)},
    )
    if cornea_um is not None:
        eye = _with_cornea(eye, cornea_um, body.cornea_pupil_diameter_mm / 2.0)
    _check(eye)
    return SurfaceModel(eye)


def solved_power_dpt(body: PseudophakicBody, cornea_um: Numbers | None) -> float:
    """Return the labeled power with which the residual of a body's implant remains.

    Parameters
    ----------
    body : PseudophakicBody
        With ``implant.residual_dpt``.
    cornea_um : (28,) or None
        See `pseudophakic_model`.

    Raises
    ------
    ProfileError
        No power from -15 to 45 dpt leaves this refraction.
    """
    residual_dpt = body.implant.residual_dpt
    assert isinstance(residual_dpt, float)

    def error_dpt(power_dpt: float) -> float:
        implant = structs.replace(body.implant, power_dpt=power_dpt, residual_dpt=UNSET)
        solved = pseudophakic_model(structs.replace(body, implant=implant), cornea_um)
        return refraction_dpt(solved.relaxed) - residual_dpt

    low_dpt, high_dpt = SOLVED_DPT
    for _ in range(MAX_POWER_STEPS):
        low, high = error_dpt(low_dpt), error_dpt(high_dpt)
        if abs(high) < POWER_TOLERANCE_DPT:
            return high_dpt
        next_dpt = high_dpt - high * (high_dpt - low_dpt) / (high - low)
        low_dpt, high_dpt = high_dpt, next_dpt
        if not -15.0 <= next_dpt <= 45.0:
            break
    raise ProfileError(
        "implant.residual_dpt",
        f"{residual_dpt:g} needs an implant of another power",
        "a refraction that an implant of -15 to 45 dpt leaves",
    )


def refraction_dpt(eye: EyeSurfaces) -> float:
    """Return M at the cornea, 555 nm and `SURFACES_PUPIL_MM`."""
    from estimator.wavefront.aberrations import on_axis_zernike  # loads slowly

    radius_mm = SURFACES_PUPIL_MM / 2.0
    zernike_um = on_axis_zernike(
        pack_eye(eye)[None],
        media_indices(eye, REFERENCE_WAVELENGTH_NM),
        zernike_radius_mm=radius_mm,
    )[0][0]
    return power_vector_from_zernike(zernike_um, zernike_radius_mm=radius_mm)[0]


def _cornea(body: PseudophakicBody) -> tuple[Surface, Surface]:
    mean = EyeParameters.mean_eye()
    first_dpt, second_dpt = body.keratometry_dpt
    if body.keratometry_axis_deg is UNSET:
        if first_dpt != second_dpt:
            raise ProfileError(
                "keratometry_axis_deg",
                "is required if the powers of keratometry_dpt differ",
                "a number from 0 to 180",
            )
        axis_deg = 0.0
    else:
        axis_deg = body.keratometry_axis_deg
    scale = (body.keratometric_index - 1.0) * MM_PER_M
    radii = (scale / first_dpt, scale / second_dpt)
    shape: dict[str, Any] = {
        # the examiner faces the eye, so his axes turn the other way
        "rotation_deg": (180.0 - axis_deg) % 180.0,
    }
    conic = body.cornea_conic_constant
    anterior = Surface(
        radius_mm=radii,
        conic_constant=mean.cornea_anterior_conic_constant if conic is UNSET else conic,
        z_mm=0.0,
        medium_after="cornea",
        **shape,
    )
    posterior = Surface(
        radius_mm=(body.posterior_ratio * radii[0], body.posterior_ratio * radii[1]),
        conic_constant=mean.cornea_posterior_conic_constant,
        z_mm=mean.cornea_thickness_mm,
        medium_after="aqueous",
        **shape,
    )
    return anterior, posterior


def _center_mm(body: PseudophakicBody) -> float:
    """Return the depth of the implant's center."""
    before = body.acd_mm, body.lens_thickness_mm
    if body.lens_center_mm is not UNSET:
        if body.lens_thickness_mm is not UNSET:
            raise ProfileError(
                "lens_center_mm",
                "cannot be combined with lens_thickness_mm",
                "one of the two",
            )
        return body.lens_center_mm
    for name, value in zip(("acd_mm", "lens_thickness_mm"), before, strict=True):
        if value is UNSET:
            raise ProfileError(
                name, "is missing", "a number, or lens_center_mm instead"
            )
    acd_mm, thickness_mm = before
    assert isinstance(acd_mm, float)
    assert isinstance(thickness_mm, float)
    return acd_mm + body.olsen_c * thickness_mm


def _implant(body: ImplantBody, center_mm: float) -> tuple[Surface, Surface]:
    given = body.anterior_radius_mm, body.posterior_radius_mm
    if body.residual_dpt is not UNSET:
        raise ProfileError(
            "implant.residual_dpt",
            "cannot be combined with power_dpt or radii",
            "one of the three",
        )
    if body.power_dpt is not UNSET:
        if given != (UNSET, UNSET):
            raise ProfileError(
                "implant.power_dpt", "cannot be combined with radii", "one of the two"
            )
        radius_mm = biconvex_radius_mm(
            body.power_dpt, index=body.index, thickness_mm=body.thickness_mm
        )
        radii = (radius_mm,) * 2, (-radius_mm,) * 2
    else:
        names = "anterior_radius_mm", "posterior_radius_mm"
        for name, value in zip(names, given, strict=True):
            if value is UNSET:
                raise ProfileError(
                    f"implant.{name}",
                    "is missing",
                    "both radii, or power_dpt instead",
                )
        radii = _radii_mm(given[0], names[0]), _radii_mm(given[1], names[1])
    axis = rotation_matrix(rotation_deg=0.0, tilt_deg=body.tilt_deg)[:, 2]
    center = np.array([*body.decentration_mm, center_mm])
    before, behind = (
        (center + side * body.thickness_mm / 2.0 * axis).tolist() for side in (-1, 1)
    )
    front = Surface(
        radius_mm=radii[0],
        conic_constant=body.anterior_conic_constant,
        z_mm=before[2],
        medium_after="implant",
        rotation_deg=body.rotation_deg,
        decentration_mm=(before[0], before[1]),
        tilt_deg=body.tilt_deg,
    )
    back = replace(
        front,
        radius_mm=radii[1],
        conic_constant=body.posterior_conic_constant,
        z_mm=behind[2],
        medium_after="vitreous",
        decentration_mm=(behind[0], behind[1]),
    )
    return front, back


def _radii_mm(value: Any, name: str) -> tuple[float, float]:
    return radii_mm(value, f"implant.{name}")


def biconvex_radius_mm(power_dpt: float, *, index: float, thickness_mm: float) -> float:
    """Return the radius of both surfaces of an implant of a labeled power.

    The thick-lens equation in an aqueous of `LABEL_INDEX`; negative for a biconcave
    implant, infinite for power 0.
    """
    if power_dpt == 0.0:
        return math.inf
    # P = 2 F - F² t / n of the surface power F = P / (1 + root), not 0 for any P
    root = math.sqrt(1.0 - thickness_mm / MM_PER_M / index * power_dpt)
    return MM_PER_M * (index - LABEL_INDEX) * (1.0 + root) / power_dpt


def _material(body: ImplantBody) -> Constant | AbbeNumber:
    if body.abbe_number is UNSET:
        return Constant(body.index)
    return AbbeNumber(body.index, body.abbe_number)


def _stop_z_mm(body: PseudophakicBody, front_mm: float) -> float:
    """Return the depth of the iris, in front of the implant."""
    nearest_mm = front_mm - SMALLEST_GAP_MM
    if body.iris_depth_mm is UNSET:
        return nearest_mm if body.acd_mm is UNSET else min(body.acd_mm, nearest_mm)
    if body.iris_depth_mm > nearest_mm:
        raise ProfileError(
            "iris_depth_mm",
            f"{body.iris_depth_mm:g} is not in front of the implant",
            f"up to {nearest_mm:.3g}",
        )
    return body.iris_depth_mm


def _retina(body: PseudophakicBody) -> Retina:
    shape = body.retina
    return Retina(
        radius_mm=body.axial_length_mm / 2.0 if shape is None else shape.radius_mm,
        conic_constant=0.0 if shape is None else shape.conic_constant,
        z_mm=body.axial_length_mm,
    )


def cornea_alone(eye: EyeSurfaces) -> EyeSurfaces:
    """Return the cornea of an eye, in front of a screen in its focus."""
    from estimator.optics.paraxial import system_matrix  # compiled: loads slowly

    cornea = eye.surfaces[:2]
    indices = media_indices(replace(eye, surfaces=cornea), REFERENCE_WAVELENGTH_NM)
    alone = replace(
        eye, surfaces=cornea, retina=Retina(math.inf, 0.0, 30.0), stop_z_mm=3.0
    )
    matrix = system_matrix(pack_eye(alone), indices, first=0, last=2)
    focus_mm = cornea[1].z_mm - indices[2] * matrix[0, 0] / matrix[1, 0]
    return replace(alone, retina=Retina(math.inf, 0.0, float(focus_mm)))


def _with_cornea(eye: EyeSurfaces, cornea_um: Numbers, radius_mm: float) -> EyeSurfaces:
    """Return the eye with offsets of the cornea that give it measured aberrations.

    The cornea is traced alone, onto a screen in its focus; offsets change until its
    higher orders are those measured.
    """
    from estimator.wavefront.aberrations import on_axis_zernike  # loads slowly

    cornea = eye.surfaces[:2]
    alone = cornea_alone(eye)
    indices = media_indices(replace(eye, surfaces=cornea), REFERENCE_WAVELENGTH_NM)
    offset_mm = np.zeros(N_TERMS)
    for _ in range(MAX_CORNEA_STEPS):
        anterior = replace(cornea[0], offset_mm=offset_mm, offset_radius_mm=radius_mm)
        alone = replace(alone, surfaces=(anterior, cornea[1]))
        found_um = on_axis_zernike(
            pack_eye(alone)[None], indices, zernike_radius_mm=radius_mm
        )[0][0]
        missing_um = np.zeros(N_TERMS)
        missing_um[HIGHER_ORDERS] = (cornea_um - found_um)[HIGHER_ORDERS]
        if not np.isfinite(found_um).all():
            raise ProfileError(
                "cornea_zernike_um",
                "light does not pass a cornea with these aberrations",
                "aberrations of a cornea",
            )
        if np.abs(missing_um).max() < CORNEA_TOLERANCE_UM:
            break
        # a thicker cornea delays light, so W falls where the surface moves outward
        offset_mm = offset_mm + missing_um * norms() / 1e3 / (indices[1] - indices[0])
    return replace(eye, surfaces=(anterior, *eye.surfaces[1:]))


def _check(eye: EyeSurfaces) -> None:
    from estimator.optics.raytrace import check_order  # compiled: loads slowly

    try:
        check_eye(eye)
        check_order(eye)
    except ValueError as error:
        raise ProfileError(
            "implant",
            f"{error} (surfaces 0 and 1 are the cornea, 2 and 3 the implant)",
            "surfaces in order",
        ) from None


IMPLANT_NOTE = Note(
    "traced_through_implant",
    "the eye is traced through its implant: wavefronts measured before surgery are not "
    "part of it",
)


def parse_given_eye(data: object) -> EyeProfile:
    """Parse a profile of a kind of `bodies.TRACED_KINDS`.

    Raises
    ------
    ProfileError
        A field is invalid, or the kind is unknown.
    """
    body = convert(data, given_bodies.ProfileBody)
    match body:
        case given_bodies.PseudophakicBody():
            return _pseudophakic(body)
        case given_bodies.PublishedBody():
            return _published(body)
        case given_bodies.SyntEyesBody():
            return _synteyes(body)
    assert isinstance(body, given_bodies.SurfacesBody)
    return _with_surfaces(body, "surfaces", surface_model(body))


def _published(body: given_bodies.PublishedBody) -> EyeProfile:
    _check_own_retina(body, "a published eye")
    return _with_surfaces(body, "published", published_eye(body.name).model)


def _synteyes(body: given_bodies.SyntEyesBody) -> EyeProfile:
    _check_own_retina(body, "an eye of SyntEyes")
    sample = None if body.sample is msgspec.UNSET else body.sample
    return with_drawn_eye(_with_surfaces(body, "synteyes", None), sample)


def _check_own_retina(body: bodies.CommonBody, whose: str) -> None:
    if body.retina is not None:
        raise ProfileError("retina", f"is part of {whose}", "null, or kind 'surfaces'")


def _pseudophakic(body: given_bodies.PseudophakicBody) -> EyeProfile:
    cornea_um = None
    if body.cornea_zernike_um is not msgspec.UNSET:
        cornea_um = coefficients_um(
            body.cornea_zernike_um,
            body.frame,
            path="",
            name="cornea_zernike_um",
            highest_order=DEFAULT_ORDER,
        )
    worn = body.correction
    if isinstance(worn, IntraocularBody) and (
        worn.sphere_dpt or worn.cylinder_dpt or worn.spherical_aberration_um
    ):
        raise ProfileError(
            "correction.sphere_dpt",
            "the power and aberration of a pseudophakic eye are those of its implant",
            "0 in sphere_dpt, cylinder_dpt and spherical_aberration_um: the correction "
            "only adds the steps or zones of its design",
        )
    notes: tuple[Note, ...] = (IMPLANT_NOTE,)
    implant = body.implant
    if implant.residual_dpt is not UNSET and implant.power_dpt is UNSET:
        power_dpt = solved_power_dpt(body, cornea_um)
        notes += (_power_note(implant.residual_dpt, power_dpt),)
        implant = structs.replace(implant, power_dpt=power_dpt, residual_dpt=UNSET)
        body = structs.replace(body, implant=implant)
    profile = _with_surfaces(body, "pseudophakic", pseudophakic_model(body, cornea_um))
    return replace(profile, notes=(*notes, *profile.notes))


def _power_note(residual_dpt: float, power_dpt: float) -> Note:
    return Note(
        "implant",
        f"implant of {power_dpt:.2f} dpt, solved such that a spherical equivalent of "
        f"{residual_dpt:+.2f} dpt remains at the cornea (555 nm, 4 mm)",
        power_dpt=power_dpt,
    )


def _with_surfaces(
    body: bodies.CommonBody, kind: str, surfaces: SurfaceModel | None
) -> EyeProfile:
    common = common_fields(body, kind)
    if common["surgery"] is not None:
        raise ProfileError(
            "correction.residual_sphere_dpt"
            if isinstance(body.correction, IntraocularBody)
            else "correction.kind",
            "describes surgery of an eye that is estimated from measurements",
            "kinds prescription, preset, zernike, zernike_set and eye",
        )
    if kind != "pseudophakic" and replaces_lens(common["correction"]):
        raise ProfileError(
            "correction.kind",
            "'iol' replaces the lens of an eye that is given by its surfaces",
            "spectacles or a contact lens; give the implant as surfaces",
        )
    return EyeProfile(
        kind=kind,
        pupil_diameter_mm=SURFACES_PUPIL_MM,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
        max_pupil_diameter_mm=math.inf,
        surfaces=surfaces,
        **common,
    )
