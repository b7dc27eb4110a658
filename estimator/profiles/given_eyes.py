"""Profiles that give the eye by its surfaces, or fail to name their kind."""

import math
from dataclasses import replace

import msgspec

from estimator.corrections.worn_lens import replaces_lens
from estimator.eye.checked_fields import ProfileError
from estimator.eye.surface_model import SurfaceModel
from estimator.note import Note
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import DEFAULT_ORDER
from estimator.profiles import bodies, given_bodies
from estimator.profiles.common_fields import coefficients_um, common_fields
from estimator.profiles.correction_bodies import IntraocularBody
from estimator.profiles.eye_profile import SURFACES_PUPIL_MM, EyeProfile
from estimator.profiles.pseudophakic import pseudophakic_model
from estimator.profiles.published import published_eye
from estimator.profiles.surfaces import surface_model
from estimator.profiles.validation import convert

IMPLANT_NOTE = Note(
    "traced_through_implant",
    "the eye is traced through its implant: wavefronts measured before surgery are not "
    "part of it",
)


def parse_given_eye(data: object) -> EyeProfile:
    """Parse a profile of kind ``surfaces``, ``pseudophakic`` or ``published``.

    Raises
    ------
    ProfileError
        A field is invalid, or the kind is unknown.
    """
    body = convert(data, given_bodies.ProfileBody)
    if isinstance(body, given_bodies.PseudophakicBody):
        return _pseudophakic(body)
    if isinstance(body, given_bodies.PublishedBody):
        return _published(body)
    assert isinstance(body, given_bodies.SurfacesBody)
    return _with_surfaces(body, "surfaces", surface_model(body))


def _published(body: given_bodies.PublishedBody) -> EyeProfile:
    if body.retina is not None:
        raise ProfileError(
            "retina", "is part of a published eye", "null, or kind 'surfaces'"
        )
    return _with_surfaces(body, "published", published_eye(body.name).model)


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
    profile = _with_surfaces(body, "pseudophakic", pseudophakic_model(body, cornea_um))
    return replace(profile, notes=(IMPLANT_NOTE, *profile.notes))


def _with_surfaces(
    body: bodies.CommonBody, kind: str, surfaces: SurfaceModel
) -> EyeProfile:
    common = common_fields(body, kind)
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
