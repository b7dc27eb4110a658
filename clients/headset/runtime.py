"""What the viewer asks of a headset's runtime, real or simulated."""

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
    """There is no headset to talk to; later there may be one."""


class SessionLost(Exception):
    """The headset went away in the middle; it may come back."""


class SessionEnded(Exception):
    """The user has ended the program from within the headset."""


@dataclass(frozen=True)
class EyeView:
    """Where one eye is at the time a frame is shown, and what its display covers.

    Attributes
    ----------
    pose : seven floats
        Of the eye in the room, as of `poses`.
    tangents : (left, right, up, down) of the display's edges
    """

    eye: Eye
    pose: Pose
    tangents: tuple[float, float, float, float]


@dataclass(frozen=True)
class GazeSample:
    """Where a tracker saw the eyes look, from between them: right and up of the head.

    ``at_s`` is on the clock of `DueFrame.now_s`.
    """

    h_deg: float
    v_deg: float
    at_s: float


@dataclass(frozen=True)
class DueFrame:
    """One frame that the runtime asks for.

    Attributes
    ----------
    display_time_ns : int
        When it will be shown, on the runtime's clock.
    should_render : bool
        False: nobody will see it.
    views : the left eye's and the right eye's; none where nothing is tracked
    head : the pose between the eyes, where it is known
    gaze : GazeSample, optional
    pressed : names of what was pressed on a controller since the last frame
    pupil_diameter_mm : float, optional
        As a tracker measures it.
    period_s : float
        From one frame to the next, where the runtime says so; else 0.
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
        """Return its time in seconds."""
        return 1e-9 * self.display_time_ns


@dataclass(frozen=True)
class ShownView:
    """What one eye is shown.

    Attributes
    ----------
    view : EyeView
        As it was rendered, which may be longer ago than the frame.
    color : (h, w, 3) uint8 sRGB, top row first
    depth_m : (h, w) float32, planar
    plain : (h, w, 3) uint8, optional
        The unfiltered picture, for the left part of the display.
    plain_ratio : float
        How much of the width that is.
    """

    view: EyeView
    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    plain: NDArray[np.uint8] | None = None
    plain_ratio: float = 0.0


class Runtime(Protocol):
    """A headset's runtime: one frame after the other.

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
        """Wait for the next frame; None where there is none for the moment.

        Raises
        ------
        SessionLost
            It may come back.
        SessionEnded
            The user wants it so.
        """

    def end_frame(self, due: DueFrame, shown: Sequence[ShownView]) -> None:
        """Show a frame; nothing where ``shown`` is empty.

        Raises
        ------
        SessionLost
        """

    def close(self) -> None:
        """Let the headset go."""
