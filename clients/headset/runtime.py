"""Interface of headset runtimes, poses, and a simulated runtime."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from clients.scenes.geometry import Array, rotation
from filter_service.messages import Pose

if TYPE_CHECKING:
    import moderngl


Image: TypeAlias = "NDArray[np.uint8] | NDArray[np.float16] | moderngl.Texture"
"""An image (h, w, 3) in an array, or in a texture with the top row first."""

Eye = Literal["left", "right"]
EYES: tuple[Eye, Eye] = ("left", "right")


class NoRuntime(Exception):
    """No headset is available; one may become available later."""


class SessionLost(Exception):
    """The headset was disconnected during the session, and may reconnect."""


class SessionEnded(Exception):
    """The user ended the program from within the headset."""


@dataclass(frozen=True)
class EyeView:
    """Pose of an eye at the time when a frame is shown, and the extent of its display.

    Attributes
    ----------
    eye : "left" or "right"
        Eye of the view.
    pose : seven floats
        Pose of the eye in the room; see `matrix_of`.
    tangents : (left, right, up, down)
        Tangents of the angles to the edges of the display.
    """

    eye: Eye
    pose: Pose
    tangents: tuple[float, float, float, float]


@dataclass(frozen=True)
class GazeSample:
    """Gaze measured by an eye tracker, relative to the head.

    Attributes
    ----------
    h_deg, v_deg : float
        Direction to the right and up, as seen from between the eyes.
    at_s : float
        Time of the sample, on the clock of `DueFrame.now_s`.
    """

    h_deg: float
    v_deg: float
    at_s: float


@dataclass(frozen=True)
class DueFrame:
    """A frame that the runtime requests.

    Attributes
    ----------
    display_time_ns : int
        Time when the frame will be shown, on the runtime's clock.
    should_render : bool
        Whether the frame will be visible.
    views : tuple of EyeView
        Views of the left and the right eye; empty without head tracking.
    head : pose, optional
        Pose of the point between the eyes, if known.
    gaze : GazeSample, optional
        Gaze, if an eye tracker reports it.
    pressed : tuple of str
        Names of the controller buttons pressed since the last frame.
    period_s : float
        Time between frames if the runtime reports it, otherwise 0.
    pupil_diameter_mm : float, optional
        Pupil, if an eye tracker reports it.
    """

    display_time_ns: int
    should_render: bool
    views: tuple[EyeView, ...] = ()
    head: Pose | None = None
    gaze: GazeSample | None = None
    pressed: tuple[str, ...] = ()
    period_s: float = 0.0
    pupil_diameter_mm: float | None = None

    @property
    def now_s(self) -> float:
        """Return the display time in seconds."""
        return 1e-9 * self.display_time_ns


@dataclass(frozen=True)
class ShownView:
    """Content of one eye's display.

    Attributes
    ----------
    view : EyeView
        View that the image was rendered for, possibly from an earlier frame.
    color : (h, w, 3) uint8, or moderngl.Texture
        sRGB, top row first.
    depth_m : (h, w) float32, or moderngl.Texture
        Planar depth.
    plain : (h, w, 3) uint8, or moderngl.Texture, optional
        Unfiltered image for the left part of the display.
    plain_ratio : float
        Fraction of the width that the unfiltered image covers.
    """

    view: EyeView
    color: Image
    depth_m: NDArray[np.float32] | moderngl.Texture
    plain: Image | None = None
    plain_ratio: float = 0.0

    @property
    def size_px(self) -> tuple[int, int]:
        """Return width and height of the image."""
        if isinstance(self.color, np.ndarray):
            return self.color.shape[1], self.color.shape[0]
        return self.color.size


class Runtime(Protocol):
    """Interface of a headset runtime, which runs one frame after the other.

    Attributes
    ----------
    name : str
        Name of the runtime.
    size_px : (int, int)
        Width and height of each eye's image.
    tracks_eyes : bool
        Whether there is an eye tracker.
    """

    name: str
    size_px: tuple[int, int]
    tracks_eyes: bool

    def begin_frame(self) -> DueFrame | None:
        """Wait for the next frame; return None if no frame is due.

        Raises
        ------
        SessionLost
            If the session is lost; another one may be possible later.
        SessionEnded
            If the user ended the session.
        """

    def end_frame(self, due: DueFrame, shown: Sequence[ShownView]) -> None:
        """Show a frame; show nothing if ``shown`` is empty.

        Raises
        ------
        SessionLost
        """

    def close(self) -> None:
        """Release the headset."""


# Poses, as in OpenXR: position x, y, z in meters, then a quaternion x, y, z, w


def matrix_of(pose: Pose) -> Array:
    """Return the matrix (4, 4) from the pose's frame to its reference frame.

    Raises
    ------
    ValueError
        If the length of the quaternion is not between 0.5 and 2.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_of(_unit(pose[3:]))
    matrix[:3, 3] = pose[:3]
    return matrix


def rotation_of(quaternion: Array) -> Array:
    """Return the rotation (3, 3) of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _unit(quaternion: Sequence[float]) -> Array:
    values = np.asarray(quaternion, float)
    length = float(np.linalg.norm(values))
    if not 0.5 < length < 2.0:
        raise ValueError(
            f"orientation is {values.tolist()}; allowed: a unit quaternion"
        )
    return values / length


def turned(yaw_deg: float, pitch_deg: float = 0.0) -> tuple[float, float, float, float]:
    """Return the quaternion of a head that turns left by yaw, then up by pitch."""
    yaw, pitch = np.radians(yaw_deg) / 2, np.radians(pitch_deg) / 2
    # q = q_yaw q_pitch
    return (
        float(np.cos(yaw) * np.sin(pitch)),
        float(np.sin(yaw) * np.cos(pitch)),
        float(-np.sin(yaw) * np.sin(pitch)),
        float(np.cos(yaw) * np.cos(pitch)),
    )


def direction_of(h_deg: float, v_deg: float) -> Array:
    """Return the unit vector (3,) at h degrees to the right and v degrees up."""
    h, v = np.radians(h_deg), np.radians(v_deg)
    return np.array([np.sin(h) * np.cos(v), np.sin(v), -np.cos(h) * np.cos(v)])


def angles_of(direction: Array) -> tuple[float, float]:
    """Return the angles (h, v) in degrees of a vector in front of the viewer."""
    x, y, z = direction
    h = np.degrees(np.arctan2(x, -z))
    return float(h), float(np.degrees(np.arctan2(y, np.hypot(x, z))))


def upright(pose: Array) -> Array:
    """Return a level pose (4, 4) with the same position and heading."""
    ahead = -pose[:3, 2]
    level = rotation("y", -np.degrees(np.arctan2(ahead[0], -ahead[2])))
    level[:3, 3] = pose[:3, 3]
    return level


# Simulated runtime

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
        # Sleep until the next frame of the display; skip missed frames.
        now_s = time.monotonic() - self._start_s
        missed = math.floor((now_s - self._next_s) / self._period_s)
        at_s = self._next_s = self._next_s + self._period_s * (1 + max(0, missed))
        time.sleep(max(0.0, at_s - now_s))
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
            depth_m, shape = view.depth_m, self.size_px[::-1]
            if isinstance(depth_m, np.ndarray) and depth_m.shape != shape:
                raise ValueError(f"depth of shape {depth_m.shape}; expected {shape}")
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
    for eye, side, edges in zip(
        EYES, (-0.5, 0.5), ((left, right), (-right, -left)), strict=True
    ):
        x, y, z = (matrix[:3, 3] + matrix[:3, 0] * side * EYE_DISTANCE_M).tolist()
        found.append(EyeView(eye, (x, y, z, *head[3:]), (*edges, up, down)))
    return found[0], found[1]
