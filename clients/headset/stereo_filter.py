"""Frames before and after the filter, and the interface of the filters between."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clients.headset.runtime import DueFrame, Eye, EyeView
from clients.headset.stereo_gaze import EyeAndGaze, RgbdPicture
from filter_service import FilterSettings, RgbdView
from filter_service.messages import ViewState

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """One frame to be filtered, with the state of both eyes."""

    due: DueFrame
    pictures: tuple[RgbdPicture, ...]
    eyes: tuple[EyeAndGaze, ...]
    begun_s: float

    @property
    def views(self) -> list[RgbdView]:
        """Return the views to filter."""
        return [RgbdView(p.color, p.depth_m, p.view.tangents) for p in self.pictures]

    @property
    def states(self) -> tuple[ViewState, ...]:
        """Return eye, pupil, focus, gaze and pose of each view."""
        return tuple(
            ViewState(
                picture.view.eye,
                eye.state.pupil_diameter_mm,
                eye.state.focus_dpt,
                eye.gaze_deg,
                picture.view.pose,
            )
            for picture, eye in zip(self.pictures, self.eyes, strict=True)
        )


@dataclass(frozen=True)
class FilteredStereoFrame:
    """A filtered frame, with the views that it was rendered for.

    Attributes
    ----------
    frame : StereoFrame
        Input frame.
    views : EyeView of each picture, with the pose that was returned with it
    colors : (h, w, 3) uint8 of each eye
    used_focus_dpt : of each eye; None where it says nothing about the requested eye,
        because the view shows the previous eye or a preview
    stages_ms : times of the filter, and of the way to it and back
    """

    frame: StereoFrame
    views: tuple[EyeView, ...]
    colors: tuple[NDArray[np.uint8], ...]
    used_focus_dpt: tuple[float | None, ...]
    is_complete: bool
    notes: tuple[str, ...]
    stages_ms: Mapping[str, float] = field(default_factory=dict)


class StereoFilter(Protocol):
    """Interface of a filter of frames, each eye through its own profile.

    Attributes
    ----------
    settings : FilterSettings
        Settings of eyes from the next change on; straight ahead is that of each view.
    """

    settings: FilterSettings

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Request another eye; frames use the previous one until it is ready."""

    def see(self, frame: StereoFrame) -> FilteredStereoFrame | None:
        """Submit a frame; return the newest result, or None if there is none yet."""

    def restart(self) -> None:
        """Discard results: their poses refer to a previous session."""

    def close(self) -> None:
        """Release all resources."""


def settings_for_gaze(settings: FilterSettings, eye: EyeAndGaze) -> FilterSettings:
    """Return settings whose gaze is straight ahead of the head in a canted view."""
    if settings.gaze_deg != (0.0, 0.0):
        return settings
    return settings.changed(gaze_deg=eye.ahead_deg)
