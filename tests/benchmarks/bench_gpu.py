"""Frame time on a hardware GPU: passes, transfers and planning, with image error.

    python -m tests.benchmarks.bench_gpu [--quick] [--json] [--views NAME ...]

The courtyard over the whole visual field ("dynamic"), colour and depth in host memory,
8-bit sRGB in and out, one eye or two of a headset.  "moving": pupil and focus change
with every frame, so that its kernels are blended anew; "frozen": they stay.  Frames
come one after the other for two seconds before any is timed, for a GPU that rests
lowers its clock; the clocks stand with the machine, where nvidia-smi tells them.
"passes" is the sum of the GPU's own timers, "around" the rest of the wall time: copies
to and from the GPU, planning, calls of the driver.

Error: PSNR in linear light against the native engine, whose loops have no code in
common with the passes; its own error against the dense reference is in live.json.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimator.profiles.parse import parse_profile
from filter_service.gl.gpu import Gpu
from filter_service.planning.grid import GridSpec
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.frame_runs import states_towards
from tests.benchmarks.harness import (
    Row,
    machine_info,
    nvidia_smi,
    print_rows,
    report,
    write_report,
)
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import scene_view
from tests.numerical.synthetic import psnr_db

EYES = {
    "-6 dpt": {"kind": "prescription", "sphere_dpt": -6.0},
    "emmetropia": {"kind": "preset", "name": "emmetropia"},
    "keratoconus": {"kind": "preset", "name": "keratoconus"},
}
VIEWS = {
    "1280x720": ((1280, 720), 1),
    "2560x1440": ((2560, 1440), 1),
    "2 x 1832x1920": ((1832, 1920), 2),
}
QUICK_VIEWS = {"192x108": ((192, 108), 1), "2 x 96x100": ((96, 100), 2)}
QUICK_NAMES = dict(zip(VIEWS, ("192x108", "192x108", "2 x 96x100"), strict=True))
"""The small view that stands for a large one."""
PUPIL_MM, FOCUS_DPT = 4.5, 0.5
REFERENCE = "native engine, same eye and state"
HOST_STAGES = ("prepare_ms", "psf_plan_ms", "plan_ms", "upload_ms", "readback_ms")
"""Stages that are not passes: by the wall clock, but for the upload, whose timer on the
GPU waits for the processor to copy."""


@dataclass(frozen=True)
class Case:
    """An eye and its view, on both engines; pictures go where the last ones went."""

    eye: str
    setting: str
    view: RgbdView
    renderer: FilterRenderer
    handles: list
    memory_mb: float
    error_db: float
    rooms: list[np.ndarray]

    def frame(self, state: dict) -> tuple[float, dict[str, float]]:
        """Filter the views of one frame; wall time and stages, ms."""
        stages_ms: dict[str, float] = {}
        start_s = time.perf_counter()
        begun = [
            self.renderer.begin(
                ViewRequest(self.view, handle, output="srgb8", out=room, **state)
            )
            for handle, room in zip(self.handles, self.rooms, strict=True)
        ]
        for finish in begun:
            for name, ms in finish().stage_times_ms.items():
                stages_ms[name] = stages_ms.get(name, 0.0) + ms
        return 1e3 * (time.perf_counter() - start_s), stages_ms

    def rows(self, is_moving: bool, count: int, warm_s: float) -> Iterator[Row]:
        """Wall time, its parts, and the stages."""
        states = states_towards(
            self.handles[0].store.spec, PUPIL_MM, FOCUS_DPT, count if is_moving else 1
        )
        end_s, n = time.perf_counter() + warm_s, 0
        while time.perf_counter() < end_s or n < 3:
            self.frame(states[n % len(states)])
            n += 1
        frames = [self.frame(states[k % len(states)]) for k in range(count)]
        names = {name: None for _, stages_ms in frames for name in stages_ms}
        passes_ms = [
            sum(ms for name, ms in stages_ms.items() if name not in HOST_STAGES)
            for _, stages_ms in frames
        ]
        wall_ms = [wall_ms for wall_ms, _ in frames]
        yield self._row("frame", is_moving, wall_ms)
        yield self._row("  passes", is_moving, passes_ms)
        yield self._row("  around", is_moving, np.subtract(wall_ms, passes_ms))
        for name in names:
            times_ms = [stages_ms.get(name, 0.0) for _, stages_ms in frames]
            yield self._row(f"    {name.removesuffix('_ms')}", is_moving, times_ms)

    def _row(self, method: str, is_moving: bool, times_ms) -> Row:
        return Row(
            bench="gpu",
            method=method,
            case=self.eye,
            setting=f"{self.setting} {'moving' if is_moving else 'frozen'}",
            n=len(times_ms),
            median_ms=float(np.median(times_ms)),
            p95_ms=float(np.percentile(times_ms, 95)),
            memory_mb=self.memory_mb,
            error_name="psnr_db",
            error=self.error_db,
            reference=REFERENCE,
        )


def view_and_spec(size_px: tuple[int, int]) -> tuple[RgbdView, GridSpec]:
    """Return the courtyard at a size, and what its PSFs are made for."""
    width_px, height_px = size_px
    view = scene_view("courtyard", width_px=width_px, height_px=height_px)
    spec = grid_spec(
        width_px=width_px,
        height_px=height_px,
        tangents=view.tangents,
        pupil_range_mm=(4.0, 5.0),
        focus_range_dpt=(0.0, 1.0),
        mode="dynamic",
    )
    return view, spec


def open_case(gpu: Gpu, eye: str, setting: str, size_px, view_count: int) -> Case:
    """Build an eye's store, load it, and judge a frame."""
    view, spec = view_and_spec(size_px)
    traced, _ = eye_for_spec(parse_profile(EYES[eye]), spec)
    store = build_psf_store(traced, spec)
    state = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": FOCUS_DPT}
    native = NativeRenderer()
    expected = native.render(view, native.load(store), **state).color
    native.close()
    renderer = FilterRenderer(gpu)
    handles = [renderer.load(store) for _ in range(view_count)]  # an eye for each view
    seen = renderer.render(view, handles[0], **state).color
    return Case(
        eye,
        setting,
        view,
        renderer,
        handles,
        gpu.memory_mb,
        psnr_db(seen, expected),
        [np.empty(view.color.shape, np.uint8) for _ in handles],
    )


def chosen_views(names: list[str], *, is_quick: bool) -> dict:
    """Sizes and numbers of views, or of the small ones that stand for them."""
    if not is_quick:
        return {name: VIEWS[name] for name in names}
    return {QUICK_NAMES[name]: QUICK_VIEWS[QUICK_NAMES[name]] for name in names}


def main() -> None:
    """Run, print, and write tests/benchmarks/results/gpu.json on hardware."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="small frames, few")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--views", nargs="+", choices=VIEWS, default=list(VIEWS))
    options = parser.parse_args()
    gpu = Gpu()
    count, warm_s = (3, 0.0) if options.quick else (60, 2.0)
    rows, clocks = [], {}
    for setting, (size_px, view_count) in chosen_views(
        options.views, is_quick=options.quick
    ).items():
        for eye in EYES:
            case = open_case(gpu, eye, setting, size_px, view_count)
            for is_moving in (True, False):
                rows += case.rows(is_moving, count, warm_s)
            clocks[f"{setting} {eye}"] = nvidia_smi("clocks.sm,clocks.mem")
            for handle in case.handles:
                handle.release()
    machine = {**machine_info(), "gl_renderer": gpu.info["renderer"], "clocks": clocks}
    content = report(rows, machine=machine)
    if options.json:
        print(json.dumps(content))
    else:
        print_rows(rows)
    is_whole = not options.quick and options.views == list(VIEWS)
    if is_whole and not gpu.is_software:
        write_report("gpu", content)


if __name__ == "__main__":
    main()
