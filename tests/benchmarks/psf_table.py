"""The error table of the PSF methods: eyes x fields x pupils x pixels x methods."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from estimator.psf.compute import compute_psf_batch, plan_psfs
from tests.benchmarks.harness import Row, memory_mb, time_calls
from tests.numerical.psf_cases import (
    DENSITIES_MRAD,
    EYE_NAMES,
    FieldCase,
    Window,
    disc_mask,
    field_cases,
    filter_psnrs_db,
    kernel_errors,
)

REFERENCE = "float64 quadrature"
METHODS = ("auto", "fourier", "geometric", "enz_unchecked")

N_BATCH = 64
SLOW_FROM_WAVE_NUMBER = 300
"""Above it an FFT takes milliseconds; fewer repeats do."""

ENZ_UP_TO_WAVE_NUMBER = 600
"""Beyond, the series takes seconds per kernel and holds nothing but pure defocus."""

QUICK_PUPILS_MM = (2.0, 3.0)
MAX_RADIUS_PX = 1023


def table_cases(*, quick: bool) -> list[FieldCase]:
    """All 324 cases, or the 36 of small pupils at 720p."""
    return [
        case
        for case in field_cases()
        if not quick
        or (case.pupil_diameter_mm in QUICK_PUPILS_MM and case.density == "720p50")
    ]


def _batch_of(zernike_um, pupil_mm: float, count: int) -> np.ndarray:
    """Copies with defocus varied by 0.02 dpt in all, as along a grid of distances."""
    batch = np.repeat(zernike_um[None], count, axis=0)
    vergence_dpt = np.linspace(-0.01, 0.01, count)
    batch[:, 4] += vergence_dpt * (pupil_mm / 2.0) ** 2 / (4.0 * np.sqrt(3.0))
    return batch


def _times_ms(case: FieldCase, method: str, wave_number: float) -> tuple[float, float]:
    """Median and 95th percentile per PSF of a batch on one thread, processor time."""
    is_slow = wave_number > SLOW_FROM_WAVE_NUMBER and method == "fourier"
    count = 4 if is_slow else N_BATCH
    batch = _batch_of(case.zernike_um, case.options["pupil_diameter_mm"], count)
    return time_calls(
        lambda: compute_psf_batch(
            batch,
            method=method,
            workers=1,
            max_radius_px=MAX_RADIUS_PX,
            **case.options,
        ),
        repeats=2 if is_slow else 5,
        per_call=count,
        clock=time.process_time,
    )


def _errors(case, method, image) -> tuple[str, float, dict[str, float]]:
    """Method as it was chosen, processor time in ms, and every error by name."""
    start = time.process_time()
    psf = compute_psf_batch(
        case.zernike_um[None],
        method=method,
        workers=1,
        max_radius_px=MAX_RADIUS_PX,
        **case.options,
    )[0]
    elapsed_ms = 1000.0 * (time.process_time() - start)
    window = Window.of_spot(case.zernike_um, case.options)
    reference = window.kept_reference(case.zernike_um, case.options)
    kernel, disc = window.cut(psf), disc_mask(window.radius_px)
    l2, energy = kernel_errors(kernel, reference)
    linear_db, srgb_db = filter_psnrs_db(image, kernel * disc, reference * disc)
    return (
        psf.method,
        elapsed_ms,
        {
            "l2_ratio": l2,
            "energy_ratio": energy,
            "psnr_db": linear_db,
            "psnr_srgb_db": srgb_db,
            "lost_energy_ratio": psf.lost_energy_ratio,
        },
    )


def table_rows(case: FieldCase, image) -> list[Row]:
    """Every error of every method for one case."""
    plan = plan_psfs(case.zernike_um[None], max_radius_px=MAX_RADIUS_PX, **case.options)
    wave_number = float(plan.survey.wave_number[0])
    rows = []
    for method in METHODS:
        if method == "enz_unchecked" and wave_number > ENZ_UP_TO_WAVE_NUMBER:
            continue
        chosen, elapsed_ms, errors = _errors(case, method, image)
        times_ms = (elapsed_ms, elapsed_ms)  # of ENZ, which is no faster in batches
        if method != "enz_unchecked":
            times_ms = _times_ms(case, method, wave_number)
        row = Row(
            bench="psf",
            method=f"auto={chosen}" if method == "auto" else method,
            case=f"{case.eye} {case.eccentricity_deg} deg",
            setting=f"{case.density} {case.pupil_diameter_mm:g} mm",
            n=round(wave_number),
            median_ms=float(f"{times_ms[0]:.4g}"),
            p95_ms=float(f"{times_ms[1]:.4g}"),
            memory_mb=round(memory_mb()),
            error_name="",
            error=0.0,
            reference=REFERENCE,
        )
        rows += [
            replace(row, error_name=name, error=float(f"{value:.5g}"))
            for name, value in errors.items()
            if method == "auto" or name != "lost_energy_ratio"
        ]
    return rows


def _values(rows: list[Row], name: str) -> np.ndarray:
    return np.array([r.error for r in rows if r.error_name == name])


def print_summary(rows: list[Row]) -> None:
    """Median and worst of every method and density, and what misses its target."""
    print(
        f"{'method':<15}{'density':<9}{'count':>6}{'ms med':>8}{'ms max':>8}"
        f"{'L2 med':>8}{'L2 max':>8}{'|E| max':>9}{'PSNR min':>9}"
        f"{'med':>7}{'sRGB min':>9}"
    )
    for method in METHODS:
        for density in DENSITIES_MRAD:
            chosen = [
                r
                for r in rows
                if r.method.startswith(method) and r.setting.startswith(density)
            ]
            if not chosen:
                continue
            ms = np.array([r.median_ms for r in chosen if r.error_name == "l2_ratio"])
            l2, psnr_db = _values(chosen, "l2_ratio"), _values(chosen, "psnr_db")
            print(
                f"{method:<15}{density:<9}{l2.size:>6}{np.median(ms):>8.3f}"
                f"{ms.max():>8.2f}{np.median(l2):>8.4f}{l2.max():>8.4f}"
                f"{np.abs(_values(chosen, 'energy_ratio')).max():>9.4f}"
                f"{psnr_db.min():>9.1f}{np.median(psnr_db):>7.1f}"
                f"{_values(chosen, 'psnr_srgb_db').min():>9.1f}"
            )
    for line in missed_targets(rows):
        print(f"misses: {line}")


def missed_targets(rows: list[Row]) -> list[str]:
    """Cases of auto below 50 dB, and of fourier beyond what it promises."""
    missed = []
    for row in rows:
        name, is_wave = row.error_name, row.method == "fourier"
        if not (is_wave or row.method.startswith("auto=")):
            continue
        l2_limit = 1.5e-2 if row.setting.startswith("720p50") else 3e-2
        is_missed = (
            (name == "psnr_db" and row.error < (54.0 if is_wave else 50.0))
            or (name == "energy_ratio" and abs(row.error) > 1e-2)
            or (name == "l2_ratio" and is_wave and row.error > l2_limit)
        )
        if is_missed:
            missed.append(f"{row.method} {row.case} {row.setting} {name} {row.error:g}")
    return missed


def plot(rows: list[Row], path: Path) -> None:
    """Time per PSF against both errors, one point per case and method."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, name, label in zip(
        panels,
        ("l2_ratio", "psnr_db"),
        ("relative L2 error of the kernel", "PSNR of the filtered image, dB"),
        strict=True,
    ):
        for method in METHODS:
            chosen = [
                r
                for r in rows
                if r.method.startswith(method)
                and r.error_name == name
                and r.case.split(" ")[0] in EYE_NAMES
            ]
            axes.plot(
                [r.median_ms for r in chosen],
                [r.error for r in chosen],
                ".",
                label=method,
                alpha=0.6,
            )
        axes.set_xscale("log")
        axes.set_xlabel("time per PSF on one thread, ms")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    panels[0].set_yscale("log")
    panels[1].axhline(50.0, color="k", lw=0.8, ls="--")
    panels[1].legend()
    figure.savefig(path, dpi=100)
