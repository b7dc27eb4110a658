"""Frames that the benchmarks of the engine gl filter: of arrays, or of textures."""

import time
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import moderngl
import numpy as np

from estimator.profiles.parse import parse_profile
from filter_service.gl.current_context import CurrentContext
from filter_service.gl.gpu import Gpu
from filter_service.gl.stage_timer import StageTimer
from filter_service.gl.staging import TimerQuery
from filter_service.gl.texture_io import TextureIo
from filter_service.planning.grid import GridSpec
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import PsfStore, build_psf_store
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.texture_view import GlTexture, TextureView
from filter_service.view_state import State
from tests.benchmarks.pass_work import FrameWork, counted_work
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
PUPIL_MM, FOCUS_DPT = 4.5, 0.5
STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": FOCUS_DPT}
STAGE_OF = {
    **dict.fromkeys(("begin_plan", "list_kernels", "plan_nodes"), "kernel_plan"),
    "plan_kernels": "kernel_plan",
    "build_fragments": "fragments",
    **dict.fromkeys(("blend_psfs", "blend_cells", "merge_psfs"), "psf_blend"),
    "merge_fragments": "merge",
    **dict.fromkeys(("count_bins", "scan_bins", "scatter_fragments"), "bin"),
    "sort_bins": "sort",
    "splat_tiles": "splat",
    "sample_input": "sample",
}
"""Stage of each pass, as in frames of arrays."""
REFERENCE = "native engine, same eye and state"


@dataclass(frozen=True)
class Case:
    """An eye and its view, in arrays, on both engines.

    Attributes
    ----------
    expected : (height, width, 3) array
        Image of the native engine, in linear light.
    work : FrameWork
        Work of all views of a frame whose state has changed.
    rooms : list of array
        Images of the last frame.
    """

    eye: str
    setting: str
    view: RgbdView
    renderer: FilterRenderer
    handles: list
    memory_mb: float
    error_db: float
    expected: np.ndarray
    work: FrameWork
    rooms: list[np.ndarray]

    def frame(self, state: dict) -> tuple[float, dict[str, float]]:
        """Filter the views of one frame; wall time and stages, ms."""
        stages_ms: dict[str, float] = {}
        start_s = time.perf_counter()
        begun = [
            self.renderer.begin(
                ViewRequest(self.view, handle, State(**state), output="srgb8", out=room)
            )
            for handle, room in zip(self.handles, self.rooms, strict=True)
        ]
        for finish in begun:
            for name, ms in finish().stage_times_ms.items():
                stages_ms[name] = stages_ms.get(name, 0.0) + ms
        return 1e3 * (time.perf_counter() - start_s), stages_ms

    def release(self) -> None:
        """Release the stores on the GPU."""
        for handle in self.handles:
            handle.release()


class TextureCase:
    """A case whose color, depth and result are textures of the current context.

    Attributes
    ----------
    error_db : float
        PSNR of a frame in half floats, in linear light.
    memory_mb : float
    incomplete_count : int
        Frames found to lack PSFs, or to show their input.
    """

    def __init__(self, case: Case, *, is_software: bool | None = None):
        view, self.eye, self.setting = case.view, case.eye, f"{case.setting} textures"
        self.work, self.incomplete_count = case.work, 0
        self._gpu = Gpu(current=CurrentContext())
        if is_software is not None:
            self._gpu.is_software = is_software
        self._renderer = FilterRenderer(self._gpu)
        stores = [handle.store for handle in case.handles]
        self.handles = [self._renderer.load(store) for store in stores]
        size_px = view.width_px, view.height_px
        new = self._gpu.context.texture
        rgba = np.dstack([view.color, np.full(view.depth_m.shape, 255, np.uint8)])
        color = new(size_px, 4, rgba.tobytes())
        depth = new(size_px, 1, view.depth_m.tobytes(), dtype="f4")
        targets = [new(size_px, 4) for _ in stores]
        self._kept: list[Any] = [color, depth, *targets]
        self._view = TextureView(
            GlTexture(color.glo, "rgba8"),
            GlTexture(depth.glo, "r32f"),
            *size_px,
            view.tangents,
            is_top_first=True,
        )
        self._targets = [GlTexture(target.glo, "rgba8") for target in targets]
        linear = new(size_px, 4, dtype="f2")
        self._submit(self.handles[0], GlTexture(linear.glo, "rgba16f"), STATE)
        seen = np.frombuffer(linear.read(), np.float16).reshape(
            *case.rooms[0].shape[:2], 4
        )
        self.error_db = psnr_db(seen[..., :3].astype(np.float32), case.expected)
        linear.release()
        self.memory_mb = self._gpu.memory_mb

    def _submit(self, handle, target: GlTexture, state: dict) -> None:
        shown = self._renderer.begin(
            ViewRequest(
                self._view,
                handle,
                State(**state),
                out=target,
                target_is_top_first=True,
            )
        )()
        earlier = shown.earlier
        if earlier and not (earlier.is_filtered and earlier.is_complete):
            self.incomplete_count += 1

    def submit(self, state: dict) -> float:
        """Submit the views of one frame; wall time of the calls, ms."""
        start_s = time.perf_counter()
        for handle, target in zip(self.handles, self._targets, strict=True):
            self._submit(handle, target, state)
        return 1e3 * (time.perf_counter() - start_s)

    def frame(self, state: dict) -> tuple[float, dict[str, float]]:
        """Submit a frame and wait for the GPU; wall time, ms, and that of the calls."""
        start_s = time.perf_counter()
        call_ms = self.submit(state)
        self._gpu.context.finish()
        return 1e3 * (time.perf_counter() - start_s), {"call": call_ms}

    def gpu_ms(self, state: dict, query: TimerQuery) -> float:
        """Return the time of a frame from its first to its last command, ms."""
        with query:
            self.submit(state)
        return query.elapsed_ns / 1e6

    def passes_ms(self, state: dict) -> dict[str, float]:
        """Return the times of a frame's passes, ms."""
        timer = StageTimer(self._gpu)
        programs = self._gpu.passes.programs.items()
        stages = {program: f"{STAGE_OF[key[0]]}_ms" for key, program in programs}

        def timed(function):
            def call(program, *arguments):
                with timer.stage(stages[program]):
                    function(program, *arguments)

            return call

        def draw(*arguments):
            with timer.stage("show_ms"):
                drawn(*arguments)

        shader, drawn = moderngl.ComputeShader, TextureIo.draw
        with (
            patch.object(shader, "run", timed(shader.run)),
            patch.object(shader, "run_indirect", timed(shader.run_indirect)),
            patch.object(TextureIo, "draw", draw),
        ):
            self.submit(state)
        return timer.result_ms()

    def new_query(self) -> TimerQuery:
        """Return a timer query of the context, which closes with it."""
        return self._gpu.acquire_query()

    def release(self) -> None:
        """Release all objects of the context."""
        for texture in self._kept:
            texture.release()
        for handle in self.handles:
            handle.release()
        self._gpu.close()


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


def view_and_store(eye: str, size_px: tuple[int, int]) -> tuple[RgbdView, PsfStore]:
    """Return the courtyard at a size, and the PSFs of an eye for it."""
    view, spec = view_and_spec(size_px)
    traced, _ = eye_for_spec(parse_profile(EYES[eye]), spec)
    return view, build_psf_store(traced, spec)


def open_case(gpu: Gpu, eye: str, setting: str, size_px, view_count: int) -> Case:
    """Build an eye's store, load it, judge a frame, and count its work."""
    view, store = view_and_store(eye, size_px)
    native = NativeRenderer()
    expected = native.render(view, native.load(store), **STATE).color
    native.close()
    renderer = FilterRenderer(gpu)
    handles = [renderer.load(store) for _ in range(view_count)]  # an eye for each view
    seen = renderer.render(view, handles[0], **STATE).color
    renderer.render(view, handles[0], output="srgb8", **STATE)  # merges less
    return Case(
        eye,
        setting,
        view,
        renderer,
        handles,
        gpu.memory_mb,
        psnr_db(seen, expected),
        expected,
        counted_work(renderer, view, handles[0]).times(view_count),
        [np.empty(view.color.shape, np.uint8) for _ in handles],
    )
