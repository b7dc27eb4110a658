"""Layers, memory and times of the PSF cache by eye: Tables 6 and 9 of the paper.

Usage: python -m tests.benchmarks.bench_layers [--quick] [--json] [--engine NAME]

One row for building the cache of an eye (of one pupil on axis as in Table 6; of pupils
from 2 to 6 mm and foci from 0 to 4 dpt over the field as in Table 9) and one for making
a frame's kernels from it, at 1280x720.  The paper's figures, on a TITAN Xp, stand in
the setting.  Error: PSNR in linear light of the unmerged frame against one through a
cache for just its pupil and focus, planned for 62 dB, or on axis with a quarter of the
blur step.
"""

import argparse
import json
import time

import numpy as np

from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.store import build_psf_store
from tests.benchmarks.engines import ENGINES, open_renderer
from tests.benchmarks.harness import (
    Row,
    machine_info,
    print_rows,
    report,
    write_report,
)
from tests.benchmarks.paper_page.published import table
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db

SIZE = {"width_px": 1280, "height_px": 720, "object_range_dpt": (0.0, 8.0)}
PUPIL_MM, FOCUS_DPT = 5.0, 0.5
STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": FOCUS_DPT}
THIS_STATE = {"pupil_range_mm": (PUPIL_MM,) * 2, "focus_range_dpt": (FOCUS_DPT,) * 2}
GRIDS = {
    "on-axis": THIS_STATE,
    "dynamic": {"pupil_range_mm": (2.0, 6.0), "focus_range_dpt": (0.0, 4.0)},
}
REFERENCE_DB = 62.0
REFERENCE_STEP_PX = 0.125
ATLAS_TEXEL_BYTES = 16
_TEXTURE, _CACHE = table(6), table(9)["dynamic"]
PAPER = {  # layers and texture MB on axis (Table 6); cache GB, texture MB (Table 9)
    eye: (
        (layers, _TEXTURE["memory_mib"]["proposed"][eye]),
        (_CACHE["cache_gib"][eye], _CACHE["texture_mib"][eye]),
    )
    for eye, layers in _TEXTURE["layers"]["proposed"].items()
}
THEIRS = {
    "on-axis": "theirs {} layers, {} MB",
    "dynamic": "theirs {} GB cache, {} MB",
}


def rendered(renderer, view, store):
    """Frame through a store that no other frame has used."""
    handle = renderer.load(store)
    frame = renderer.render(view, handle, **STATE, merge=False)
    handle.release()
    return frame


def rows_of(renderer, view, name: str, mode: str) -> list[Row]:
    """Building, and the frame's kernels, of one eye and mode."""
    exact_spec = spec_for(
        mode=mode, max_blur_step_px=REFERENCE_STEP_PX, **SIZE, **THIS_STATE
    )
    eye = traced_eye(name, exact_spec)
    exact = unchecked_plan(eye, exact_spec, target_db=REFERENCE_DB)
    truth = rendered(renderer, view, build_psf_store(eye, exact_spec, plan=exact))

    spec = spec_for(mode=mode, **SIZE, **GRIDS[mode])
    eye = traced_eye(name, spec)
    start_s = time.perf_counter()
    store = build_psf_store(eye, spec, plan=unchecked_plan(eye, spec))
    build_ms = 1e3 * (time.perf_counter() - start_s)
    rendered(renderer, view, store)  # compiles
    frame = rendered(renderer, view, store)
    times_ms = frame.stage_times_ms
    error_db = psnr_db(frame.color, truth.color.astype(np.float64))
    theirs = THEIRS[mode].format(*PAPER[name][mode == "dynamic"])

    def row(method: str, setting: str, time_ms: float, memory_mb: float) -> Row:
        return Row(
            bench="layers",
            method=method,
            case=name,
            setting=f"{mode}: {setting}; {theirs}",
            n=1,
            median_ms=time_ms,
            p95_ms=time_ms,
            memory_mb=memory_mb,
            error_name="psnr_db",
            error=error_db,
            reference="frame through a finer cache of this state",
        )

    return [
        row("cache", f"{store.psf_count} PSFs", build_ms, store.memory_mb),
        row(
            "frame kernels",
            f"{frame.kernel_count} kernels of {frame.layer_count} layers",
            times_ms["psf_plan_ms"] + times_ms["psf_blend_ms"],
            1e-6 * ATLAS_TEXEL_BYTES * frame.kernel_texel_count,
        ),
    ]


def main() -> None:
    """Run, print, and write tests/benchmarks/results/layers.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one eye")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    arguments = parser.parse_args()
    renderer = open_renderer(arguments.engine)
    view = scene_view("courtyard", width_px=1280, height_px=720)
    eyes = ["emmetropia"] if arguments.quick else list(PAPER)
    rows = [
        row
        for name in eyes
        for mode in GRIDS
        for row in rows_of(renderer, view, name, mode)
    ]
    content = report(rows, machine={**machine_info(), "renderer": renderer.name})
    if arguments.json:
        print(json.dumps(content))
        return
    print_rows(rows)
    if not arguments.quick:
        write_report("layers", content)


if __name__ == "__main__":
    main()
