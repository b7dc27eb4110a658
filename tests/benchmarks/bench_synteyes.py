"""Eyes drawn from SyntEyes, compared with its data, visisipy and measured people.

- ``biometry``: means, deviations and correlations of 1,000 drawn eyes less those of
  200,000 eyes that visisipy draws, in units of their sampling error; the time is that
  of parsing a profile, with its eye.
- ``visisipy``: where rays along the axis, up to 2 mm from it, land on the retina of the
  same eye, less where optiland lands them; with the same cornea to the sixth order, and
  with the seventh and eighth that are left out here.
- ``refraction``: M through 5 mm at the cornea less that of 330 measured eyes of the
  same laboratory (`tests.human_data`); once with the retina 0.2 mm before the axial
  length, as in visisipy.
- ``higher orders``: mean terms through 5 mm less those of these eyes, and mean RMS less
  that of 2,560 eyes by pupil; with and without the higher orders of the lens.
"""

import json
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.optics.raytrace import trace_rays
from estimator.optics.surfaces import EyeSurfaces, media_indices, pack_eye
from estimator.optics.zernike import flip_horizontal, index_from_nm
from estimator.profiles.parse import parse_profile
from estimator.profiles.synteyes import (
    Biometry,
    biometry_of,
    drawn_biometry,
    eye_of_biometry,
)
from estimator.wavefront.aberrations import on_axis_zernike
from tests import human_data
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of

FROZEN = Path(__file__).parents[1] / "data" / "visisipy_synteyes.json"
NAMES = (
    *("aqueous_depth_mm", "lens_thickness_mm", "axial_length_mm"),
    *("lens_anterior_radius_mm", "lens_posterior_radius_mm", "lens_power_dpt"),
    "keratometry_dpt",
)
N_DRAWN, QUICK_DRAWN = 1000, 50
row = partial(row_of, "synteyes")
MINUTES = 1
WAVELENGTH_NM = 555.0
RETINA_MM = 0.2
LENS = 2
DPT_PER_C20 = -4.0 * np.sqrt(3.0)


def traced_um(eyes: list[EyeSurfaces], pupil_mm: float) -> NDArray[np.float64]:
    """Return wavefronts (n, 28) at the cornea, as an examiner sees right eyes."""
    found_um, _ = on_axis_zernike(
        np.stack([pack_eye(eye) for eye in eyes]),
        np.stack([media_indices(eye, WAVELENGTH_NM) for eye in eyes]),
        zernike_radius_mm=pupil_mm / 2.0,
    )
    return flip_horizontal(found_um)


def smooth_lens(eye: EyeSurfaces) -> EyeSurfaces:
    """Return an eye whose lens has no higher orders of its own."""
    surfaces = list(eye.surfaces)
    surfaces[LENS] = replace(surfaces[LENS], offset_mm=None)
    return replace(eye, surfaces=tuple(surfaces))


def moved_retina(eye: EyeSurfaces) -> EyeSurfaces:
    """Return an eye with its retina where visisipy has it."""
    retina = replace(eye.retina, z_mm=eye.retina.z_mm - RETINA_MM)
    return replace(eye, retina=retina)


def biometry_rows(
    drawn: list[Biometry], times_ms: list[float], expected: dict[str, Any]
) -> list[Row]:
    """Return a row for each mean and deviation, and one for all correlations."""
    rows, n = [], len(drawn)
    reference = expected["about"]
    found = np.array([[getattr(b, name) for b in drawn] for name in NAMES])
    for name, values, mean, deviation in zip(
        NAMES, found, expected["mean"], expected["deviation"], strict=True
    ):
        told = f"{values.mean():.3f} ± {values.std():.3f}, {mean:.3f} ± {deviation:.3f}"
        for what, error, size in (
            ("mean", values.mean() - mean, deviation / n**0.5),
            ("deviation", values.std() - deviation, deviation / (2.0 * n) ** 0.5),
        ):
            rows.append(
                row(
                    *("biometry", name, f"{what}: {told}", times_ms),
                    *("sampling errors", error / size, reference),
                )
            )
    ratio = np.array(expected["correlation"])
    above = np.triu_indices(len(NAMES), 1)
    size = np.maximum((1.0 - ratio**2) / n**0.5, 1e-4)
    away = ((np.corrcoef(found) - ratio) / size)[above]
    rows.append(
        row(
            *("biometry", f"{away.size} correlations", "largest", times_ms),
            *("sampling errors", np.abs(away).max(), reference),
        )
    )
    return rows


def visisipy_rows(expected: dict[str, Any]) -> list[Row]:
    """Return a row for each cornea."""
    rows = []
    for case in ("to_sixth_order_mm", "on_retina_mm"):
        away, times_ms = [], []
        for eye in expected["eyes"]:
            start_s = time.perf_counter()
            biometry = biometry_of(
                np.array(eye["parameters"]), tuple(eye["retina_semi_axes_mm"])
            )
            rays = trace_rays(
                # the axes of its file are those of a left eye here
                moved_retina(smooth_lens(eye_of_biometry(biometry, eye_side="OS"))),
                start_mm=expected["start_mm"],
                direction=(0.0, 0.0, 1.0),
                wavelength_nm=WAVELENGTH_NM,
            )
            times_ms.append(1e3 * (time.perf_counter() - start_s))
            away.append(np.abs(rays.points_mm[:, -1] - eye[case]).max())
        rows.append(
            row(
                *("visisipy", case, "largest on the retina", times_ms),
                *("um", 1e3 * max(away), "optiland"),
            )
        )
    return rows


def refraction_rows(eyes: list[EyeSurfaces]) -> list[Row]:
    """Return rows of the mean, deviation and skewness of M, for both retinas."""
    pupil_mm = human_data.ROZEMA_PUPIL_MM
    rows, reference = [], "Rozema et al. 2017, 330 eyes"
    for case, used in (
        ("retina at the axial length", eyes),
        ("retina 0.2 mm before", [moved_retina(eye) for eye in eyes]),
    ):
        start_s = time.perf_counter()
        m_dpt = DPT_PER_C20 * traced_um(used, pupil_mm)[:, 4] / (pupil_mm / 2.0) ** 2
        times_ms = [1e3 * (time.perf_counter() - start_s) / len(used)]
        mean_dpt, deviation_dpt = human_data.ROZEMA_M_DPT
        skewness = np.mean(((m_dpt - m_dpt.mean()) / m_dpt.std()) ** 3)
        for what, found, expected in (
            ("mean M, dpt", m_dpt.mean(), mean_dpt),
            ("deviation of M, dpt", m_dpt.std(), deviation_dpt),
            ("skewness of M", skewness, human_data.ROZEMA_M_SKEWNESS),
        ):
            rows.append(
                row(
                    *("refraction", case, f"{found:.3f}, measured {expected:.3f}"),
                    *(times_ms, what, found - expected, reference),
                    n=len(used),
                )
            )
    return rows


def higher_order_rows(eyes: list[EyeSurfaces]) -> list[Row]:
    """Return rows of mean terms, and of the mean RMS by pupil."""
    rows = []
    for case, used in (
        ("with the lens", eyes),
        ("smooth lens", [smooth_lens(eye) for eye in eyes]),
    ):
        for pupil_mm, expected_um in human_data.SALMON_RMS_UM.items():
            start_s = time.perf_counter()
            found_um = traced_um(used, pupil_mm)
            times_ms = [1e3 * (time.perf_counter() - start_s) / len(used)]
            rms_um = np.linalg.norm(found_um[:, 6:], axis=1).mean()
            told = f"RMS, {pupil_mm:g} mm: {rms_um:.3f} um, measured {expected_um:.3f}"
            rows.append(
                row(
                    *("higher orders", case, told, times_ms),
                    *("um", rms_um - expected_um, "Salmon & van de Pol 2006"),
                    n=len(used),
                )
            )
            if pupil_mm != human_data.ROZEMA_PUPIL_MM:
                continue
            for (n, m), (mean_um, _) in human_data.ROZEMA_UM.items():
                term_um = found_um[:, index_from_nm(n, m)].mean()
                told = f"C({n},{m}): {term_um:+.3f} um, measured {mean_um:+.3f}"
                rows.append(
                    row(
                        *("higher orders", case, told, times_ms),
                        *("um", term_um - mean_um, "Rozema et al. 2017"),
                        n=len(used),
                    )
                )
    return rows


def measure(run: Run) -> list[Row]:
    """Return the rows of 1,000 eyes, or of 50."""
    expected = json.loads(FROZEN.read_text(encoding="utf-8"))
    drawn, times_ms = [], []
    parse_profile({"kind": "synteyes", "sample": 0})  # reads the coefficients
    for sample in range(QUICK_DRAWN if run.is_quick else N_DRAWN):
        start_s = time.perf_counter()
        parse_profile({"kind": "synteyes", "sample": sample})
        times_ms.append(1e3 * (time.perf_counter() - start_s))
        drawn.append(drawn_biometry(sample))
    eyes = [eye_of_biometry(biometry, eye_side="OD") for biometry in drawn]
    return [
        *biometry_rows(drawn, times_ms, expected),
        *visisipy_rows(expected),
        *refraction_rows(eyes),
        *higher_order_rows(eyes),
    ]
