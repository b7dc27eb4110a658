"""A renderer and a build that are quick and leave traces, for tests of the protocol.

The renderer writes the profile's ``mark`` into the first pixel of what it returns, so a
test sees which eye a frame went through whatever its header says.
"""

import os
import signal
import time
from dataclasses import dataclass, field

import numpy as np

from filter_service.build_job import BuiltStore
from filter_service.errors import BuildCancelled, CameraMismatch, UnknownProfile
from filter_service.session import is_same_pitch


@dataclass
class StoreDouble:
    mark: int
    pixel_pitch_mrad: tuple[float, float]
    ballast: np.ndarray
    n_released: int = 0

    def release(self):
        self.n_released += 1


@dataclass
class RenderedDouble:
    color: np.ndarray
    stage_times_ms: dict
    missing_depth_count: int
    clamped_depth_count: int
    pupil_diameter_mm: float
    focus_dpt: float
    notes: list = field(default_factory=list)


class RendererDouble:
    """Inverts colours and takes the time it is told to take."""

    def __init__(self, filter_ms: float):
        self.filter_ms = filter_ms

    def load(self, store: StoreDouble) -> StoreDouble:
        assert store.ballast.sum() == store.ballast.size * store.mark
        return store

    def render(
        self,
        view,
        handle,
        *,
        pupil_diameter_mm,
        focus_dpt,
        accumulation="coverage",
        merge=True,
        output="linear",
    ):
        assert handle.n_released == 0, "rendered with a store that was freed"
        height_px, width_px = view.depth_m.shape
        left, right, up, down = view.tangents
        pitch = (1000 * (right - left) / width_px, 1000 * (up - down) / height_px)
        if not is_same_pitch(pitch, handle.pixel_pitch_mrad):
            raise CameraMismatch(f"pitch {pitch}", field="tangents")
        if pupil_diameter_mm == 8.75:
            raise ArithmeticError("the double breaks at 8.75 mm")
        start_s = time.perf_counter()
        time.sleep(self.filter_ms / 1000)
        if output == "srgb8":
            color = 255 - _as_bytes(view.color)
        else:
            color = np.float32(1) - _as_floats(view.color)
        color[0, 0] = handle.mark
        return RenderedDouble(
            color=color,
            stage_times_ms={"filter_ms": 1000 * (time.perf_counter() - start_s)},
            missing_depth_count=int(np.count_nonzero(~(view.depth_m > 0))),
            clamped_depth_count=0,
            pupil_diameter_mm=min(pupil_diameter_mm, 7.0),
            focus_dpt=focus_dpt,
            notes=[accumulation] if accumulation != "coverage" else [],
        )


def _as_bytes(color):
    if color.dtype == np.uint8:
        return color
    return np.rint(255 * np.nan_to_num(color)).astype(np.uint8)


def _as_floats(color):
    return color.astype(np.float32) / 255 if color.dtype == np.uint8 else color


def check_profile(body, settings):
    if body.get("kind") != "double":
        raise UnknownProfile(f"it is {body.get('kind')!r}", field="kind")
    mark = body.get("mark")
    if not isinstance(mark, int) or not 0 <= mark <= 255:
        raise UnknownProfile(f"it is {mark!r}", field="mark", allowed="0 to 255")


def build(job, *, progress, cancelled):
    """Take ``build_s``; ``crash``, ``deaf``, ``fail`` in the body do what they say."""
    body = job.body
    start_s = time.monotonic()
    build_s = body.get("build_s", 0.0)
    if body.get("crash"):
        os.kill(os.getpid(), signal.SIGKILL)
    if body.get("fail"):
        raise ValueError("the double was told to fail")
    while (elapsed_s := time.monotonic() - start_s) < build_s:
        progress(elapsed_s / build_s, "waiting")
        if cancelled() and not body.get("deaf"):
            raise BuildCancelled("cancelled")
        time.sleep(0.005)
    ballast = np.full(int(body.get("ballast_mb", 0.1) * 1e6), body["mark"], np.uint8)
    store = StoreDouble(body["mark"], job.pixel_pitch_mrad, ballast)
    return BuiltStore(store, 1000 * build_s, 1, ballast.nbytes / 1e6, ("a double",))
