"""Frames before and after filtering, and the interface of filters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from clients.headset.runtime import DueFrame, Eye, EyeView, Image
from clients.headset.stereo_gaze import EyeAndGaze, Picture
from filter_service import FilterSettings, RgbdView
from filter_service.messages import ViewState
from filter_service.settings import Output

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Frame to filter, with the state of both eyes."""

    due: DueFrame
    pictures: tuple[Picture, ...]
    eyes: tuple[EyeAndGaze, ...]
    begun_s: float

    @property
    def views(self) -> list[RgbdView]:
        """Return the views to filter."""
        return [RgbdView(p.color, p.depth_m, p.view.tangents) for p in self.pictures]

    @property
    def output(self) -> Output:
        """Return the format of the results, which is that of the images."""
        is_srgb = all(picture.color.dtype == np.uint8 for picture in self.pictures)
        return "srgb8" if is_srgb else "linear16"

    @property
    def states(self) -> tuple[ViewState, ...]:
        """Return the eye, pupil, focus, gaze and pose of each view."""
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
    """Filtered frame, with the views that it was rendered for.

    Attributes
    ----------
    frame : StereoFrame
        Input frame.
    views : tuple of EyeView
        View of each image, with the pose that was returned with it.
    colors : tuple of (h, w, 3) uint8 or float16, or of moderngl.Texture
        Filtered image of each eye, sRGB or linear light as the input.
    used_focus_dpt : tuple of float or None
        Focus of each eye; None if the previous eye was used, whose focus does not apply
        to the requested eye.
    is_complete : bool
        Whether complete eyes were used.
    notes : tuple of str
        Notes of the filter.
    stages_ms : mapping
        Times of the filter, and of transport to and from it.
    """

    frame: StereoFrame
    views: tuple[EyeView, ...]
    colors: tuple[Image, ...]
    used_focus_dpt: tuple[float | None, ...]
    is_complete: bool
    notes: tuple[str, ...]
    stages_ms: Mapping[str, float] = field(default_factory=dict)


class StereoFilter(Protocol):
    """Interface of filters, which filter each eye through its own profile.

    Attributes
    ----------
    settings : FilterSettings
        Settings of the eyes, from the next change on.
    """

    settings: FilterSettings

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Request another eye; frames use the previous one until it is ready."""

    def see(self, frame: StereoFrame) -> FilteredStereoFrame | None:
        """Submit a frame; return the newest result, or None before the first one."""

    def known(self, picture: Picture) -> Picture:
        """Return an image whose light and depth the eyes can follow without a wait.

        It is the image itself if that is in arrays, otherwise a smaller one of an
        earlier frame.
        """

    def restart(self) -> None:
        """Discard results, whose poses refer to the previous session."""

    def close(self) -> None:
        """Release all resources."""


def settings_for_gaze(settings: FilterSettings, eye: EyeAndGaze) -> FilterSettings:
    """Return settings with the gaze straight ahead of the head, for canted views."""
    if settings.gaze_deg != (0.0, 0.0):
        return settings
    return settings.changed(gaze_deg=eye.ahead_deg)
