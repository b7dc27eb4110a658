"""Repeated measurements of one direction: averaged, or refused if they contradict."""

from dataclasses import replace

import numpy as np

from estimator.eye.checked_fields import ProfileError
from estimator.note import Note
from estimator.optics import prescription as rx
from estimator.optics.vergence import chromatic_refraction_dpt
from estimator.optics.zernike import rescale_pupil, summed_terms
from estimator.profiles.eye_profile import Measurement

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
