"""Modulation, higher orders and peripheral refraction of modeled and measured eyes.

All eyes have the least-squares focus; no focus is optimized for modulation.  Off the
axis, values are means of both sides of the field, and the pupil is the circle about the
chief ray on which the wavefronts are given.
"""

import math
import time
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.acuity.transfer import MEAN_EYE_NM, mean_eye_transfer
from estimator.field.field_table import field_table
from estimator.optics.prescription import power_vectors_dpt
from estimator.optics.zernike import N_TERMS, index_from_nm, rescale_pupil
from estimator.periphery.population import CIRCLE_MM, TERMS, MeasuredEyes
from estimator.profiles.parse import EyeProfile, parse_profile
from tests import human_data
from tests.benchmarks.people_findings import Finding
from tests.benchmarks.people_modulation import (
    AT_CPD,
    modulation,
    refracted,
    residual_refraction_um,
    with_halo,
)

HIGHER_ORDERS = slice(6, N_TERMS)
SIDES = (-1.0, 1.0)
RESIDUAL_DRAWS = 32
WATSON_PUPILS_MM = (2.0, 3.0, 4.0, 5.0, 6.0)
NEAR_FOCI_DPT, NEAR_PUPILS_MM, NEAR_ANGLE_DEG = (
    (0.0, 2.0, 4.0, 6.0),
    (2.0, 4.0, 6.0),
    30,
)
SPHERES_DPT = (0.0, -2.0, -4.0, -6.0)
MATHUR_ANGLE_DEG = 20.0
SPHERICAL_FOCI_DPT = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
SPHERICAL_PUPILS_MM = (5.0, 6.0)
LARGEST_PUPIL_MM = 6.0
MERIDIAN, MEAN_OF_CPD = "Jaeken & Artal 2012", "mean of 1 to 30 cpd"


def emmetrope(sphere_dpt: float = 0.0, **more) -> EyeProfile:
    """Return the profile of a prescription."""
    return parse_profile({"kind": "prescription", "sphere_dpt": sphere_dpt, **more})


def emmetropes(
    seeds: Sequence[int], sphere_dpt: float = 0.0
) -> dict[str, list[EyeProfile]]:
    """Return the typical eye of a prescription, and drawn persons, if any."""
    eyes = {"typical eye": [emmetrope(sphere_dpt)]}
    if seeds:
        eyes["drawn persons"] = [emmetrope(sphere_dpt, sample=seed) for seed in seeds]
    return eyes


def on_circle_um(
    profile: EyeProfile,
    h_deg,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float | None = None,
) -> NDArray[np.float64]:
    """Return wavefronts (n, 28) on the circle of the pupil, at the cornea."""
    table = field_table(
        profile,
        h_deg=h_deg,
        v_deg=0.0,
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=MEAN_EYE_NM,
        focus_dpt=focus_dpt,
    )
    return rescale_pupil(
        table.zernike_um,
        radius_ratio=pupil_diameter_mm / 2.0 / table.zernike_radius_mm,
    )


Curves = dict[tuple[str, float], NDArray[np.float64]]
"""Modulations (n, 30) of eyes by their name and angle, for the picture."""


def all_terms(terms_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients (..., 28) of `TERMS` (..., 12)."""
    zernike_um = np.zeros((*terms_um.shape[:-1], N_TERMS))
    zernike_um[..., list(TERMS)] = terms_um
    return zernike_um


def known_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means (n, 30) over directions (n, k, 30); NaN where none is known."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=1)
    mean: NDArray[np.float64] = np.divide(
        *(total, known.sum(axis=1)),
        out=np.full(total.shape, np.nan),
        where=known.any(axis=1),
    )
    return mean


# ----- modulation transfer


def modulation_findings(
    seeds: Sequence[int], people: MeasuredEyes, curves: Curves
) -> Iterator[Finding]:
    """Modulation of the typical eye, of drawn persons and of measured people."""
    pupil_mm, wavelength_nm = human_data.NAVARRO_PUPIL_MM, human_data.NAVARRO_NM
    angles_deg = [float(angle) for angle in human_data.NAVARRO]
    h_deg = np.array([side * angle for angle in angles_deg for side in SIDES])
    kinds: dict[str, tuple[NDArray, float]] = {}
    for eyes, profiles in emmetropes(seeds).items():
        start_s = time.perf_counter()
        fields_um = [
            on_circle_um(
                profile,
                h_deg,
                pupil_diameter_mm=pupil_mm,
                focus_dpt=human_data.NAVARRO_FOCUS_DPT,
            )
            for profile in profiles
        ]
        elapsed_ms = 1e3 * (time.perf_counter() - start_s) / len(profiles)
        kinds[eyes] = np.array(fields_um), elapsed_ms
    at = [int(np.flatnonzero(people.h_deg == h)[0]) for h in h_deg]
    kinds["people's own wavefronts"] = all_terms(people.zernike_um[:, at]), 0.0
    for eyes, (fields_um, elapsed_ms) in kinds.items():
        corrected_um = refracted(fields_um, fields_um[:, 0], "at the fovea")
        plain, blurred = _and_residual(corrected_um, pupil_mm, wavelength_nm)
        for k, angle in enumerate(angles_deg):
            both = slice(2 * k, 2 * k + 2)
            of_eyes = known_mean(plain[:, both])
            of_eyes = of_eyes[np.isfinite(of_eyes[:, 0])]
            curves[eyes, angle] = of_eyes
            seen = known_mean(blurred[:, both])
            theirs = human_data.navarro_modulation(AT_CPD, int(angle)).mean()
            yield Finding.of(
                *("modulation", eyes, f"{angle:g} deg, {pupil_mm:g} mm"),
                *(of_eyes.mean(axis=1), theirs, MEAN_OF_CPD, "Navarro 1993"),
                time_ms=elapsed_ms,
                with_residual=float(np.nanmean(seen)),
                with_halo=float(np.nanmean(with_halo(seen))),
            )
    yield from _foveal_findings(seeds, people)


def _and_residual(
    zernike_um: NDArray, pupil_mm: float, wavelength_nm: float
) -> tuple[NDArray, NDArray]:
    """Return modulations (n, k, 30), and (m, k, 30) with residual refractions."""
    optics = {"pupil_diameter_mm": pupil_mm, "wavelength_nm": wavelength_nm}
    plain = modulation(zernike_um, **optics)
    copies = math.ceil(RESIDUAL_DRAWS / len(zernike_um))
    zernike_um = np.repeat(zernike_um, copies, axis=0)
    residual_um = residual_refraction_um(len(zernike_um), pupil_mm)
    return plain, modulation(zernike_um + residual_um[:, None], **optics)


def _foveal_findings(seeds: Sequence[int], people: MeasuredEyes) -> Iterator[Finding]:
    """Modulation at the fovea, refracted, beside two more studies."""
    studies: list[tuple[str, float, float, NDArray, bool]] = [
        (
            *("Williams 1994", human_data.WILLIAMS_PUPIL_MM, human_data.WILLIAMS_NM),
            *(human_data.williams_modulation(AT_CPD), True),
        )
    ]
    for pupil_mm in WATSON_PUPILS_MM:
        theirs = mean_eye_transfer(AT_CPD, pupil_diameter_mm=pupil_mm)
        studies.append(("Watson 2013", pupil_mm, MEAN_EYE_NM, theirs, False))
    axes_um = {
        eyes: np.array(
            [
                on_circle_um(profile, 0.0, pupil_diameter_mm=LARGEST_PUPIL_MM)[0]
                for profile in profiles
            ]
        )
        for eyes, profiles in emmetropes(seeds).items()
    }
    axes_um["people's own wavefronts"] = all_terms(people.axis_um)
    for source, pupil_mm, wavelength_nm, theirs, halo in studies:
        for eyes, axis_um in axes_um.items():
            is_measured = eyes.startswith("people")
            of_mm = 2.0 * CIRCLE_MM if is_measured else LARGEST_PUPIL_MM
            if pupil_mm > of_mm:
                continue
            scaled_um = rescale_pupil(axis_um, radius_ratio=pupil_mm / of_mm)
            corrected_um = refracted(scaled_um[:, None], scaled_um, "at each angle")
            plain, blurred = _and_residual(corrected_um, pupil_mm, wavelength_nm)
            yield Finding.of(
                *("modulation", eyes, f"fovea, {pupil_mm:g} mm"),
                *(plain.mean(axis=(1, 2)), theirs.mean(), MEAN_OF_CPD, source),
                with_residual=float(blurred.mean()),
                with_halo=float(with_halo(blurred).mean()) if halo else math.nan,
            )


def own_field_findings(
    own_um: NDArray[np.float64],
    predicted_um: dict[str, NDArray[np.float64]],
    axis_um: NDArray[np.float64],
    angles_deg: Sequence[float],
    times_ms: dict[str, float],
    curves: Curves,
    refractions: Sequence[str],
) -> Iterator[Finding]:
    """Modulation of predicted fields less that of the same people's own.

    Parameters
    ----------
    own_um : (n, k, 12)
        Measured wavefronts; nan where a direction was not measured.
    predicted_um : dict of (m, n, k, 12)
        Predictions of each method, m for each person.
    axis_um : (n, 12)
    angles_deg : (k,)
    """
    optics = {
        "pupil_diameter_mm": 2.0 * CIRCLE_MM,
        "wavelength_nm": MEAN_EYE_NM,
    }
    axis_um = all_terms(axis_um)
    for refraction in refractions:

        def seen(terms_um: NDArray, refraction: str = refraction) -> NDArray:
            corrected_um = refracted(all_terms(terms_um), axis_um, refraction)
            return modulation(corrected_um, **optics)

        own = seen(own_um)
        is_foveal = refraction == "at the fovea"
        for method, draws_um in predicted_um.items():
            draws = np.array([seen(terms_um) for terms_um in draws_um])
            draws = np.where(np.isfinite(own), draws, np.nan)
            for angle in np.unique(np.abs(angles_deg)).tolist():
                at = np.abs(angles_deg) == angle
                theirs = known_mean(own[:, at])
                ours = np.array([known_mean(drawn[:, at]) for drawn in draws])
                known = np.isfinite(theirs[:, 0])
                theirs, ours = theirs[known], ours[:, known]
                ours = ours.reshape(-1, AT_CPD.size)
                if is_foveal:
                    curves[method, angle] = ours
                    curves["their own fields", angle] = theirs
                yield Finding.of(
                    *("modulation, same people", method),
                    f"{angle:g} deg, refracted {refraction}",
                    *(ours.mean(axis=1), theirs.mean(), MEAN_OF_CPD, MERIDIAN),
                    count=int(known.sum()),
                    time_ms=times_ms[method],
                )


# ----- higher orders


def higher_order_findings(
    seeds: Sequence[int], people: MeasuredEyes
) -> Iterator[Finding]:
    """RMS of orders 3 to 6 on the axis; orders 3 and 4 of measured people."""
    kinds: dict[str, Sequence[EyeProfile] | None] = {
        **emmetropes(seeds),
        "people's own wavefronts": None,
    }

    def waves_um(profiles, pupil_mm: float) -> NDArray[np.float64]:
        if profiles is None:
            ratio = pupil_mm / (2.0 * CIRCLE_MM)
            return rescale_pupil(all_terms(people.axis_um), radius_ratio=ratio)
        at = {"pupil_diameter_mm": pupil_mm}
        return np.array([on_circle_um(p, 0.0, **at)[0] for p in profiles])

    for eyes, profiles in kinds.items():
        for pupil_mm, theirs_um in human_data.SALMON_RMS_UM.items():
            if profiles is None and pupil_mm > 2.0 * CIRCLE_MM:
                continue
            start_s = time.perf_counter()
            higher_um = waves_um(profiles, pupil_mm)[:, HIGHER_ORDERS]
            found_um = np.linalg.norm(higher_um, axis=1)
            elapsed_ms = 1e3 * (time.perf_counter() - start_s) / len(found_um)
            yield Finding.of(
                *("higher-order RMS", eyes, f"mean, {pupil_mm:g} mm"),
                *(found_um, theirs_um, "um", "Salmon & van de Pol 2006"),
                time_ms=elapsed_ms,
            )
            if len(found_um) > 1:
                below = float(np.mean(found_um < 2.0 * theirs_um))
                yield Finding(
                    *("higher-order RMS", eyes),
                    f"below twice theirs, {pupil_mm:g} mm",
                    *(below, human_data.SALMON_TWICE_RATIO, "ratio, at least"),
                    *("Salmon & van de Pol 2006", len(found_um), elapsed_ms),
                )


# ----- peripheral refraction


def near_findings(seeds: Sequence[int]) -> Iterator[Finding]:
    """Change of the periphery, relative to the axis, by accommodation."""
    sides_deg = np.array([-NEAR_ANGLE_DEG, NEAR_ANGLE_DEG], dtype=np.float64)
    far, *near = NEAR_FOCI_DPT
    for eyes, profiles in emmetropes(seeds).items():
        for pupil_mm in NEAR_PUPILS_MM:
            relative_dpt = {
                focus: np.array(
                    [_relative_dpt(p, sides_deg, pupil_mm, focus) for p in profiles]
                ).mean(axis=1)
                for focus in NEAR_FOCI_DPT
            }
            for focus in near:
                change_dpt = relative_dpt[focus] - relative_dpt[far]
                for source, ratio in human_data.NEAR_PERIPHERY_RATIO.items():
                    yield Finding.of(
                        *("near periphery, M", eyes, f"{focus:g} dpt, {pupil_mm:g} mm"),
                        *(change_dpt, ratio * focus, "dpt", source),
                    )
        yield from _mathur(eyes, profiles)
        yield from _spherical_rows(eyes, profiles)


def _relative_dpt(
    profile: EyeProfile, h_deg: NDArray, pupil_mm: float, focus_dpt: float
) -> NDArray[np.float64]:
    """Return M (n,) less that of the axis."""
    zernike_um = on_circle_um(
        profile, [0.0, *h_deg], pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt
    )
    power_dpt = power_vectors_dpt(zernike_um, pupil_mm / 2.0)[:, 0]
    return power_dpt[1:] - power_dpt[0]


def _mathur(eyes: str, profiles: Sequence[EyeProfile]) -> Iterator[Finding]:
    """Yield the change of C(4,0) by accommodation, on the axis and off it."""
    far_dpt, near_dpt = human_data.MATHUR_FOCUS_DPT
    pupil_mm = human_data.MATHUR_PUPIL_MM
    h_deg = np.array([0.0, -MATHUR_ANGLE_DEG, MATHUR_ANGLE_DEG])
    c40 = index_from_nm(4, 0)
    change_um = np.array(
        [
            on_circle_um(p, h_deg, pupil_diameter_mm=pupil_mm, focus_dpt=near_dpt)
            - on_circle_um(p, h_deg, pupil_diameter_mm=pupil_mm, focus_dpt=far_dpt)
            for p in profiles
        ]
    )[..., c40]
    for angle, values_um in (
        (0.0, change_um[:, 0]),
        (MATHUR_ANGLE_DEG, change_um[:, 1:].mean(axis=1)),
    ):
        yield Finding.of(
            *("near periphery, C40", eyes),
            f"{far_dpt:g} to {near_dpt:g} dpt, {angle:g} deg, {pupil_mm:g} mm",
            *(values_um, human_data.MATHUR_C40_UM, "um", "Mathur 2009"),
        )


def _spherical_rows(eyes: str, profiles: Sequence[EyeProfile]) -> Iterator[Finding]:
    """Yield the change of C(4,0) on the axis from the relaxed eye, by focus."""
    c40, far = index_from_nm(4, 0), SPHERICAL_FOCI_DPT[0]
    for pupil_mm in SPHERICAL_PUPILS_MM:
        at_um = np.array(
            [
                [
                    on_circle_um(p, [0.0], pupil_diameter_mm=pupil_mm, focus_dpt=focus)
                    for focus in SPHERICAL_FOCI_DPT
                ]
                for p in profiles
            ]
        )[:, :, 0, c40]
        change_um = at_um - at_um[:, :1]
        slope_um = float(human_data.mathur_slope_um(pupil_mm))
        for k, focus in enumerate(SPHERICAL_FOCI_DPT[1:], start=1):
            yield Finding.of(
                *("accommodation, C40", eyes),
                f"{far:g} to {focus:g} dpt, {pupil_mm:g} mm",
                *(change_um[:, k], slope_um * (focus - far), "um"),
                "Mathur 2009, scaled by r^4",
            )
        taken = human_data.taken_ratio(
            change_um[:, -1] / (SPHERICAL_FOCI_DPT[-1] - far), pupil_mm
        )
        yield Finding.of(
            *("accommodation, response taken", eyes, f"0 to 6 dpt, {pupil_mm:g} mm"),
            *(taken, human_data.LOPEZ_GIL_RATIO, "ratio"),
            "López-Gil & Fernández-Sánchez 2010, natural pupils",
        )


def refraction_findings(
    seeds: Sequence[int], people: MeasuredEyes
) -> Iterator[Finding]:
    """Relative peripheral M by refraction, beside a regression on measured eyes."""
    places = [
        int(np.flatnonzero(people.h_deg == side * NEAR_ANGLE_DEG)[0]) for side in SIDES
    ]
    at_um = all_terms(people.zernike_um[:, places])
    axis_dpt = power_vectors_dpt(all_terms(people.axis_um), CIRCLE_MM)[:, 0]
    relative_dpt = power_vectors_dpt(at_um, CIRCLE_MM)[..., 0] - axis_dpt[:, None]
    for k, side in enumerate(SIDES):
        known = np.isfinite(relative_dpt[:, k])
        line = np.polyfit(axis_dpt[known], relative_dpt[known, k], 1)
        for sphere_dpt in SPHERES_DPT:
            for eyes, profiles in emmetropes(seeds, sphere_dpt).items():
                found_dpt = np.array(
                    [
                        _relative_dpt(
                            profile,
                            np.array([side * NEAR_ANGLE_DEG]),
                            2.0 * CIRCLE_MM,
                            -60.0,
                        )[0]
                        for profile in profiles
                    ]
                )
                yield Finding.of(
                    *("relative periphery, M", eyes),
                    f"{sphere_dpt:g} dpt, {side * NEAR_ANGLE_DEG:+.0f} deg, 4 mm",
                    *(found_dpt, np.polyval(line, sphere_dpt), "dpt", MERIDIAN),
                )
