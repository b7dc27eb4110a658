"""Interface between the viewer and a headset runtime, real or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from filter_service.messages import Pose

Eye = Literal["left", "right"]
EYES: tuple[Eye, Eye] = ("left", "right")


class NoRuntime(Exception):
    """No headset is available; one may become available later."""


class SessionLost(Exception):
    """The headset was disconnected during the session; it may come back."""


class SessionEnded(Exception):
    """The user ended the program from within the headset."""


@dataclass(frozen=True)
class EyeView:
    """Pose of one eye at the time a frame is shown, and the extent of its display.

    Attributes
    ----------
    pose : seven floats
        Pose of the eye in the room, as in `poses`.
    tangents : (left, right, up, down) of the display's edges
    """

    eye: Eye
    pose: Pose
    tangents: tuple[float, float, float, float]


@dataclass(frozen=True)
class GazeSample:
    """Gaze that a tracker measured from between the eyes: right and up of the head.

    ``at_s`` is on the clock of `DueFrame.now_s`.
    """

    h_deg: float
    v_deg: float
    at_s: float


@dataclass(frozen=True)
class DueFrame:
    """One frame that the runtime requests.

    Attributes
    ----------
    display_time_ns : int
        Time at which it will be shown, on the runtime's clock.
    should_render : bool
        False if the frame will not be visible.
    views : the left eye's and the right eye's; empty without tracking
    head : the pose between the eyes, if known
    gaze : GazeSample, optional
    pressed : names of the controller buttons pressed since the last frame
    pupil_diameter_mm : float, optional
        Pupil measured by a tracker.
    period_s : float
        Time between frames if the runtime reports it, otherwise 0.
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
        View that the picture was rendered for, which may be that of an earlier frame.
    color : (h, w, 3) uint8 sRGB, top row first
    depth_m : (h, w) float32, planar
    plain : (h, w, 3) uint8, optional
        Unfiltered picture for the left part of the display.
    plain_ratio : float
        Fraction of the width that the unfiltered picture covers.
    """

    view: EyeView
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    plain: NDArray[np.uint8] | None = None
    plain_ratio: float = 0.0


class Runtime(Protocol):
    """Interface of a headset's runtime, which runs one frame after the other.

    Attributes
    ----------
    name : str
    size_px : (width, height) of each eye's picture
    tracks_eyes : bool
    """

    name: str
    size_px: tuple[int, int]
    tracks_eyes: bool

    def begin_frame(self) -> DueFrame | None:
        """Wait for the next frame; return None if there is none at the moment.

        Raises
        ------
        SessionLost
            The session is lost; it may come back.
        SessionEnded
            The user ended the session.
        """

    def end_frame(self, due: DueFrame, shown: Sequence[ShownView]) -> None:
        """Show a frame; nothing if ``shown`` is empty.

        Raises
        ------
        SessionLost
        """

    def close(self) -> None:
        """Release the headset."""
