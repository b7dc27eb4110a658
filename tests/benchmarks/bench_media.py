"""Frames with straylight and yellowing: cost, and error of the scattered light.

    python -m tests.benchmarks.bench_media [--quick] [--json]

A frame of 1280x720 through the native engine, state changing with each frame, without
and with what the media do; and the pass alone.  Error is the largest logarithm of light
about a lamp over the CIE total glare function, from 1 to 20 deg, and the least PSNR of
leaving straylight or yellowing out (linear light, 1 is white).  Writes
results/media.json.
"""

import argparse
import time

import numpy as np

from estimator.media import Straylight, cie_glare_per_sr
from estimator.profiles.parse import parse_profile
from filter_service.camera import Camera
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.media_effects import (
    MediaEffects,
    add_haze,
    begin_through_media,
)
from filter_service.rendering.native import NativeRenderer
from filter_service.view_state import State
from tests.benchmarks.frame_runs import states_towards
from tests.benchmarks.harness import Row, memory_mb, publish
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view

SIZE, QUICK_SIZE = (1280, 720), (320, 180)
COUNT, QUICK_COUNT = 40, 5
EYES = {
    "none": {},
    "25 years": {"straylight": {}},
    "70 years": {"age_years": 70, "straylight": {}},
    "nuclear cataract, 70 years": {
        "age_years": 70,
        "straylight": {"cataract": "nuclear"},
    },
    "yellowing, 70 years": {"age_years": 70, "yellowing": "seen"},
    "both, 70 years": {"age_years": 70, "straylight": {}, "yellowing": "seen"},
}
PUPIL_MM, FOCUS_DPT = 4.5, 0.5
ANGLES_DEG = (1.0, 2.0, 5.0, 10.0, 20.0)


def lamp_error(camera: Camera, straylight: Straylight) -> float:
    """Largest |log10| of the light to the right of a lamp over the CIE function."""
    y, x = camera.height_px // 2, camera.width_px // 2
    color = np.zeros((camera.height_px, camera.width_px, 3), np.float32)
    color[y, x] = 1e6
    add_haze(color, camera, straylight)
    left, right, _, _ = camera.tangents
    pitch = (right - left) / camera.width_px
    angles_deg = np.degrees(np.arctan(pitch * (np.arange(camera.width_px) - x)))
    pixel_sr = np.prod(np.array(camera.pixel_pitch_mrad) / 1e3)
    logs = []
    for wanted_deg in ANGLES_DEG:
        at = int(np.argmin(np.abs(angles_deg - wanted_deg)))
        per_sr = cie_glare_per_sr(
            angles_deg[at],
            age_years=straylight.age_years,
            pigmentation=straylight.pigment_ratio,
        )
        logs.append(np.log10(float(color[y, at, 1]) / (1e6 * pixel_sr) / per_sr))
    return float(np.abs(logs).max())


def rows_of(size: tuple[int, int], count: int):
    """Frames with each of the effects, in turn."""
    view = scene_view("courtyard", width_px=size[0], height_px=size[1])
    spec = grid_spec(
        width_px=size[0],
        height_px=size[1],
        tangents=view.tangents,
        pupil_range_mm=(4.0, 5.0),
        focus_range_dpt=(0.0, 1.0),
        mode="dynamic",
    )
    profiles = {
        name: parse_profile({"kind": "preset", "name": "emmetropia", **more})
        for name, more in EYES.items()
    }
    eye, _ = eye_for_spec(profiles["none"], spec)
    engine = NativeRenderer()
    handle = engine.load(build_psf_store(eye, spec))
    states = states_towards(spec, PUPIL_MM, FOCUS_DPT, count)
    times_ms: dict[str, list[float]] = {name: [] for name in EYES}
    alone_ms: dict[str, list[float]] = {name: [] for name in EYES}
    colors = {}
    effects = {
        name: MediaEffects.of(profile, "common") for name, profile in profiles.items()
    }
    for k, state in enumerate([states[0], states[0], *states]):
        for name in EYES:
            start_s = time.perf_counter()
            request = ViewRequest(view, handle, State(**state), output="srgb8")
            seen = begin_through_media(engine, request, effects[name])()
            elapsed_ms = 1e3 * (time.perf_counter() - start_s)
            if k >= 2:
                times_ms[name].append(elapsed_ms)
                alone_ms[name].append(seen.stage_times_ms.get("media_ms", 0.0))
    for name in EYES:
        request = ViewRequest(view, handle, State(**states[0]), output="linear")
        seen = begin_through_media(engine, request, effects[name])()
        colors[name] = seen.color.astype(np.float64)
    engine.close()
    setting = f"{size[0]}x{size[1]}"
    for name in EYES:
        square = float(np.mean((colors[name] - colors["none"]) ** 2))
        psnr_db = -10.0 * np.log10(square) if square > 0.0 else float("inf")
        for label, values in (
            ("frame", times_ms[name]),
            ("pass alone", alone_ms[name]),
        ):
            yield Row(
                *("media", label, name, setting, len(values)),
                float(np.median(values)),
                float(np.percentile(values, 95)),
                *(memory_mb(), "psnr_db of leaving it out", psnr_db, "our own frame"),
            )
    ages = {"25 years": Straylight(25.0), "70 years": Straylight(70.0)}
    for name, straylight in ages.items():
        start_s = time.perf_counter()
        error = lamp_error(view.camera, straylight)
        elapsed_ms = 1e3 * (time.perf_counter() - start_s)
        yield Row(
            *("media", "lamp", name, setting, len(ANGLES_DEG), elapsed_ms, elapsed_ms),
            *(memory_mb(), "log10 over the CIE function", error, "CIE 135/1-1999"),
        )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="320x180")
    parser.add_argument("--json", action="store_true", help="print the report alone")
    options = parser.parse_args()
    size, count = (QUICK_SIZE, QUICK_COUNT) if options.quick else (SIZE, COUNT)
    rows = list(rows_of(size, count))
    publish("media", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
