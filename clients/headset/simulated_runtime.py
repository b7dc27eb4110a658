"""Simulated headset runtime with a scripted head, for tests and previews.

It enforces the rules of OpenXR that matter here: each frame ends before the next one
begins, and each view that is shown has a pose.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from clients.headset.poses import matrix_of, turned
from clients.headset.runtime import (
    EYES,
    DueFrame,
    EyeView,
    GazeSample,
    SessionEnded,
    SessionLost,
    ShownView,
)
from filter_service.messages import Pose

EYE_DISTANCE_M = 0.063
EYE_LEVEL_M = 0.0
LEFT_EDGES_DEG = (-50.0, 42.0, 43.0, -48.0)
"""Edges of the left eye's display (left, right, up, down), which are mirrored for the
right eye."""

NS_PER_S = 1e9


def swaying(at_s: float) -> Pose:
    """Return the head pose of a standing person who looks around."""
    yaw_deg = 8.0 * math.sin(2.0 * math.pi * at_s / 6.0)
    pitch_deg = 3.0 * math.sin(2.0 * math.pi * at_s / 4.0)
    side_m = 0.03 * math.sin(2.0 * math.pi * at_s / 5.0)
    return (side_m, EYE_LEVEL_M, 0.0, *turned(yaw_deg, pitch_deg))


def still(_at_s: float) -> Pose:
    """Return a head pose that does not move."""
    return (0.0, EYE_LEVEL_M, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass
class Happening:
    """Simulated events and sensor values, which tests change between frames.

    Attributes
    ----------
    should_render : bool
        Whether the person wears the headset.
    is_lost : bool
        Whether the next call raises `SessionLost`.
    is_ended : bool
        Whether the next frame raises `SessionEnded`.
    is_paused : bool
        Whether no frame is due.
    gaze_deg : (h, v), optional
        Gaze measured by an eye tracker; None simulates no tracker.
    pupil_diameter_mm : float, optional
        Pupil measured by an eye tracker.
    pressed : list of str
        Names of the buttons that the next frame reports.
    """

    should_render: bool = True
    is_lost: bool = False
    is_ended: bool = False
    is_paused: bool = False
    gaze_deg: tuple[float, float] | None = None
    pupil_diameter_mm: float | None = None
    pressed: list[str] = field(default_factory=list)


class SimulatedRuntime:
    """Headset runtime without a headset.

    Parameters
    ----------
    size_px : (int, int)
        Width and height of each eye's image.
    rate_hz : float
        Maximum number of frames per second.
    head_at : callable
        Function that returns the head pose at a time in seconds.
    happening : Happening, optional
        Simulated events and sensor values.
    on_shown : callable, optional
        Called with (due, shown) for each frame that ends.
    finish : callable, optional
        Function that waits for images in textures, as a display does.
    """

    name = "simulated headset"
    notes: Sequence[str] = ()
    has_depth = True

    def __init__(
        self,
        size_px: tuple[int, int] = (448, 504),
        *,
        rate_hz: float = 72.0,
        head_at: Callable[[float], Pose] = swaying,
        happening: Happening | None = None,
        on_shown: Callable[[DueFrame, Sequence[ShownView]], None] | None = None,
        finish: Callable[[], None] = lambda: None,
    ) -> None:
        if not 0.0 < rate_hz <= 1000.0:
            raise ValueError(f"rate_hz is {rate_hz}; allowed: above 0, up to 1000")
        if min(size_px) < 1:
            raise ValueError(f"size_px is {size_px}; allowed: 1 px or more")
        self.size_px = size_px
        self.happening = happening or Happening()
        self.tracks_eyes = self.happening.gaze_deg is not None
        self._period_s = 1.0 / rate_hz
        self._head_at = head_at
        self._on_shown, self._finish = on_shown, finish
        self._start_s = time.monotonic()
        self._next_s = 0.0
        self._begun: DueFrame | None = None

    def begin_frame(self) -> DueFrame | None:
        """Wait for the next frame."""
        happening = self.happening
        if happening.is_lost:
            raise SessionLost("the simulated session is lost")
        if happening.is_ended:
            raise SessionEnded("the simulated session was ended")
        if self._begun is not None:
            raise RuntimeError("a frame begins before the previous one has ended")
        if happening.is_paused:
            time.sleep(self._period_s)
            return None
        self._wait()
        at_s = self._next_s
        head = self._head_at(at_s)
        gaze = happening.gaze_deg
        pressed, happening.pressed = tuple(happening.pressed), []
        self._begun = DueFrame(
            int(NS_PER_S * at_s),
            happening.should_render,
            eye_views(head),
            head,
            None if gaze is None else GazeSample(*gaze, at_s=at_s),
            pressed,
            self._period_s,
            happening.pupil_diameter_mm,
        )
        return self._begun

    def _wait(self) -> None:
        """Sleep until the next frame of the display; skip missed frames."""
        now_s = time.monotonic() - self._start_s
        missed = math.floor((now_s - self._next_s) / self._period_s)
        self._next_s += self._period_s * (1 + max(0, missed))
        time.sleep(max(0.0, self._next_s - now_s))

    def end_frame(self, due: DueFrame, shown: Sequence[ShownView]) -> None:
        """Show a frame."""
        if due is not self._begun:
            raise RuntimeError("a frame ends that has not begun")
        self._begun = None
        if self.happening.is_lost:
            raise SessionLost("the simulated session is lost")
        for view in shown:
            if view.size_px != self.size_px:
                raise ValueError(f"color of {view.size_px}; expected {self.size_px}")
            depth_m, (width, height) = view.depth_m, self.size_px
            if isinstance(depth_m, np.ndarray) and depth_m.shape != (height, width):
                raise ValueError(
                    f"depth of shape {depth_m.shape}; expected {(height, width)}"
                )
        self._finish()
        if self._on_shown is not None:
            self._on_shown(due, shown)

    def close(self) -> None:
        """Do nothing: there are no resources to release."""


def eye_views(head: Pose) -> tuple[EyeView, EyeView]:
    """Return the views of both eyes for a head pose."""
    matrix = matrix_of(head)
    left, right, up, down = (math.tan(math.radians(e)) for e in LEFT_EDGES_DEG)
    found = []
    for eye, side, tangents in zip(
        EYES,
        (-0.5, 0.5),
        ((left, right, up, down), (-right, -left, up, down)),
        strict=True,
    ):
        place = matrix[:3, 3] + matrix[:3, 0] * side * EYE_DISTANCE_M
        x, y, z = (float(value) for value in place)
        found.append(EyeView(eye, (x, y, z, *head[3:]), tangents))
    return found[0], found[1]
