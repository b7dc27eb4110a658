"""Interface between the viewer and a headset runtime, real or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

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
        Pose of the eye in the room; see `poses`.
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
        View that the image was rendered for, possibly that of an earlier frame.
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
            height_px, width_px = self.color.shape[:2]
            return width_px, height_px
        width_px, height_px = self.color.size
        return width_px, height_px


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
