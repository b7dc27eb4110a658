"""Frame time and PSNR by pass, with a sorted gather in the same run.

Usage: python -m tests.benchmarks.bench_render [--quick] [--json] [--engine NAME]

Pupil and focus change from frame to frame, so that its kernels are made anew; the row
"tiles frozen" repeats one state.
Error: PSNR in linear light against the float64 sorted gather with the same layers.
"""

import argparse
import json
import time

import numpy as np

from estimator.profiles.parse import parse_profile
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import build_psf_store
from filter_service.view_state import State
from tests.benchmarks.engines import ENGINES, open_renderer, working_memory_mb
from tests.benchmarks.frame_runs import timed_frames
from tests.benchmarks.harness import (
    Row,
    machine_info,
    memory_mb,
    print_rows,
    report,
    write_report,
)
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db
from tests.reference import render_passes as reference

REFERENCE = "float64 sorted gather, same layers"
PUPIL_MM = 5.0
FOCUS_DPT = 0.5
STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": FOCUS_DPT}
EYES = {
    "emmetropia": {"kind": "preset", "name": "emmetropia"},
    "-6 dpt": {"kind": "prescription", "sphere_dpt": -6.0},
    "keratoconus": {"kind": "preset", "name": "keratoconus"},
}
VARIANTS = {
    "tiles": {},
    "tiles frozen": {"frozen": True},
    "tiles unmerged": {"merge": False},
    "tiles paper rule": {"accumulation": "paper"},
}


def bench_case(renderer, scene, size, eye, body, repeats) -> list[Row]:
    """Rows of one scene, size and eye."""
    view = scene_view(scene, width_px=size[0], height_px=size[1])
    spec = grid_spec(
        width_px=size[0],
        height_px=size[1],
        tangents=view.tangents,
        pupil_range_mm=(PUPIL_MM, PUPIL_MM),
    )
    store = build_psf_store(parse_profile(body), spec)
    layers = frame_layers(store, State(**STATE))
    handle = renderer.load(store)
    setting = f"{scene} {size[0]}x{size[1]}"

    def row(method, n, median_ms, p95_ms, error_db) -> Row:
        return Row(
            bench="render",
            method=method,
            case=eye,
            setting=setting,
            n=n,
            median_ms=median_ms,
            p95_ms=p95_ms,
            memory_mb=(
                working_memory_mb(renderer)
                if method.startswith("tiles")
                else memory_mb()
            ),
            error_name="psnr_db",
            error=error_db,
            reference=REFERENCE,
        )

    reference.gather(view, store, layers)  # compiles
    truth, gather_ms = {}, []
    for rule in ("coverage", "paper"):
        start_s = time.perf_counter()
        truth[rule] = reference.gather(view, store, layers, accumulation=rule)
        gather_ms.append(1e3 * (time.perf_counter() - start_s))
    rows = [
        row("gather" + " paper rule" * (rule == "paper"), 1, ms, ms, float("inf"))
        for rule, ms in zip(truth, gather_ms, strict=True)
    ]
    for method, options in VARIANTS.items():
        run = timed_frames(renderer, view, handle, **STATE, repeats=repeats, **options)
        error_db = psnr_db(
            run.last.color, truth[options.get("accumulation", "coverage")]
        )
        rows.append(row(method, repeats, run.median_ms, run.p95_ms, error_db))
        if method == "tiles":
            rows += pass_rows(row, run.frames, error_db)
    handle.release()
    return rows


def pass_rows(row, results, error_db) -> list[Row]:
    """One row a pass; the error is the frame's."""
    rows = []
    for name in results[-1].stage_times_ms:
        times_ms = [result.stage_times_ms[name] for result in results]
        label = "tiles: " + name.removesuffix("_ms")
        median_ms, p95_ms = np.median(times_ms), np.percentile(times_ms, 95)
        rows.append(
            row(label, len(times_ms), float(median_ms), float(p95_ms), error_db)
        )
    return rows


def main() -> None:
    """Run, print, and write tests/benchmarks/results/render*.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="320x180, courtyard only")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    arguments = parser.parse_args()
    renderer = open_renderer(arguments.engine)
    sizes = [(320, 180)] if arguments.quick else [(320, 180), (1280, 720)]
    scenes = ["courtyard"] if arguments.quick else ["courtyard", "primitives"]
    repeats = 3 if arguments.quick else 7
    rows = [
        row
        for size in sizes
        for scene in scenes
        for eye, body in EYES.items()
        for row in bench_case(renderer, scene, size, eye, body, repeats)
    ]
    content = report(rows, machine={**machine_info(), "renderer": renderer.name})
    if arguments.json:
        # JSON has no infinity: the gather is its own reference.
        print(json.dumps(_finite(content)))
        return
    print_rows(rows)
    if not arguments.quick:
        write_report("render", _finite(content))


def _finite(content: dict) -> dict:
    for row in content["rows"]:
        if not np.isfinite(row["error"]):
            row["error"] = None
    return content


if __name__ == "__main__":
    main()
