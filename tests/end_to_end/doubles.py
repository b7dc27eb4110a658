"""A renderer and a build that are quick and leave traces, for tests of the protocol.

The renderer writes the profile's ``mark`` into the first pixel of what it returns, so a
test sees which eye a frame went through whatever its header says.
"""

import os
import signal
import time
from dataclasses import dataclass

import numpy as np

from filter_service.building.jobs import BuiltStore
from filter_service.camera import is_same_camera
from filter_service.errors import BuildCancelled, CameraMismatch, UnknownProfile
from filter_service.messages import Camera
from filter_service.rendering.engine import ViewResult
from filter_service.view_state import State


@dataclass
class StoreDouble:
    mark: int
    camera: Camera
    follows_field: bool
    ballast: np.ndarray
    filter_ms: float | None
    n_released: int = 0
    computed_count: int = 1
    tables_mb: float = 0.0

    @property
    def memory_mb(self):
        return self.ballast.nbytes / 1e6

    def release(self):
        self.n_released += 1

    def missing_psfs(self, use=None, *, state=None):
        return np.zeros(0, np.int64)

    def state_nodes(self, state):
        return ()

    def is_planned(self, nodes):
        return True

    def evict(self, max_mb):
        """Nothing goes."""


class EngineDouble:
    """Inverts colors in the time that the profile or else the command states."""

    name = "numpy double"
    importer = None
    memory_mb = 0.0

    def __init__(self, filter_ms: float):
        self.filter_ms = filter_ms

    def trim(self):
        """Nothing is held."""

    def call_between(self, function, interval_s):
        """Frames are not long here."""
        return False

    def load(self, store: StoreDouble):
        """Read the ballast, as a copy to a GPU would."""
        assert (store.ballast == store.mark).all()
        return store

    def begin(self, request):
        view, handle = request.view, request.handle
        state, output = request.state, request.output
        accumulation = request.options.accumulation
        assert handle.n_released == 0, "rendered with a store that was freed"
        height_px, width_px = view.depth_m.shape
        camera = Camera(width_px, height_px, view.tangents)
        if not is_same_camera(
            handle.camera, camera, follows_field=handle.follows_field
        ):
            raise CameraMismatch(f"{camera}", field="tangents")
        if state.pupil_diameter_mm == 8.75:
            raise ArithmeticError("the double breaks at 8.75 mm")
        start_s = time.perf_counter()
        filter_ms = self.filter_ms if handle.filter_ms is None else handle.filter_ms
        time.sleep(filter_ms / 1000)
        if output == "srgb8":
            color = 255 - _as_bytes(view.color)
        else:
            color = np.float32(1) - _as_floats(view.color)
            if output == "linear16":
                color = color.astype(np.float16)
        color[0, 0] = handle.mark
        request.times.add("filter_ms", 1000 * (time.perf_counter() - start_s))
        found = ViewResult(
            color=color,
            stage_times_ms=request.times.ms,
            missing_depth_count=int(np.count_nonzero(~(view.depth_m > 0))),
            state=State(
                min(state.pupil_diameter_mm, 7.0),
                state.focus_dpt,
                state.gaze_deg or (0.0, 0.0),
            ),
            notes=(accumulation,) if accumulation != "coverage" else (),
        )
        return lambda: found


def _as_bytes(color):
    if color.dtype == np.uint8:
        return color
    return np.rint(255 * np.nan_to_num(color)).astype(np.uint8)


def _as_floats(color):
    return color.astype(np.float32) / 255 if color.dtype == np.uint8 else color


@dataclass(frozen=True)
class ProfileDouble:
    body: dict
    straylight: None = None
    yellowing: None = None
    spectacle_magnification: bool = False


def read_profile(body):
    if body.get("crash_reading"):
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(body.get("read_s", 0.0))
    if body.get("kind") != "double":
        raise UnknownProfile(f"it is {body.get('kind')!r}", field="kind")
    mark = body.get("mark")
    if not isinstance(mark, int) or not 0 <= mark <= 255:
        raise UnknownProfile(f"it is {mark!r}", field="mark", allowed="0 to 255")
    return ProfileDouble(body)


def build(job, *, progress, cancelled):
    """Take ``build_s``; ``crash``, ``deaf``, ``fail``, ``hang`` do what they say."""
    body = job.profile.body
    if body.get("crash"):
        os.kill(os.getpid(), signal.SIGKILL)
    if body.get("fail"):
        raise ValueError("the double was told to fail")
    _work(body.get("build_s", 0.0), body, progress, cancelled)
    ballast = np.full(int(body.get("ballast_mb", 0.1) * 1e6), body["mark"], np.uint8)
    follows_field, filter_ms = job.settings.follows_field, body.get("filter_ms")
    store = StoreDouble(body["mark"], job.camera, follows_field, ballast, filter_ms)
    return BuiltStore(store, ("a double",))


def _work(build_s, body, progress, cancelled):
    start_s = time.monotonic()
    while (elapsed_s := time.monotonic() - start_s) < build_s:
        progress(0.0 if body.get("hang") else elapsed_s / build_s, "waiting")
        if cancelled() and not body.get("deaf"):
            raise BuildCancelled("cancelled")
        time.sleep(0.005)
