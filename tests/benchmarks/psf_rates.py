"""How fast PSFs of one eye's whole grid are made, and how right they are.

The grid of the paper's dynamic mode: 23 x 13 angles of a 720p camera, 50 deg high, x 9
distances x 3 wavelengths; 5 pupils x 5 foci are 25 such slices.
"""

import time
from dataclasses import dataclass

import numpy as np

from estimator.estimate.estimation import estimate_eye
from estimator.field.interpolation import aberration_grid
from estimator.optics.pinhole import pixel_from_mrad
from estimator.optics.units import RGB_WAVELENGTHS_NM, SPHERE_PER_C20
from estimator.profiles.files import load_profile
from estimator.psf.compute import compute_psf_batch, plan_psfs
from tests.benchmarks.harness import Row, memory_mb
from tests.benchmarks.psf_table import REFERENCE
from tests.numerical.psf_cases import (
    Window,
    disc_mask,
    filter_psnrs_db,
    kernel_errors,
)

SIZE_PX = (1280, 720)
TANGENT_UP = float(np.tan(np.radians(25.0)))
TANGENTS = (-TANGENT_UP * 16 / 9, TANGENT_UP * 16 / 9, TANGENT_UP, -TANGENT_UP)
H_DEG = np.degrees(np.arctan(TANGENTS[1])) * np.linspace(-1.0, 1.0, 23)
V_DEG = 25.0 * np.linspace(-1.0, 1.0, 13)
DISTANCES_DPT = np.arange(9.0)
PUPILS_MM = np.linspace(2.0, 7.0, 5)
FOCUSES_DPT = np.linspace(0.0, 6.0, 5)
THREADS = 2
MAX_RADIUS_PX = 1023
SAMPLED_UP_TO_WAVE_NUMBER = 300
"""PSFs whose reference takes seconds, not minutes."""


@dataclass(frozen=True)
class Slice:
    """8,073 PSFs of one pupil and focus as `compute_psf_batch` takes them."""

    zernike_um: np.ndarray
    options: dict

    def picked(self, index) -> "Slice":
        """Return some of them."""
        options = {name: values[index] for name, values in self.options.items()}
        return Slice(self.zernike_um[index], options)


def traced_slices(profile_name: str, pupils_mm, focuses_dpt) -> list[Slice]:
    """Trace an estimated eye over the grid: a slice for each pupil and focus."""
    eye = estimate_eye(load_profile(profile_name))
    used_dpt = [eye.accommodating.accommodation_dpt(f) for f in focuses_dpt]
    traced, which = np.unique(used_dpt, return_inverse=True)
    grid = aberration_grid(
        eye,
        pupil_diameters_mm=pupils_mm,
        accommodations_dpt=traced,
        wavelengths_nm=RGB_WAVELENGTHS_NM,
        h_deg=H_DEG,
        v_deg=V_DEG,
    )
    return [
        _slice(
            grid.zernike_um[:, :, p, k],
            grid.zernike_radius_mm[:, :, p, k],
            grid.ellipse_mm[:, :, p, k],
        )
        for p in range(len(pupils_mm))
        for k in which
    ]


def _slice(zernike_um, radius_mm, ellipse_mm) -> Slice:
    """Slice from wavefronts (23, 13, 3, 28) for infinity: distances add defocus."""
    h_deg, v_deg = np.meshgrid(H_DEG, V_DEG, indexing="ij")
    jacobian = pixel_from_mrad(h_deg, v_deg, tangents=TANGENTS, size_px=SIZE_PX)
    shape = (len(H_DEG), len(V_DEG), len(DISTANCES_DPT), len(RGB_WAVELENGTHS_NM))
    radius_mm = np.broadcast_to(radius_mm[:, :, None], shape)
    zernike_um = np.repeat(zernike_um[:, :, None], len(DISTANCES_DPT), axis=2)
    zernike_um[..., 4] -= DISTANCES_DPT[:, None] * radius_mm**2 / SPHERE_PER_C20
    ellipse_mm = np.broadcast_to(ellipse_mm[:, :, None], (*shape, 5))
    jacobian = np.broadcast_to(jacobian[:, :, None, None], (*shape, 2, 2))
    return Slice(
        zernike_um.reshape(-1, zernike_um.shape[-1]),
        {
            "pupil_diameter_mm": 2.0 * radius_mm.ravel(),
            "wavelength_nm": np.broadcast_to(RGB_WAVELENGTHS_NM, shape).ravel(),
            "pixel_from_mrad": jacobian.reshape(-1, 2, 2),
            "pupil_ellipse": ellipse_mm.reshape(-1, 5),
        },
    )


def _build(part: Slice, method: str) -> np.ndarray:
    """Wall and processor time (2,) of one build on two threads, s."""
    start = np.array([time.perf_counter(), time.process_time()])
    compute_psf_batch(
        part.zernike_um,
        method=method,
        workers=THREADS,
        max_radius_px=MAX_RADIUS_PX,
        **part.options,
    )
    return np.array([time.perf_counter(), time.process_time()]) - start


def sample_errors(part: Slice, method: str, count: int, image) -> dict[str, float]:
    """Worst errors of evenly spread PSFs of a slice against the quadrature."""
    plan = plan_psfs(part.zernike_um, max_radius_px=MAX_RADIUS_PX, **part.options)
    cheap = np.flatnonzero(plan.survey.wave_number <= SAMPLED_UP_TO_WAVE_NUMBER)
    worst = {"l2_ratio": 0.0, "psnr_db": np.inf}
    for p in cheap[np.linspace(0, cheap.size - 1, count).astype(int)]:
        one = part.picked(slice(p, p + 1))
        psf = compute_psf_batch(
            one.zernike_um, method=method, max_radius_px=MAX_RADIUS_PX, **one.options
        )[0]
        options = {name: values[0] for name, values in one.options.items()}
        window = Window.of_spot(one.zernike_um[0], options)
        reference = window.kept_reference(one.zernike_um[0], options)
        kernel, disc = window.cut(psf), disc_mask(window.radius_px)
        l2, _ = kernel_errors(kernel, reference)
        linear_db, _ = filter_psnrs_db(image, kernel * disc, reference * disc)
        worst["l2_ratio"] = max(worst["l2_ratio"], l2)
        worst["psnr_db"] = min(worst["psnr_db"], linear_db)
    return worst


def _rows(method, case, setting, n, times_s, errors) -> list[Row]:
    """Rows of the wall times on both threads, and of the processor times (m, 2)."""
    wall_s, processor_s = np.array(times_s).T
    return [
        *_time_rows(method, case, f"{setting}, {THREADS} threads", n, wall_s, errors),
        *_time_rows(method, case, f"{setting}, processor", n, processor_s, errors),
    ]


def _time_rows(method, case, setting, n, times_s, errors) -> list[Row]:
    return [
        Row(
            bench="psf",
            method=method,
            case=case,
            setting=setting,
            n=n,
            median_ms=float(f"{1000.0 * np.median(times_s):.5g}"),
            p95_ms=float(f"{1000.0 * np.max(times_s):.5g}"),
            memory_mb=round(memory_mb()),
            error_name=name,
            error=float(f"{error:.5g}"),
            reference=f"{REFERENCE}, worst of a sample",
        )
        for name, error in errors.items()
    ]


RATES = (
    # eye, pupil, method, PSFs of the slice in use
    ("emmetropia", 3.0, "auto", None),
    ("emmetropia", 5.0, "auto", None),
    ("keratoconus", 3.0, "auto", None),
    ("keratoconus", 5.0, "auto", None),
    ("emmetropia", 3.0, "fourier", 2048),
    ("emmetropia", 3.0, "geometric", None),
    ("emmetropia", 3.0, "enz_unchecked", 24),
)


def rate_rows(image, *, quick: bool) -> list[Row]:
    """Build times of slices by every method; quick: only auto, one repeat."""
    rows, slices = [], {}
    for eye, pupil_mm, method, count in RATES:
        if quick and (method != "auto" or eye != "emmetropia" or pupil_mm != 3.0):
            continue
        if (eye, pupil_mm) not in slices:
            slices[eye, pupil_mm] = traced_slices(eye, [pupil_mm], [0.0])[0]
        part = slices[eye, pupil_mm]
        if count is not None:
            step = len(part.zernike_um) // count
            part = part.picked(slice(None, step * count, step))
        _build(part.picked(slice(0, None, max(1, len(part.zernike_um) // 16))), method)
        times_s = [_build(part, method) for _ in range(1 if quick else 5)]
        errors = sample_errors(part, method, 3 if quick else 8, image)
        n = len(part.zernike_um)
        setting = f"slice {pupil_mm:g} mm"
        rows += _rows(method, eye, setting, n, times_s, errors)
    return rows


def whole_set_rows(image, profile_name: str = "emmetropia") -> list[Row]:
    """Time of all 25 slices one after the other, and the tracing before them."""
    start = np.array([time.perf_counter(), time.process_time()])
    slices = traced_slices(profile_name, PUPILS_MM, FOCUSES_DPT)
    tracing_s = np.array([time.perf_counter(), time.process_time()]) - start
    _build(slices[0], "auto")
    build_s = np.sum([_build(part, "auto") for part in slices], axis=0)
    worst = [sample_errors(part, "auto", 1, image) for part in slices]
    errors = {
        "l2_ratio": max(e["l2_ratio"] for e in worst),
        "psnr_db": min(e["psnr_db"] for e in worst),
    }
    n = sum(len(part.zernike_um) for part in slices)
    setting = "25 slices"
    traced = n // (3 * len(DISTANCES_DPT)) * 3
    return [
        *_rows("auto", profile_name, setting, n, [build_s], errors),
        *_rows("traced wavefronts", profile_name, setting, traced, [tracing_s], errors),
    ]


def print_rates(rows: list[Row]) -> None:
    """One line per build."""
    for row in rows:
        if row.error_name == "psnr_db":
            l2 = next(
                r.error
                for r in rows
                if r.error_name == "l2_ratio"
                and (r.method, r.case, r.setting) == (row.method, row.case, row.setting)
            )
            print(
                f"{row.method:<18}{row.case:<12}{row.setting:<25}{row.n:>7} PSFs in "
                f"{row.median_ms / 1000.0:>7.3f} s: "
                f"{row.n / row.median_ms * 1000.0:>7.0f} /s; "
                f"sample: {row.error:.1f} dB, L2 {l2:.3f}"
            )
