"""What a person's eyes are given, what they see of it, and what filters between."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clients.headset.look import LookingEye, RgbdPicture
from clients.headset.runtime import DueFrame, Eye, EyeView
from filter_service import FilterSettings, RgbdView
from filter_service.messages import ViewState

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class LookedAt:
    """One frame on its way to a person's eyes."""

    due: DueFrame
    pictures: tuple[RgbdPicture, ...]
    eyes: tuple[LookingEye, ...]
    begun_s: float

    @property
    def views(self) -> list[RgbdView]:
        """Return what is filtered."""
        return [RgbdView(p.color, p.depth_m, p.view.tangents) for p in self.pictures]

    @property
    def states(self) -> tuple[ViewState, ...]:
        """Return through whose eyes, in which state, from where."""
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
class Seen:
    """A frame as it is seen, with the views that it was rendered for.

    Attributes
    ----------
    frame : LookedAt
        What went in.
    views : EyeView of each picture, with the pose that came back with it
    colors : (h, w, 3) uint8 of each eye
    used_focus_dpt : of each eye; None where that tells nothing of the eye that is
        wanted, as it is seen through the one before, or through a preview
    stages_ms : times of the filter, and of the way to it and back
    """

    frame: LookedAt
    views: tuple[EyeView, ...]
    colors: tuple[NDArray[np.uint8], ...]
    used_focus_dpt: tuple[float | None, ...]
    is_complete: bool
    notes: tuple[str, ...]
    stages_ms: Mapping[str, float] = field(default_factory=dict)


class Seeing(Protocol):
    """Filters frames, each eye through its own profile.

    Attributes
    ----------
    settings : FilterSettings
        Of eyes from the next change on; where they look straight ahead is each view's.
    """

    settings: FilterSettings

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Ask for another eye; frames go on through the one before."""

    def see(self, frame: LookedAt) -> Seen | None:
        """Hand a frame over; return the newest that is seen, None while none is."""

    def restart(self) -> None:
        """Forget what was seen: its poses are of a room that is gone."""

    def close(self) -> None:
        """Let go of everything."""


def settings_ahead(settings: FilterSettings, eye: LookingEye) -> FilterSettings:
    """Return settings whose gaze is straight ahead of the head in a canted view."""
    if settings.gaze_deg != (0.0, 0.0):
        return settings
    return settings.changed(gaze_deg=eye.ahead_deg)
