"""Frames of *Courtyard* through planned caches against a dense one, by the renderer.

The dense cache is planned for 62 dB and for the one pupil and focus of the frame, so
that nothing is blended over those.
"""

import math
import time

import numpy as np

from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.store import build_psf_store
from tests.benchmarks.engines import open_renderer
from tests.benchmarks.harness import Row
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.scene_frames import scene_view

SIZE = {"width_px": 480, "height_px": 270, "object_range_dpt": (0.0, 3.0)}
DENSE_DB = 62.0
STATES = {  # pupils and foci of the cache; of the frames
    "quality": ({"pupil_range_mm": (5.0, 5.0), "focus_range_dpt": (0.5, 0.5)},) * 2,
    "dynamic": (
        {"pupil_range_mm": (2.0, 7.0), "focus_range_dpt": (0.0, 3.0)},
        {"pupil_range_mm": (4.4, 4.4), "focus_range_dpt": (0.7, 0.7)},
    ),
}


class _Frames:
    """Renders the middle frame of the scene through plans."""

    def __init__(self):
        self.view = scene_view("courtyard", width_px=480, height_px=270)
        self.renderer = open_renderer()

    def filtered(self, eye, spec, plan, state):
        """Linear image; time in ms and MB of its cache."""
        start_s = time.perf_counter()
        store = build_psf_store(eye, spec, plan=plan)
        build_ms = 1e3 * (time.perf_counter() - start_s)
        rendered = self.renderer.render(
            self.view,
            self.renderer.load(store),
            pupil_diameter_mm=state["pupil_range_mm"][0],
            focus_dpt=state["focus_range_dpt"][0],
            merge=False,
            output="linear",
        )
        return np.asarray(rendered.color, float), build_ms, store.memory_mb


def frame_rows(eyes) -> list[Row]:
    """Predicted and rendered rows over eyes, modes and tolerances."""
    frames = _Frames()
    rows = []
    for name in eyes:
        for mode, (cached, state) in STATES.items():
            dense_spec = spec_for(mode=mode, **SIZE, **state)
            dense_eye = traced_eye(name, dense_spec)
            dense_plan = unchecked_plan(dense_eye, dense_spec, target_db=DENSE_DB)
            reference, _, _ = frames.filtered(dense_eye, dense_spec, dense_plan, state)
            for tolerance in ("loose", "normal", "fine"):
                spec = spec_for(mode=mode, tolerance=tolerance, **SIZE, **cached)
                eye = traced_eye(name, spec)
                plan = unchecked_plan(eye, spec)
                image, *cost = frames.filtered(eye, spec, plan, state)
                error_db = -10.0 * math.log10(np.mean((image - reference) ** 2))
                rows += _rows(name, f"{mode} {tolerance}", plan, *cost, error_db)
    return rows


def _rows(name, setting, plan, build_ms, built_mb, error_db) -> list[Row]:
    predicted = plan.prediction
    common = {
        "bench": "plan",
        "case": name,
        "setting": f"{setting} frame 480 px",
        "n": predicted.psf_count,
        "error_name": "psnr_db",
        "reference": f"Courtyard through a cache planned for {DENSE_DB:g} dB",
    }
    return [
        Row(
            method="predicted",
            median_ms=1e3 * predicted.build_s,
            p95_ms=1e3 * predicted.build_s,
            memory_mb=predicted.memory_mb,
            error=predicted.interpolation_db,
            **common,
        ),
        Row(
            method="rendered",
            median_ms=build_ms,
            p95_ms=build_ms,
            memory_mb=built_mb,
            error=error_db,
            **common,
        ),
    ]
