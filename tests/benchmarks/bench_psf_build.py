"""PSFs a second through the GPU's passes, beside the CPU's engines: speed with error.

    python -m tests.benchmarks.bench_psf_build [--quick] [--whole | --set-only] [--json]

The slices are those of `psf_rates.py`: one pupil and focus of the paper's dynamic grid,
traced through an estimated eye.  On a hardware GPU, or with --whole, the whole set of
201,825 PSFs follows, its kernels left on the GPU; with --set-only it stands alone.
`rates` holds, per build, PSFs a second of wall time and of processor time (other
programs on the machine hardly change the latter), and the operations and bytes that the
method needs.  The rows "hold" have how long the device is held at a time: all at once,
and in batches as a service builds.
"""

import argparse
import json
import time
from dataclasses import replace

import numpy as np

from estimator.psf.compute import compute_psf_batch, plan_psfs
from estimator.psf.reference import reference_kernel
from filter_service.gl.gpu import Gpu
from filter_service.psfs.gpu_build import gpu_psf_batch
from filter_service.psfs.gpu_build_pace import HOLD_S, Pace
from filter_service.psfs.gpu_build_records import kernel_starts, plan_rays, plan_waves
from tests.benchmarks.harness import (
    Row,
    machine_info,
    memory_mb,
    print_rows,
    report,
    write_report,
)
from tests.benchmarks.psf_rates import (
    FOCUSES_DPT,
    MAX_RADIUS_PX,
    PUPILS_MM,
    SAMPLED_UP_TO_WAVE_NUMBER,
    THREADS,
    Slice,
    traced_slices,
)
from tests.numerical.psf_cases import (
    compared_radius_px,
    disc_mask,
    filter_psnr_db,
    kernel_errors,
    make_test_image,
    physical_kernel,
)

CASES = (("emmetropia", 3.0), ("emmetropia", 5.0), ("keratoconus", 5.0))
RATES = (("fourier", 768), ("geometric", None), ("auto", None))
"""Method, and how many PSFs of the slice are made where not all are."""

FILL_FLOPS = 110
"""A pupil sample: wavefront 12, turn and sines 40, smoothed edge 55."""
CELL_FLOPS = 90
EDGE_POINT_FLOPS = 600
TAIL_FLOPS = 130
"""A pixel: distances to twelve slopes, and the density."""
FFT_FLOPS = 5.0


def work_of(part: Slice, method: str) -> dict[str, float]:
    """Operations and bytes through memory that a build needs."""
    plan = plan_psfs(
        part.zernike_um, method=method, max_radius_px=MAX_RADIUS_PX, **part.options
    )
    share, starts = plan.geometric_ratio, kernel_starts(plan)
    waves, _ = plan_waves(
        plan,
        np.flatnonzero(share < 1.0),
        starts,
        accuracy="normal",
        limit_count=1 << 17,
    )
    rays = plan_rays(plan, np.flatnonzero(share > 0.0), starts, limit_count=1 << 18)
    flops, n_bytes = TAIL_FLOPS * float(starts[-1]), 12.0 * float(starts[-1])
    size = waves.records["grid"][:, :2].astype(float)
    for chunk in waves.chunks:
        length_x, length_y = chunk.lengths
        lit = size[chunk.first : chunk.first + chunk.count]
        rows = FFT_FLOPS * length_x * np.log2(length_x) * lit[:, 1]
        columns = FFT_FLOPS * length_y * np.log2(length_y) * length_x
        flops += (rows + columns + FILL_FLOPS * lit.prod(axis=1)).sum()
        n_bytes += 16.0 * length_x * lit[:, 1].sum()
    cells = rays.records["grid"].astype(float)
    flops += (CELL_FLOPS * 0.79 * cells[:, 0] ** 2).sum()
    flops += (EDGE_POINT_FLOPS * cells[:, 1]).sum()
    n_bytes += 8.0 * float(
        (2 * plan.radius_px[rays.members] + 1.0)
        @ (2 * plan.radius_px[rays.members] + 1.0)
    )
    return {"gflop": flops / 1e9, "gbyte": n_bytes / 1e9}


def sample_errors(part: Slice, build, count: int, image) -> dict[str, float]:
    """Worst errors of evenly spread PSFs of a slice against the quadrature."""
    plan = plan_psfs(part.zernike_um, max_radius_px=MAX_RADIUS_PX, **part.options)
    cheap = np.flatnonzero(plan.survey.wave_number <= SAMPLED_UP_TO_WAVE_NUMBER)
    picked = cheap[np.linspace(0, cheap.size - 1, count).astype(int)]
    worst = {"l2_ratio": 0.0, "psnr_db": np.inf}
    for p, psf in zip(picked, build(part.picked(picked)), strict=True):
        radius_px = compared_radius_px(psf.blur_radius_px)
        options = {name: values[p] for name, values in part.options.items()}
        reference = reference_kernel(part.zernike_um[p], radius_px=radius_px, **options)
        kernel, disc = physical_kernel(psf, radius_px), disc_mask(radius_px)
        l2, _ = kernel_errors(kernel, reference)
        psnr_db = filter_psnr_db(image, kernel * disc, reference * disc)
        worst["l2_ratio"] = max(worst["l2_ratio"], l2)
        worst["psnr_db"] = min(worst["psnr_db"], psnr_db)
    return worst


def _engines(gpu: Gpu, method: str) -> dict:
    common = {"method": method, "max_radius_px": MAX_RADIUS_PX, "workers": THREADS}
    return {
        "gpu": lambda part: gpu_psf_batch(
            gpu, part.zernike_um, **common, **part.options
        ),
        "cpu": lambda part: compute_psf_batch(
            part.zernike_um, **common, **part.options
        ),
    }


def _times_s(build, part: Slice, repeats: int) -> tuple[list[float], float]:
    """Wall times of builds, and the least processor time."""
    build(part)  # compiles
    times_s, used_s = [], []
    for _ in range(repeats):
        start, used = time.perf_counter(), time.process_time()
        build(part)
        times_s.append(time.perf_counter() - start)
        used_s.append(time.process_time() - used)
    return times_s, min(used_s)


def _rows(method, case, setting, n, times_s, errors) -> list[Row]:
    return [
        Row(
            bench="build",
            method=method,
            case=case,
            setting=setting,
            n=n,
            median_ms=float(f"{1000.0 * np.median(times_s):.5g}"),
            p95_ms=float(f"{1000.0 * np.max(times_s):.5g}"),
            memory_mb=round(memory_mb()),
            error_name=name,
            error=float(f"{error:.5g}"),
            reference="float64 quadrature, worst of a sample",
        )
        for name, error in errors.items()
    ]


def _rate(row: Row, part: Slice, method: str, times_s, processor_s: float) -> dict:
    work, seconds = work_of(part, method), float(np.median(times_s))
    numbers = {
        "psfs_per_s": row.n / seconds,
        "psfs_per_processor_s": row.n / processor_s,
        **work,
        "gflop_per_processor_s": work["gflop"] / processor_s,
        "gbyte_per_processor_s": work["gbyte"] / processor_s,
    }
    return {
        "method": row.method,
        "case": row.case,
        "setting": row.setting,
        **{name: float(f"{value:.4g}") for name, value in numbers.items()},
    }


def slice_rows(gpu: Gpu, image, *, quick: bool) -> tuple[list[Row], list[dict]]:
    """Build times of slices by every method on both; quick: one slice, only auto."""
    rows, rates = [], []
    for eye, pupil_mm in CASES[:1] if quick else CASES:
        whole = traced_slices(eye, [pupil_mm], [0.0])[0]
        for method, count in RATES[2:] if quick else RATES:
            step = len(whole.zernike_um) // (count or len(whole.zernike_um))
            part = whole.picked(slice(None, None, step))
            setting = f"slice {pupil_mm:g} mm"
            for engine, build in _engines(gpu, method).items():
                times_s, processor_s = _times_s(build, part, 2 if quick else 3)
                errors = sample_errors(part, build, 3 if quick else 8, image)
                n = len(part.zernike_um)
                rows += _rows(f"{engine} {method}", eye, setting, n, times_s, errors)
                rates.append(_rate(rows[-1], part, method, times_s, processor_s))
    return rows, rates


def hold_rows(gpu: Gpu, *, quick: bool) -> list[Row]:
    """Return how long batches hold the device, and whether they change a kernel."""
    rows = []
    for eye, pupil_mm in CASES[:1] if quick else CASES:
        part = traced_slices(eye, [pupil_mm], [0.0])[0]
        kernels = {}
        for name, hold_s in (("at once", 1e9), ("in batches", HOLD_S)):
            pace = Pace(hold_s)
            options = {"max_radius_px": MAX_RADIUS_PX, "pace": pace, **part.options}
            gpu_psf_batch(gpu, part.zernike_um, **options)  # compiles, and learns
            pace.holds_s.clear()
            batch = gpu_psf_batch(gpu, part.zernike_um, **options)
            kernels[name] = batch.flat_kernels
            change = float(np.abs(batch.flat_kernels - kernels["at once"]).max())
            errors = {
                "longest_hold_ms": 1e3 * max(pace.holds_s),
                "kernels_changed": change,
            }
            setting = f"slice {pupil_mm:g} mm"
            n, holds_s = len(pace.holds_s), np.array(pace.holds_s)
            rows += [
                replace(row, p95_ms=float(f"{1e3 * np.quantile(holds_s, 0.95):.4g}"))
                for row in _rows(f"hold, {name}", eye, setting, n, holds_s, errors)
            ]
    return [replace(row, reference="the same at once") for row in rows]


def whole_set_rows(gpu: Gpu, image, eye: str = "emmetropia") -> list[Row]:
    """Time of all 25 slices as one call."""
    slices = traced_slices(eye, PUPILS_MM, FOCUSES_DPT)
    whole = Slice(
        np.concatenate([part.zernike_um for part in slices]),
        {
            name: np.concatenate([part.options[name] for part in slices])
            for name in slices[0].options
        },
    )
    times_s = []
    for _ in range(1 if gpu.is_software else 4):
        start = time.perf_counter()
        gpu_psf_batch(
            gpu, whole.zernike_um, max_radius_px=MAX_RADIUS_PX, **whole.options
        )
        times_s.append(time.perf_counter() - start)
    errors = sample_errors(whole, _engines(gpu, "auto")["gpu"], 12, image)
    # The first time compiles, where there are others.
    n, times_s = len(whole.zernike_um), times_s[1:] or times_s
    return _rows("gpu auto", eye, "25 slices", n, times_s, errors)


def main() -> None:
    """Print rows and rates, and write tests/benchmarks/results/build.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one slice, only auto")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--whole", action="store_true", help="the whole set as well")
    how.add_argument("--set-only", action="store_true", help="the whole set, no slice")
    parser.add_argument("--json", action="store_true", help="print only JSON")
    arguments = parser.parse_args()
    gpu, image = Gpu(), make_test_image()
    rows, rates = [], []
    if not arguments.set_only:
        rows, rates = slice_rows(gpu, image, quick=arguments.quick)
        rows += hold_rows(gpu, quick=arguments.quick)
    wants_set = arguments.whole or arguments.set_only
    if wants_set or not (gpu.is_software or arguments.quick):
        rows += whole_set_rows(gpu, image)
    content = report(
        rows, machine={**machine_info(), "gl_renderer": gpu.info["renderer"]}
    )
    content["rates"] = rates
    if arguments.json:
        print(json.dumps(content))
        return
    print_rows(rows)
    for rate in rates:
        print(rate)
    if not (arguments.quick or arguments.set_only):
        print(f"written to {write_report('psf_build', content)}")


if __name__ == "__main__":
    main()
