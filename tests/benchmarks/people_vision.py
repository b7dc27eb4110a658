"""Acuity under defocus and straylight of modeled eyes and of people."""

import time
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.acuity import best_correction_um, predict_acuity
from estimator.optics.prescription import zernike_from_power_vector
from estimator.optics.zernike import rescale_pupil
from estimator.profiles.parse import parse_profile
from tests import human_data
from tests.benchmarks.people_findings import Finding
from tests.benchmarks.people_optics import (
    LARGEST_PUPIL_MM,
    emmetropes,
    on_circle_um,
)

DEFOCUS_DPT = np.arange(0.5, 4.01, 0.5)
PUPILS_MM, NATURAL_PUPILS_MM = (2.0, 3.0, 4.0, 6.0), (3.0, 4.0)
PERSONS_PUPILS_MM = (4.0,)
"""Of drawn persons, who take as long as the typical eye, each."""

AGES_YEARS = (20, 40, 60, 70, 80)


def log_mar(axis_um: NDArray[np.float64], pupil_mm: float) -> NDArray[np.float64]:
    """Return acuities (9,) in focus and at `DEFOCUS_DPT` of an axis (28,) on 6 mm.

    Defocus counts from the best correction, as in people.
    """
    corrected_um = best_correction_um(
        rescale_pupil(axis_um, radius_ratio=pupil_mm / LARGEST_PUPIL_MM),
        zernike_radius_mm=pupil_mm / 2.0,
        wavelength_nm=555.0,
    )
    return np.array(
        [
            predict_acuity(
                corrected_um
                + zernike_from_power_vector(
                    -defocus, 0.0, 0.0, zernike_radius_mm=pupil_mm / 2.0
                ),
                zernike_radius_mm=pupil_mm / 2.0,
            ).log_mar
            for defocus in (0.0, *DEFOCUS_DPT)
        ]
    )


def acuity_findings(
    seeds: Sequence[int], pupils_mm: Sequence[float] = PUPILS_MM
) -> Iterator[Finding]:
    """Yield acuity in focus; and out of focus, mean and squared correlation by law."""
    for eyes, profiles in emmetropes(seeds).items():
        axes_um = [
            on_circle_um(profile, 0.0, pupil_diameter_mm=LARGEST_PUPIL_MM)[0]
            for profile in profiles
        ]
        for pupil_mm in pupils_mm if eyes == "typical eye" else PERSONS_PUPILS_MM:
            start_s = time.perf_counter()
            found = np.array([log_mar(axis_um, pupil_mm) for axis_um in axes_um])
            elapsed_ms = 1e3 * (time.perf_counter() - start_s) / found.size
            in_focus, blurred = found[:, 0], found[:, 1:]
            smith = human_data.smith_log_mar(pupil_mm, DEFOCUS_DPT)
            laws = {"Smith 1991": (smith, "logMAR", blurred)}
            if pupil_mm in NATURAL_PUPILS_MM:
                lost = human_data.blendowske_lost_log_mar(DEFOCUS_DPT)
                ours_lost = blurred - in_focus[:, None]
                laws["Blendowske 2015"] = lost, "logMAR lost", ours_lost
            yield Finding.of(
                *("acuity in focus", eyes, f"best corrected, {pupil_mm:g} mm"),
                *(in_focus, human_data.YOUNG_LOG_MAR, "logMAR", "Elliott 1995"),
                time_ms=elapsed_ms,
            )
            setting = f"{DEFOCUS_DPT[0]:g} to {DEFOCUS_DPT[-1]:g} dpt, {pupil_mm:g} mm"
            for source, (theirs, unit, ours) in laws.items():
                yield Finding.of(
                    *("acuity out of focus", eyes, f"mean, {setting}"),
                    *(ours.mean(axis=1), theirs.mean(), unit, source),
                    time_ms=elapsed_ms,
                )
                r = np.corrcoef(ours.mean(axis=0), theirs)[0, 1]
                yield Finding(
                    *("acuity out of focus", eyes, f"R², {setting}"),
                    *(float(r**2), 1.0, "R²", source, len(found), elapsed_ms),
                )


def straylight_findings() -> Iterator[Finding]:
    """Yield the straylight parameter by age, at two angles, and by cataract."""
    for age_years in AGES_YEARS:
        for angle_deg in human_data.DRIVERS_LOG_S:
            profile = _with_straylight({}, age_years=age_years)
            per_sr = float(profile.straylight.per_sr(angle_deg))
            yield Finding(
                *("straylight", "by age", f"{age_years} years, {angle_deg:g} deg"),
                float(np.log10(angle_deg**2 * per_sr)),
                float(human_data.drivers_log_s(angle_deg, age_years)),
                *("log s", "2422 drivers"),
            )
    for cataract, theirs in human_data.CATARACT_LOG_S.items():
        profile = _with_straylight({"cataract": cataract}, age_years=70)
        per_sr = float(profile.straylight.per_sr(7.0))
        yield Finding(
            *("straylight", "cataract", f"{cataract}, 7 deg"),
            *(float(np.log10(49.0 * per_sr)), theirs, "log s"),
            "five studies, 2017",
        )


def _with_straylight(straylight: dict, **more):
    body = {"kind": "prescription", "sphere_dpt": 0.0, "straylight": straylight}
    return parse_profile({**body, **more})
