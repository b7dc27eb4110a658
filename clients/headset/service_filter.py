"""Filtering of headset frames through a service."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clients.filter_client import FilterClient, FilteredFrame
from clients.headset.runtime import Eye, EyeView
from clients.headset.stereo_filter import (
    FilteredStereoFrame,
    Say,
    StereoFrame,
    settings_for_gaze,
)
from clients.headset.stereo_gaze import Picture
from filter_service import FilterSettings
from filter_service.errors import FilterError
from filter_service.messages import (
    Dropped,
    ErrorReply,
    EyeName,
    Ready,
    Result,
    ResultView,
)

RETRY_S = 1.0
SAY_AGAIN_S = 10.0
ASK_AGAIN = ("worker_crashed", "no_profile")
"""Codes of errors after which a profile is sent again."""

WAIT_SHARE = 0.6
"""Fraction of a frame's period for which the viewer waits for the newest result, so
that a fast filter's image is shown in the frame that it was rendered for."""

PATIENCE_S = 0.4
"""If the previous frame took no longer than this, the viewer always waits for the
filter. Frames that are late in any case are then half as old. On two shared cores,
frames of 896x1007 were 0.8 s old without this wait, and not more frequent."""

_OWN_STAGES = ("decode_ms", "queue_ms", "copy_out_ms", "rests_ms", "other_ms")


class ServiceFilter:
    """Filter that sends frames to a service and returns the newest result.

    Parameters
    ----------
    endpoint : str
        Address of the service.
    settings : FilterSettings
        Settings of the filters.
    say : callable
        Called with each message for the user, one line.
    key_file : Path, optional
        Key file of the client, for a service that requires one.
    """

    def __init__(
        self,
        endpoint: str,
        settings: FilterSettings,
        say: Say,
        *,
        key_file: Path | None = None,
    ) -> None:
        self._say_once = LogOnce(say)
        self._say = say
        self.settings = settings
        self._endpoint = endpoint
        self._client = FilterClient(
            endpoint, client_name="headset", key_file=key_file, timeout_s=5.0
        )
        self._wanted: dict[EyeName, dict[str, Any]] = {}
        self._asked: dict[EyeName, tuple[int, dict[str, Any]]] = {}
        self._retry_s = 0.0  # time before which no profile is sent
        self._on_way: dict[int | None, StereoFrame] = {}
        self._newest: FilteredStereoFrame | None = None
        self._is_there = True
        self._trip_s = math.inf  # round trip of the last result
        self.n_dropped: dict[str, int] = {}

    def wait_for_service(self) -> None:
        """Wait until the service responds.

        Raises
        ------
        FilterError
            If the service does not respond or rejects this client.
        """
        self._client.hello()

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Request another eye as soon as the service is connected."""
        self._wanted[eye] = dict(profile)

    def see(self, frame: StereoFrame) -> FilteredStereoFrame | None:
        """Send a frame and return the newest result.

        Returns
        -------
        FilteredStereoFrame or None
            None until the connected service has returned a result.
        """
        client = self._client
        self._take_events()
        if client.welcome is None:
            if self._is_there:
                self._say(
                    f"no filter service at {self._endpoint}: showing the scene "
                    "unfiltered and trying again"
                )
            self._is_there, self._newest = False, None
            return None
        if not self._is_there:
            self._say("connected to the filter service")
            self._is_there = True
        self._send_profiles(frame)
        try:
            frame_id = client.submit(
                frame.views,
                pupil_diameter_mm=frame.eyes[0].state.pupil_diameter_mm,
                focus_dpt=frame.eyes[0].state.focus_dpt,
                states=frame.states,
                output=frame.output,
                display_time_ns=frame.due.display_time_ns,
            )
            self._on_way[frame_id] = frame
        except FilterError as error:
            self._say(f"a frame could not be sent: {error}")
        end_s = frame.begun_s + WAIT_SHARE * frame.due.period_s
        if self._trip_s <= PATIENCE_S:
            end_s = max(end_s, time.monotonic() + PATIENCE_S)
        self._take_events()
        while self._newest is None or self._newest.frame is not frame:
            wait_s = end_s - time.monotonic()
            if wait_s <= 0.0 or frame not in self._on_way.values():
                break
            self._take_events(wait_s)
        return self._newest

    def _send_profiles(self, frame: StereoFrame) -> None:
        if time.monotonic() < self._retry_s:
            return
        for picture, looking in zip(frame.pictures, frame.eyes, strict=True):
            eye = picture.view.eye
            profile = self._wanted.pop(eye, None)
            if profile is None:
                continue
            profile_id = self._client.request_profile(
                profile,
                eye=eye,
                settings=settings_for_gaze(self.settings, looking),
                views=[picture.camera],
            )
            self._asked[eye] = profile_id, profile

    def _take_events(self, wait_s: float = 0.0) -> None:
        for event in self._client.poll(wait_s):
            if isinstance(event, FilteredFrame):
                self._take(event)
            elif isinstance(event, Dropped):
                self._on_way.pop(event.frame_id, None)
                reason = event.reason
                self.n_dropped[reason] = self.n_dropped.get(reason, 0) + 1
            elif isinstance(event, ErrorReply):
                self._on_way.pop(event.frame_id, None)
                self._take_error(event)
            elif isinstance(event, Ready):
                self._say(f"{event.eye} eye: ready after {event.build_ms:.0f} ms")

    def _take_error(self, reply: ErrorReply) -> None:
        """Report an error once; send profiles again that the service has lost."""
        if reply.code == "build_cancelled":
            return
        self._say_once(str(reply.exception()))
        if reply.code not in ASK_AGAIN:
            return
        for eye, (profile_id, profile) in self._asked.items():
            # The service repeats the error of an eye for each frame.
            if eye not in self._wanted and reply.profile_id in (None, profile_id):
                self._wanted[eye] = profile
                self._retry_s = time.monotonic() + RETRY_S

    def _take(self, answer: FilteredFrame) -> None:
        frame = self._on_way.pop(answer.frame_id, None)
        if frame is None:
            return
        header = answer.header
        self._trip_s = 1e-3 * answer.round_trip_ms
        views = tuple(
            EyeView(
                picture.view.eye, view.pose or picture.view.pose, picture.view.tangents
            )
            for picture, view in zip(frame.pictures, header.views, strict=True)
        )
        filter_ms = header.total_ms
        self._newest = FilteredStereoFrame(
            frame,
            views,
            answer.colors,
            tuple(self._used_focus_dpt(header, view) for view in header.views),
            True,
            header.notes,
            {
                "filter_ms": filter_ms - _added_ms(header.stage_times_ms),
                "service_ms": _added_ms(header.stage_times_ms),
                "wire_ms": answer.round_trip_ms - filter_ms,
                "wait_ms": answer.age_ms - answer.round_trip_ms,
            },
        )

    def _used_focus_dpt(self, header: Result, view: ResultView) -> float | None:
        """Return the focus of a view; None if the requested eye was not used."""
        if view.profile_id is None:  # a service that supports one eye only
            return header.focus_dpt
        asked = self._asked.get(view.eye)
        if asked is None or asked[0] != view.profile_id:
            return None
        return view.focus_dpt

    def known(self, picture: Picture) -> Picture:
        """Return the image: the service needs arrays of it anyway."""
        return picture

    def restart(self) -> None:
        """Discard the results and the frames in flight."""
        self._newest = None
        self._on_way = {}

    def close(self) -> None:
        """End the session."""
        self._client.close()


class LogOnce:
    """Callable that suppresses lines repeated within `SAY_AGAIN_S`."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._said_s: dict[str, float] = {}

    def __call__(self, line: str) -> None:
        """Report a line unless it was reported within `SAY_AGAIN_S`."""
        now_s = time.monotonic()
        self._said_s = {
            said: at_s
            for said, at_s in self._said_s.items()
            if now_s - at_s <= SAY_AGAIN_S
        }
        if line not in self._said_s:
            self._said_s[line] = now_s
            self._say(line)


def _added_ms(stages_ms: Mapping[str, float]) -> float:
    """Return the time of the stages that the service adds to the filter."""
    return sum(stages_ms.get(name, 0.0) for name in _OWN_STAGES)
