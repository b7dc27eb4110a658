"""Streams of frames whose eye changes in each: the demo's walk, a panned photograph."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from clients.scene_renderer import PATHS, path_moments
from filter_service.camera import Camera
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.photograph import motorcycle
from tests.numerical.scene_frames import scene_views

FOV_DEG = 50.0
PUPIL_MM, PUPIL_PERIOD_S = (2.9, 5.5), 6.0
FOCUS_DPT, FOCUS_PERIOD_S = (0.0, 2.5), 4.5
PAN_PERIOD_S, PAN_RATIO = 9.0, 1.25
"""The photograph is so much larger than a frame, and is panned over to and fro."""


@dataclass(frozen=True)
class Moment:
    """A frame and the state that it asks for."""

    view: RgbdView
    pupil_diameter_mm: float
    focus_dpt: float

    @property
    def state(self) -> dict[str, float]:
        """Arguments of a frame."""
        return {
            "pupil_diameter_mm": self.pupil_diameter_mm,
            "focus_dpt": self.focus_dpt,
        }


def _between(span: tuple[float, float], at_s: float, period_s: float) -> float:
    share = 0.5 + 0.5 * math.sin(2.0 * math.pi * at_s / period_s)
    return span[0] + (span[1] - span[0]) * share


def photograph_walk(
    size_px: tuple[int, int], count: int, rate_hz: float
) -> Sequence[Moment]:
    """Return a panned photograph under a moving pupil and focus."""
    width_px, height_px = size_px
    camera = Camera.from_fov(FOV_DEG, width_px=width_px, height_px=height_px)
    color, depth_m = motorcycle(
        math.ceil(PAN_RATIO * width_px), math.ceil(PAN_RATIO * height_px)
    )
    moments = []
    for number in range(count):
        at_s = number / rate_hz
        x, y = (
            int(_between((0.0, room), at_s, PAN_PERIOD_S * slower))
            for room, slower in (
                (color.shape[1] - width_px, 1.0),
                (color.shape[0] - height_px, 1.7),
            )
        )
        rows, columns = slice(y, y + height_px), slice(x, x + width_px)
        view = RgbdView(
            np.ascontiguousarray(color[rows, columns]),
            np.ascontiguousarray(depth_m[rows, columns]),
            camera.tangents,
        )
        moments.append(
            Moment(
                view,
                _between(PUPIL_MM, at_s, PUPIL_PERIOD_S),
                _between(FOCUS_DPT, at_s, FOCUS_PERIOD_S),
            )
        )
    return moments


def courtyard_walk(size_px: tuple[int, int], count: int) -> list[Moment]:
    """Return the demo's walk through the courtyard in so many frames."""
    views = scene_views(
        "courtyard", width_px=size_px[0], height_px=size_px[1], count=count
    )
    states = path_moments(PATHS["courtyard"], count)
    return [
        Moment(view, state.pupil_diameter_mm, state.focus_dpt)
        for view, state in zip(views, states, strict=True)
    ]


def demo_walk(size_px: tuple[int, int], count: int, rate_hz: float) -> Sequence[Moment]:
    """Return the demo's walk through the courtyard, at the pace of a stream."""
    walk = courtyard_walk(size_px, 96)
    return [walk[number * 96 // count] for number in range(count)]
