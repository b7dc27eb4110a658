"""Time per PSF against its errors, by method and case: batches on one thread.

    python -m tests.benchmarks.bench_psf [--quick] [--json]

Times are processor time, which other programs on the machine hardly change; on a
quiet one it is the wall clock's.

Reference: the float64 quadrature of `estimator/psf_reference.py`.  Errors: relative L2
of the kernel, energy, and the PSNR of a 512 x 512 linear image filtered with it.
"""

import argparse
import json
import time

import numpy as np

from estimator.psf import compute_psfs
from estimator.psf_pupil import pupil_frames
from estimator.psf_survey import survey_pupils
from estimator.psf_types import disc_mask
from estimator.zernike import wavefront_polynomial
from tests.benchmarks.harness import (
    Row,
    memory_mb,
    print_rows,
    report,
    time_calls,
    write_report,
)
from tests.numerical.psf_cases import (
    DENSITIES_MRAD,
    case_zernike_um,
    compared_radius_px,
    configurations,
    filter_psnr_db,
    kernel_errors,
    make_test_image,
    physical_kernel,
    truth,
)

REFERENCE = "float64 quadrature"
N_BATCH = 64
SLOW_FROM_WAVE_NUMBER = 250.0
"""The wave method's batch is cut to 4 from here on."""

METHODS = (
    ("fourier normal", {"method": "fourier", "accuracy": "normal"}),
    ("fourier fine", {"method": "fourier", "accuracy": "fine"}),
    ("geometric", {"method": "geometric"}),
    ("auto", {"method": "auto"}),
)


def _survey(zernike_um, pupil_mm, wavelength_nm, pitch_mrad):
    frames = pupil_frames(
        wavefront_polynomial(zernike_um[None]),
        circle_radius_mm=np.array([pupil_mm / 2.0]),
        wavelength_nm=np.array([wavelength_nm]),
        pixel_from_mrad=np.eye(2)[None] / pitch_mrad,
    )
    return survey_pupils(frames)


def _batch(zernike_um, pupil_mm, count):
    """Copies with defocus varied by 0.02 dpt in all, as along a grid of distances."""
    batch = np.repeat(zernike_um[None], count, axis=0)
    vergence_dpt = np.linspace(-0.01, 0.01, count)
    batch[:, 4] += vergence_dpt * (pupil_mm / 2.0) ** 2 / (4.0 * np.sqrt(3.0))
    return batch


def measure(configuration, density, image, repeats) -> list[Row]:
    """Rows of one wavefront, pupil, wavelength and pixel: 3 errors per method."""
    name, pupil_mm, wavelength_nm = configuration
    pitch_mrad = DENSITIES_MRAD[density]
    zernike_um = case_zernike_um(name, pupil_mm)
    survey = _survey(zernike_um, pupil_mm, wavelength_nm, pitch_mrad)
    wave_number = float(survey.wave_number[0])
    radius = compared_radius_px(float(survey.blur_radius_px[0]))
    reference = truth(name, pupil_mm, wavelength_nm, pitch_mrad, radius)
    disc = disc_mask(radius)
    rows = []
    for label, options in METHODS:
        is_slow = wave_number > SLOW_FROM_WAVE_NUMBER and "fourier" in label
        batch = _batch(zernike_um, pupil_mm, 4 if is_slow else N_BATCH)
        common = {
            "pupil_diameter_mm": pupil_mm,
            "wavelength_nm": wavelength_nm,
            "pixel_pitch_mrad": pitch_mrad,
            "workers": 1,
            **options,
        }
        psf = compute_psfs(zernike_um[None], **common)[0]
        median_ms, p95_ms = time_calls(
            lambda batch=batch, common=common: compute_psfs(batch, **common),
            repeats=2 if is_slow else repeats,
            per_call=len(batch),
            clock=time.process_time,
        )
        kernel = physical_kernel(psf, radius)
        l2, energy = kernel_errors(kernel, reference)
        psnr_db = filter_psnr_db(image, kernel * disc, reference * disc)
        setting = f"{density} {pupil_mm:g} mm {wavelength_nm:g} nm"
        for error_name, error in (
            ("l2_ratio", l2),
            ("energy_ratio", energy),
            ("psnr_db", psnr_db),
        ):
            rows.append(
                Row(
                    "psf",
                    label if label != "auto" else f"auto={psf.method}",
                    name,
                    setting,
                    round(wave_number),
                    median_ms,
                    p95_ms,
                    memory_mb(),
                    error_name,
                    error,
                    REFERENCE,
                )
            )
    return rows


def summarise(rows: list[Row]) -> None:
    """Median and worst of every method and density; geometric only where it is used."""
    print(
        f"{'method':<26}{'density':<9}{'count':>6}{'ms med':>8}{'ms max':>8}"
        f"{'L2 med':>8}{'L2 max':>8}{'|E| max':>9}{'PSNR min':>9}{'med':>7}"
    )
    for label, keep in (
        ("fourier normal", lambda r: r.method == "fourier normal"),
        ("fourier fine", lambda r: r.method == "fourier fine"),
        ("geometric, n >= 192", lambda r: r.method == "auto=geometric"),
        ("auto", lambda r: r.method.startswith("auto")),
    ):
        for density in DENSITIES_MRAD:
            chosen = [r for r in rows if keep(r) and r.setting.startswith(density)]
            values = {
                name: np.array([r.error for r in chosen if r.error_name == name])
                for name in ("l2_ratio", "energy_ratio", "psnr_db")
            }
            if not chosen:
                continue
            ms = np.array([r.median_ms for r in chosen])
            l2, psnr = values["l2_ratio"], values["psnr_db"]
            print(
                f"{label:<26}{density:<9}{l2.size:>6}{np.median(ms):>8.3f}"
                f"{ms.max():>8.2f}{np.median(l2):>8.4f}{l2.max():>8.4f}"
                f"{np.abs(values['energy_ratio']).max():>9.4f}"
                f"{psnr.min():>9.1f}{np.median(psnr):>7.1f}"
            )


def main() -> None:
    """Print a table and write tests/benchmarks/results/psf.json, or print only JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="720p, 2 and 3 mm only")
    parser.add_argument("--json", action="store_true", help="print only JSON")
    arguments = parser.parse_args()
    image = make_test_image()
    rows = []
    for density in DENSITIES_MRAD:
        for configuration in configurations():
            is_small = configuration[1] <= 3.0 and density == "720p50"
            if arguments.quick and not is_small:
                continue
            part = measure(configuration, density, image, repeats=7)
            rows += part
            if not arguments.json:
                print_rows([r for r in part if r.error_name == "l2_ratio"])
    content = report(rows)
    if arguments.json:
        print(json.dumps(content))
        return
    summarise(rows)
    if not arguments.quick:
        print(f"written to {write_report('psf', content)}")


if __name__ == "__main__":
    main()
