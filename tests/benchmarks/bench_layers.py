"""Layers, memory and times of the PSF cache by eye: tables 6 and 9 of the paper.

One row for building the cache of an eye (of one pupil on the axis as in table 6; of
pupils of 2 to 6 mm and foci of 0 to 4 dpt over the field as in table 9) and one for
making a frame's kernels from it, at 1280x720.  The paper's figures, on a TITAN Xp,
stand in the setting.  Error: PSNR in linear light of the unmerged frame against one
through a cache for just its pupil and focus, planned for 62 dB, or on the axis with a
quarter of the blur step.
"""

import time

import numpy as np

from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.paper_page.published import table
from tests.benchmarks.rows import row_of
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db

MINUTES = 2
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
LAYERS, TEXTURE_MIB = (table(6)[key]["proposed"] for key in ("layers", "memory_mib"))
CACHE = table(9)["dynamic"]


def rendered(renderer, view, store):
    """Render a frame through a store that no other frame has used."""
    handle = renderer.load(store)
    frame = renderer.render(view, handle, **STATE, merge=False)
    handle.release()
    return frame


def rows_of(renderer, view, name: str, mode: str) -> list[Row]:
    """Return the rows of building, and of a frame's kernels, of one eye and mode."""
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
    theirs = f"{LAYERS[name]} layers, {TEXTURE_MIB[name]} MB"
    if mode == "dynamic":
        theirs = f"{CACHE['cache_gib'][name]} GB cache, {CACHE['texture_mib'][name]} MB"
    return [
        row_of(
            *("layers", method, name, f"{mode}: {setting}; theirs {theirs}", [time_ms]),
            *("psnr_db", error_db, "frame through a finer cache of this state"),
            used_mb=used_mb,
        )
        for method, setting, time_ms, used_mb in (
            ("cache", f"{store.psf_count} PSFs", build_ms, store.memory_mb),
            (
                "frame kernels",
                f"{frame.kernel_count} kernels of {frame.layer_count} layers",
                times_ms["psf_plan_ms"] + times_ms["psf_blend_ms"],
                1e-6 * ATLAS_TEXEL_BYTES * frame.kernel_texel_count,
            ),
        )
    ]


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes, or of one on the axis."""
    renderer = NativeRenderer()
    view = scene_view("courtyard", width_px=1280, height_px=720)
    return [
        row
        for name in (["emmetropia"] if run.is_quick else LAYERS)
        for mode in (["on-axis"] if run.is_quick else GRIDS)
        for row in rows_of(renderer, view, name, mode)
    ]
