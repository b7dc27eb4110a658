"""Parsing of eye profiles.

A profile is a JSON object (file or wire), an ``.abp`` file of the paper's framework, or
a CSV file of coefficients.  It is parsed to an `EyeProfile` in the eye frame (x to the
person's right, y up).
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import msgspec
import numpy as np

from estimator.corrections.worn_lens import TEAR_FILM_RATIO, replaces_lens
from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import PARAMETER_NAMES, EyeParameters
from estimator.note import Note
from estimator.optics import prescription as rx
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.vergence import (
    TYPICAL_ENTRANCE_PUPIL_MM,
    chromatic_refraction_dpt,
)
from estimator.optics.zernike import remove_central_tilt, rescale_pupil, summed_terms
from estimator.profiles import bodies
from estimator.profiles.coefficients import measured_um, order_notes
from estimator.profiles.common_fields import common_fields, prescription
from estimator.profiles.correction_bodies import ContactLensBody, CorrectionBody
from estimator.profiles.eye_profile import EYE_PUPIL_MM, EyeProfile, Measurement
from estimator.profiles.surgery import Surgery
from estimator.profiles.validation import KIND, convert
from estimator.wavefront.field_wavefronts import polynomial_in_mm, rays_cross

SAME_DEG = 0.5
"""Largest distance, along each axis, of two measurements of one direction."""

NOISE_DPT, NOISE_UM = 0.75, 0.3
"""Largest differences of two measurements of an eye: of M, J0 and J45, and RMS of the
higher orders.  95 % of repeats by one instrument differ by less than 0.5 dpt."""

FIRST_HIGHER = 6


def merged_repeats(
    measurements: list[Measurement],
) -> tuple[list[Measurement], tuple[Note, ...]]:
    """Return measurements without repeats, in their order, and a note on them.

    Repeats have the same direction, pupil and wavelength; their coefficients are
    averaged.  Measurements of one direction through other pupils or at other
    wavelengths are compared as well, but kept.

    Raises
    ------
    ProfileError
        Two measurements of one direction differ by more than `NOISE_DPT` or
        `NOISE_UM`.
    """
    groups: list[list[Measurement]] = []
    for number, measurement in enumerate(measurements):
        for other, earlier in enumerate(measurements[:number]):
            if _is_same_direction(measurement, earlier):
                _check_agreement(number, measurement, other, earlier)
        group = next((g for g in groups if _is_repeat(measurement, g[0])), None)
        if group is None:
            groups.append([measurement])
        else:
            group.append(measurement)
    repeated = [group for group in groups if len(group) > 1]
    merged = [
        replace(
            group[0],
            zernike_um=summed_terms(*(m.zernike_um for m in group)) / len(group),
        )
        if len(group) > 1
        else group[0]
        for group in groups
    ]
    if not repeated:
        return merged, ()
    count = sum(map(len, repeated))
    places = "one direction" if len(repeated) == 1 else f"{len(repeated)} directions"
    note = Note(
        "repeated_measurements",
        f"{count} measurements repeat {places}: their average is used",
        measurement_count=count,
        direction_count=len(repeated),
    )
    return merged, (note,)


def _is_same_direction(one: Measurement, other: Measurement) -> bool:
    distances_deg = abs(one.h_deg - other.h_deg), abs(one.v_deg - other.v_deg)
    return max(distances_deg) <= SAME_DEG


def _is_repeat(one: Measurement, other: Measurement) -> bool:
    return (
        _is_same_direction(one, other)
        and one.pupil_diameter_mm == other.pupil_diameter_mm
        and one.wavelength_nm == other.wavelength_nm
    )


def _check_agreement(
    number: int, one: Measurement, other_number: int, other: Measurement
) -> None:
    pupil_mm = min(one.pupil_diameter_mm, other.pupil_diameter_mm)
    waves_um = [
        rescale_pupil(m.zernike_um, radius_ratio=pupil_mm / m.pupil_diameter_mm)
        for m in (one, other)
    ]
    powers_dpt = np.stack(
        [rx.power_vectors_dpt(wave_um, pupil_mm / 2.0) for wave_um in waves_um]
    )
    wavelengths_nm = np.array([one.wavelength_nm, other.wavelength_nm])
    powers_dpt[:, 0] -= chromatic_refraction_dpt(wavelengths_nm)
    differences_dpt = np.abs(powers_dpt[0] - powers_dpt[1])
    difference_um = summed_terms(waves_um[0], -waves_um[1])
    higher_um = float(np.linalg.norm(difference_um[FIRST_HIGHER:]))
    if differences_dpt.max() <= NOISE_DPT and higher_um <= NOISE_UM:
        return
    name = ("M", "J0", "J45")[int(differences_dpt.argmax())]
    found = f"{name} differs by {differences_dpt.max():.3g} dpt"
    if differences_dpt.max() <= NOISE_DPT:
        found = f"its higher orders differ by {higher_um:.3g} um RMS"
    raise ProfileError(
        f"measurements.{number}.zernike_um",
        f"contradicts measurement {other_number} of the same direction, h "
        f"{other.h_deg:g} v {other.v_deg:g} deg: {found}",
        f"repeats that agree to {NOISE_DPT:g} dpt and {NOISE_UM:g} um RMS of higher "
        "orders, or another direction",
    )


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
    match body:
        case bodies.PresetBody():
            return _preset(body, cast(Mapping[str, Any], data))
        case bodies.PrescriptionBody():
            return _prescription(body)
        case bodies.ZernikeSetBody():
            return _zernike_set(body)
        case bodies.EyeBody():
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
            body.correction,
            Measurement(
                zernike_um, 2.0 * PRESCRIPTION_RADIUS_MM, REFERENCE_WAVELENGTH_NM
            ),
        ),
        max_pupil_diameter_mm=math.inf,
        add_dpt=body.add_dpt,
        higher_order=_higher_order(body, common["correction"], common["surgery"]),
        **common,
    )


def _higher_order(
    body: bodies.PrescriptionBody,
    correction: rx.Prescription | None,
    surgery: Surgery | None,
) -> str:
    """Return "typical" or "none"; "none" for an eye after lens surgery."""
    is_gone = replaces_lens(correction) and surgery is None
    if body.higher_order is msgspec.UNSET:
        return "none" if is_gone else "typical"
    if is_gone and body.higher_order != "none":
        raise ProfileError(
            "higher_order",
            "is 'typical', which describes eyes with their natural lens",
            "none, with an intraocular lens",
        )
    return body.higher_order


def _behind_tear_film(
    measurement: Measurement, correction: CorrectionBody | None
) -> Measurement:
    """Return a measurement behind the tear film of a rigid lens, if one is worn.

    All terms but C(2,0), which the power of the lens corrects, are smaller; tilt as
    well, so that the slope at the center stays zero.
    """
    if not (isinstance(correction, ContactLensBody) and correction.rigid):
        return measurement
    zernike_um = measurement.zernike_um * TEAR_FILM_RATIO
    zernike_um[rx.C20] = measurement.zernike_um[rx.C20]
    return replace(measurement, zernike_um=zernike_um)


def _primary(correction: CorrectionBody | None, *given: Measurement) -> dict[str, Any]:
    first, *others = (_behind_tear_film(m, correction) for m in given)
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
    frame = "eye" if body.frame is msgspec.UNSET else body.frame
    zernike_um, pupil_mm = measured_um(body, frame, path="")
    common = common_fields(body, "zernike")
    common["notes"] += order_notes(body, body.frame, zernike_um, pupil_mm)
    return EyeProfile(
        kind="zernike",
        **_primary(
            body.correction, Measurement(zernike_um, pupil_mm, body.wavelength_nm)
        ),
        max_pupil_diameter_mm=pupil_mm,
        **common,
    )


def _zernike_set(body: bodies.ZernikeSetBody) -> EyeProfile:
    """Return the profile of a set; its widest on-axis measurement leads."""
    measurements: list[Measurement] = []
    notes: tuple[Note, ...] = ()
    for number, entry in enumerate(body.measurements):
        frame = body.frame if entry.frame is msgspec.UNSET else entry.frame
        stated = "eye" if frame is msgspec.UNSET else frame
        zernike_um, pupil_mm = measured_um(
            entry, stated, path=f"measurements.{number}."
        )
        measurements.append(
            Measurement(
                zernike_um, pupil_mm, entry.wavelength_nm, entry.h_deg, entry.v_deg
            )
        )
        if measurements[-1].is_on_axis:  # a set has many others
            notes += order_notes(entry, frame, zernike_um, pupil_mm)
    measurements, repeats = merged_repeats(measurements)
    on_axis = [m for m in measurements if m.is_on_axis]
    if not on_axis:
        raise ProfileError(
            "measurements", "none is on-axis", bodies.MEASUREMENTS_ALLOWED
        )
    first = max(on_axis, key=lambda m: m.pupil_diameter_mm)
    others = [m for m in measurements if m is not first]
    common = common_fields(body, "zernike set")
    common["notes"] = (*common["notes"], *notes, *repeats)
    return EyeProfile(
        kind="zernike_set",
        **_primary(body.correction, first, *others),
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
