"""Every method against the dense reference: time, memory, and four measures of error.

    python -m tests.benchmarks.bench_field [--quick] [--json] [--plot]
        [--differences DIR] [--eyes NAME ...] [--sizes WxH ...] [--scenes NAME ...]
        [--methods TEXT ...]

Quick: 320x180, two eyes, *Courtyard*.  Otherwise six eyes and two scenes at 320x180 and
640x360, an hour on two cores.  The reference of methods on the axis has the PSF of the
axis everywhere; that of the others follows the visual field.  Methods that take any
pupil and focus are also measured at random ones.  Time is a frame's; preparation for an
eye stands beside it.
"""

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from filter_service.gl.gpu import Gpu
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.field_methods import (
    FOCUS_RANGE_DPT,
    METHODS,
    PAPER_RANGES,
    EyeBench,
    Method,
    State,
    warmed_up,
)
from tests.benchmarks.field_pictures import plot_errors, write_differences
from tests.benchmarks.harness import (
    RESULTS,
    Row,
    machine_info,
    print_rows,
    report,
    write_report,
)
from tests.benchmarks.image_measures import measures
from tests.benchmarks.published_figures import CONDITIONS, HARDWARE, published
from tests.numerical.scene_frames import SCENES, scene_view

FIXED = State(5.0, 0.5)
RANDOM_STATE_COUNT = 2
SEED = 5

SIZES = {"320x180": (320, 180), "640x360": (640, 360)}
UNBINNED_PIXEL_COUNT = 60_000
"""Larger frames are compared with the binned reference."""

REPEATS = 3


@dataclass(frozen=True)
class FieldRow(Row):
    """A row with the other measures of its image.

    Attributes
    ----------
    psnr_srgb8_db, ssim_ratio, mean_delta_e : float or None
        See `image_measures.Measures`; ``error`` is the linear PSNR of measured rows.
    prepare_ms : float or None
        PSFs of the eye, once.
    psf_count, tap_count : int or None
    hardware : str
        Where the row's figures come from.
    measured_on : str
        Hardware of this run.
    """

    psnr_srgb8_db: float | None
    ssim_ratio: float | None
    mean_delta_e: float | None
    prepare_ms: float | None
    psf_count: int | None
    tap_count: int | None
    hardware: str
    measured_on: str


def random_states(count: int) -> list[State]:
    """Pupils and foci within all methods' ranges, the same in every run."""
    rng = np.random.default_rng(SEED)
    low_dpt = PAPER_RANGES["focus_range_dpt"][0]
    return [
        State(
            float(rng.uniform(*PAPER_RANGES["pupil_range_mm"])),
            float(rng.uniform(low_dpt, FOCUS_RANGE_DPT[1])),
        )
        for _ in range(count)
    ]


def bench_eye(gpu, eye, scenes, size, methods, hardware, differences) -> list[Row]:
    """Rows of one eye and image size."""
    views = {
        scene: scene_view(scene, width_px=size[0], height_px=size[1])
        for scene in scenes
    }
    bench = EyeBench(gpu, eye, list(views.values()))
    rows = []
    for scene, view in views.items():
        for method in methods:
            for state in method.states(FIXED, random_states(RANDOM_STATE_COUNT)):
                bins = size[0] * size[1] > UNBINNED_PIXEL_COUNT
                exact = bench.exact_state(state, on_axis=method.on_axis)
                reference = dense_reference(view, exact, bins=bins)
                results = method.run(bench, view, state, REPEATS)
                setting = f"{scene} {size[0]}x{size[1]} {state}"
                if differences:
                    name = f"{eye} {setting} {method.name}"
                    write_differences(differences, name, results[-1].color, reference)
                rows.append(
                    _row(method, eye, setting, bins, results, reference, hardware)
                )
                row = rows[-1]
                print(
                    f"{eye} {setting} {row.method}: {row.median_ms:.0f} ms, "
                    f"{row.error:.1f} dB",
                    file=sys.stderr,
                )
    bench.release()
    return rows


def _row(method: Method, eye, setting, bins, results, reference, hardware) -> FieldRow:
    last = results[-1]
    found = measures(last.color, reference)
    times_ms = [result.render_ms for result in results]
    psfs = "bins of 0.2 deg and 0.005 dpt" if bins else "PSF of every pixel"
    place = "on the axis" if method.on_axis else "over the field"
    return FieldRow(
        bench="field",
        method=method.name,
        case=eye,
        setting=setting,
        n=len(results),
        median_ms=float(np.median(times_ms)),
        p95_ms=float(np.percentile(times_ms, 95)),
        memory_mb=last.memory_mb,
        error_name="psnr_db",
        error=found.psnr_db,
        reference=f"dense, {place}, {psfs}",
        psnr_srgb8_db=found.psnr_srgb8_db,
        ssim_ratio=found.ssim_ratio,
        mean_delta_e=found.mean_delta_e,
        prepare_ms=last.prepare_ms,
        psf_count=last.psf_count,
        tap_count=last.tap_count or None,
        hardware=hardware,
        measured_on=hardware,
    )


def published_rows(eye: str, hardware: str) -> list[FieldRow]:
    """The paper's figures of a condition."""
    return [
        FieldRow(
            bench="field",
            method=method,
            case=eye,
            setting=f"{scene} 1280x720, published, {HARDWARE}",
            n=1,
            median_ms=median_ms,
            p95_ms=median_ms,
            memory_mb=float("nan"),
            error_name="psnr_srgb8_db",
            error=error_db,
            reference=f"the paper's own, {table}",
            psnr_srgb8_db=error_db,
            ssim_ratio=None,
            mean_delta_e=None,
            prepare_ms=None,
            psf_count=None,
            tap_count=None,
            hardware=HARDWARE,
            measured_on=hardware,
        )
        for method, scene, median_ms, error_db, table in published(eye)
    ]


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="320x180, two eyes")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", action="store_true", help="results/field.png")
    parser.add_argument("--differences", type=Path, metavar="DIR")
    parser.add_argument("--eyes", nargs="+", choices=CONDITIONS)
    parser.add_argument("--sizes", nargs="+", choices=SIZES)
    parser.add_argument("--scenes", nargs="+", choices=SCENES)
    parser.add_argument(
        "--methods", nargs="+", help="only methods with such a text in their name"
    )
    return parser.parse_args()


def main() -> None:
    """Run, print, and write tests/benchmarks/results/field*.json."""
    arguments = _arguments()
    eyes = arguments.eyes or (CONDITIONS[:4:3] if arguments.quick else CONDITIONS)
    scenes = arguments.scenes or (SCENES[:1] if arguments.quick else SCENES)
    sizes = arguments.sizes or list(SIZES)[: 1 if arguments.quick else None]
    methods = [
        method
        for method in METHODS
        if not arguments.methods
        or any(text in method.name for text in arguments.methods)
    ]
    gpu = Gpu()
    machine = {**machine_info(), "gl_renderer": gpu.info["renderer"]}
    hardware = f"{machine['cpu']}, {machine['n_cores']} cores, {gpu.info['renderer']}"
    warmed_up(gpu, scene_view(scenes[0], width_px=320, height_px=180))
    rows = []
    for size in sizes:
        for eye in eyes:
            rows += bench_eye(
                gpu,
                eye,
                scenes,
                SIZES[size],
                methods,
                hardware,
                arguments.differences,
            )
    for eye in eyes:
        rows += published_rows(eye, hardware)
    content = _without_nan(report(rows, machine=machine))
    if arguments.json:
        print(json.dumps(content))
    else:
        print_rows(rows)
    if arguments.plot:
        plot_errors(rows, RESULTS / "field.png")
    if not (arguments.eyes or arguments.scenes or arguments.methods or arguments.quick):
        part = "" if len(sizes) == len(SIZES) else "_" + "_".join(sizes)
        write_report(f"field{part}", content)


def _without_nan(content: dict) -> dict:
    for row in content["rows"]:
        if np.isnan(row["memory_mb"]):
            row["memory_mb"] = None
    return content


if __name__ == "__main__":
    main()
