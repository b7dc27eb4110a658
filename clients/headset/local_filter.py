"""Filtering of headset frames in this process."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from clients.headset.runtime import EYES, Eye
from clients.headset.stereo_filter import (
    FilteredStereoFrame,
    Say,
    StereoFrame,
    settings_for_gaze,
)
from filter_service import (
    BuildingEye,
    EyeFailed,
    EyeFilter,
    EyeReady,
    FilterSettings,
    plan_views,
)
from filter_service.errors import BuildCancelled
from filter_service.messages import EyeName, body_of_eye

MS_PER_S = 1e3

EyeEvent = BuildingEye | EyeReady | EyeFailed


class LocalFilter:
    """Filter of headset frames in this process, which returns each result at once.

    Parameters
    ----------
    settings : FilterSettings
        Settings of the filters.
    say : callable
        Called with each message about the eyes, one line.
    """

    def __init__(self, settings: FilterSettings, say: Say) -> None:
        self._say = say
        self.settings = settings
        self.filters: dict[EyeName, EyeFilter] = {
            eye: EyeFilter(settings=settings, on_event=partial(self._tell, eye))
            for eye in EYES
        }
        self._wanted: dict[Eye, Mapping[str, Any]] = {}
        self._generations: dict[Eye, int] = {}

    def _tell(self, eye: Eye, event: EyeEvent) -> None:
        if isinstance(event, EyeReady) and event.is_complete:
            self._say(f"{eye} eye: ready after {event.build_ms:.0f} ms")
        elif isinstance(event, EyeFailed) and not isinstance(
            event.error, BuildCancelled
        ):
            self._say(f"{eye} eye: {event.error}")

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Request another eye; frames use the previous one until it is ready."""
        self._wanted[eye] = profile

    def _set_profiles(self, frame: StereoFrame) -> None:
        for picture, looking in zip(frame.pictures, frame.eyes, strict=True):
            eye = picture.view.eye
            profile = self._wanted.pop(eye, None)
            if profile is None:
                continue
            try:
                accepted = self.filters[eye].set_profile(
                    body_of_eye(profile, eye),
                    settings=settings_for_gaze(self.settings, looking),
                    cameras=[picture.camera],
                )
                self._generations[eye] = accepted.generation
            except ValueError as error:
                self._say(f"{eye} eye: {error}")

    def see(self, frame: StereoFrame) -> FilteredStereoFrame | None:
        """Filter a frame; return None while an eye is being prepared for it.

        Raises
        ------
        FilterError
            If an eye cannot be prepared and there is no previous one.
        """
        begin_s = time.monotonic()
        self._set_profiles(frame)
        planned = plan_views(
            self.filters.__getitem__,
            frame.views,
            frame.states,
            pupil_diameter_mm=frame.eyes[0].state.pupil_diameter_mm,
            focus_dpt=frame.eyes[0].state.focus_dpt,
        )
        if planned is None:
            return None
        seen = planned.render()
        stages_ms = seen.stage_times_ms
        whole_ms = MS_PER_S * (time.monotonic() - begin_s)
        return FilteredStereoFrame(
            frame,
            tuple(picture.view for picture in frame.pictures),
            tuple(view.color for view in seen.views),
            tuple(
                view.focus_dpt
                if view.generation == self._generations.get(picture.view.eye)
                else None
                for view, picture in zip(seen.views, frame.pictures, strict=True)
            ),
            seen.is_complete,
            seen.notes,
            {
                "filter_ms": sum(stages_ms.values()),
                "around_ms": whole_ms - sum(stages_ms.values()),
            },
        )

    def restart(self) -> None:
        """Do nothing: the filter keeps no state between frames."""

    def close(self) -> None:
        """Close the filters."""
        for eye_filter in self.filters.values():
            eye_filter.close()
