"""Parsing of eye profiles.

A profile is a JSON object (file or wire), an ``.abp`` file of the paper's framework, or
a CSV file of coefficients.  It is parsed to an `EyeProfile` in the eye frame (x to the
person's right, y up).
"""

import math
from collections.abc import Mapping
from typing import Any, cast

import msgspec

from estimator.corrections.worn_lens import replaces_lens
from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import PARAMETER_NAMES, EyeParameters
from estimator.optics import prescription as rx
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.vergence import TYPICAL_ENTRANCE_PUPIL_MM
from estimator.optics.zernike import remove_central_tilt
from estimator.profiles import bodies
from estimator.profiles.common_fields import coefficients_um, common_fields
from estimator.profiles.correction import prescription
from estimator.profiles.eye_profile import EYE_PUPIL_MM, EyeProfile, Measurement
from estimator.profiles.repeats import merged_repeats
from estimator.profiles.validation import KIND, convert
from estimator.wavefront.field_wavefronts import polynomial_in_mm, rays_cross

__all__ = [
    "EyeProfile",
    "Measurement",
    "ProfileError",
    "parse_profile",
    "preset_names",
]

PRESCRIPTION_RADIUS_MM = 3.0
"""Circle on which a prescription is represented; it is exact on every other."""


def parse_profile(data: object) -> EyeProfile:
    """Parse one profile object.

    Raises
    ------
    ProfileError
        A field is invalid; the error names it, its value and the accepted values.
    """
    kind = data.get(KIND) if isinstance(data, Mapping) else None
    if kind not in bodies.MEASURED_KINDS:  # loads compiled code
        from estimator.profiles.given_eyes import parse_given_eye

        return parse_given_eye(data)
    body = convert(data, bodies.MeasuredBody)
    if isinstance(body, bodies.PresetBody):
        return _preset(body, cast(Mapping[str, Any], data))
    if isinstance(body, bodies.PrescriptionBody):
        return _prescription(body)
    if isinstance(body, bodies.ZernikeSetBody):
        return _zernike_set(body)
    if isinstance(body, bodies.EyeBody):
        return _eye(body)
    return _zernike(body)


def preset_names() -> tuple[str, ...]:
    """Return the names accepted by ``{"kind": "preset", "name": ...}``."""
    return tuple(bodies.PRESETS)


def published_names() -> tuple[str, ...]:
    """Return the names accepted by ``{"kind": "published", "name": ...}``."""
    return bodies.PUBLISHED_NAMES


def _preset(body: bodies.PresetBody, data: Mapping[str, Any]) -> EyeProfile:
    own = {name: value for name, value in data.items() if name != "kind"}
    return _zernike(convert({**bodies.PRESETS[body.name], **own}, bodies.ZernikeBody))


def _prescription(body: bodies.PrescriptionBody) -> EyeProfile:
    zernike_um = rx.zernike_from_power_vector(
        *rx.power_vector(prescription(body, path="")),
        zernike_radius_mm=PRESCRIPTION_RADIUS_MM,
    )
    common = common_fields(body, "prescription")
    return EyeProfile(
        kind="prescription",
        **_primary(
            Measurement(
                zernike_um, 2.0 * PRESCRIPTION_RADIUS_MM, REFERENCE_WAVELENGTH_NM
            )
        ),
        max_pupil_diameter_mm=math.inf,
        add_dpt=body.add_dpt,
        higher_order=_higher_order(body, common["correction"]),
        **common,
    )


def _higher_order(
    body: bodies.PrescriptionBody, correction: rx.Prescription | None
) -> str:
    """Return "typical" or "none"; "none" with an intraocular lens."""
    is_gone = replaces_lens(correction)
    if body.higher_order is msgspec.UNSET:
        return "none" if is_gone else "typical"
    if is_gone and body.higher_order != "none":
        raise ProfileError(
            "higher_order",
            "is 'typical', which describes eyes with their natural lens",
            "none, with an intraocular lens",
        )
    return body.higher_order


def _primary(first: Measurement, *others: Measurement) -> dict[str, Any]:
    radius_mm = first.pupil_diameter_mm / 2.0
    at_cornea_um = polynomial_in_mm(remove_central_tilt(first.zernike_um), radius_mm)
    depth_mm = TYPICAL_ENTRANCE_PUPIL_MM
    if rays_cross(at_cornea_um, depth_mm=depth_mm, radius_mm=radius_mm):
        raise ProfileError(
            "zernike_um",
            "its rays cross between cornea and pupil",
            f"coefficients of an eye, in um, on a circle of {2.0 * radius_mm:g} mm",
        )
    return {
        "pupil_diameter_mm": first.pupil_diameter_mm,
        "wavelength_nm": first.wavelength_nm,
        "measurements": (first, *others),
    }


def _zernike(body: bodies.ZernikeBody) -> EyeProfile:
    measurement = Measurement(
        coefficients_um(body.zernike_um, body.frame, path=""),
        body.pupil_diameter_mm,
        body.wavelength_nm,
    )
    return EyeProfile(
        kind="zernike",
        **_primary(measurement),
        max_pupil_diameter_mm=measurement.pupil_diameter_mm,
        **common_fields(body, "zernike"),
    )


def _zernike_set(body: bodies.ZernikeSetBody) -> EyeProfile:
    """Return the profile of a set; its widest on-axis measurement leads."""
    frame = "eye" if body.frame is msgspec.UNSET else body.frame
    measurements = [
        Measurement(
            coefficients_um(
                entry.zernike_um,
                frame if entry.frame is msgspec.UNSET else entry.frame,
                path=f"measurements.{number}.",
            ),
            entry.pupil_diameter_mm,
            entry.wavelength_nm,
            entry.h_deg,
            entry.v_deg,
        )
        for number, entry in enumerate(body.measurements)
    ]
    measurements, notes = merged_repeats(measurements)
    on_axis = [m for m in measurements if m.is_on_axis]
    if not on_axis:
        raise ProfileError(
            "measurements", "none is on-axis", bodies.MEASUREMENTS_ALLOWED
        )
    first = max(on_axis, key=lambda m: m.pupil_diameter_mm)
    others = [m for m in measurements if m is not first]
    common = common_fields(body, "zernike set")
    common["notes"] = (*common["notes"], *notes)
    return EyeProfile(
        kind="zernike_set",
        **_primary(first, *others),
        max_pupil_diameter_mm=first.pupil_diameter_mm,
        **common,
    )


def _eye(body: bodies.EyeBody) -> EyeProfile:
    vector = [getattr(body.parameters, name) for name in PARAMETER_NAMES]
    return EyeProfile(
        kind="eye",
        pupil_diameter_mm=EYE_PUPIL_MM,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
        max_pupil_diameter_mm=EYE_PUPIL_MM,
        eye=EyeParameters.from_vector(vector),
        **common_fields(body, "eye"),
    )
