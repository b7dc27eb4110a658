"""Streaming of rendered frames through a service: in order, and while an eye changes.

`pyrender_stream` and `demo` use it to pass rendered frames to the client library.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from clients.filter_client import Event, FilterClient, FilteredFrame, RgbdView
from clients.frame_log import FrameLog
from clients.scene_renderer import SceneFrame
from filter_service.errors import ConnectionLost, ServiceTimeout
from filter_service.messages import Accepted, Dropped, ErrorReply, Progress, Ready

# Frames per second while an eye is being prepared: enough to show that the stream
# continues, few enough to leave the processor to the preparation.
_PREVIEW_HZ = 4.0
_BUILD_LIMIT_S = 180.0
_LOST = "the connection to the service broke off"


def view_of(frame: SceneFrame) -> RgbdView:
    """Convert a rendered frame to the view type of the client library."""
    return RgbdView(
        frame.color,
        frame.depth_m,
        frame.tangents,
        hidden_color=frame.hidden_color,
        hidden_depth_m=frame.hidden_depth_m,
    )


def filter_in_order(
    client: FilterClient, frames: Iterable[SceneFrame], log: FrameLog
) -> Iterator[tuple[SceneFrame, FilteredFrame]]:
    """Send frames one by one and yield each with its filtered image.

    A frame that the service drops is counted and sent again.

    Raises
    ------
    FilterError
        If the service rejects a frame, does not answer in time or disconnects.
    """
    for frame in frames:
        while True:
            _submit(client, frame)
            answer = _next_answer(client)
            if isinstance(answer, FilteredFrame):
                break
            log.add_drop(answer.reason)
            _check_connection(answer)
        log.add(answer)
        yield frame, answer


def _check_connection(event: Event) -> None:
    """Raise if a frame was dropped because the service disconnected."""
    if isinstance(event, Dropped) and event.reason == "connection_lost":
        raise ConnectionLost(_LOST)


def _submit(client: FilterClient, frame: SceneFrame) -> int:
    return client.submit(
        view_of(frame),
        pupil_diameter_mm=frame.pupil_diameter_mm,
        focus_dpt=frame.focus_dpt,
        gaze_deg=frame.gaze_deg,
    )


def _next_answer(client: FilterClient) -> FilteredFrame | Dropped:
    """Wait for the reply to the one frame in flight."""
    deadline_s = time.monotonic() + client.timeout_s
    while time.monotonic() < deadline_s:
        for event in client.poll(0.2):
            if isinstance(event, ErrorReply):
                raise event.exception()
            if isinstance(event, FilteredFrame | Dropped):
                return event
        # A frame that was not sent yet would wait for the next connection.
        if client.welcome is None:
            raise ConnectionLost(_LOST)
    raise ServiceTimeout(f"no answer to a frame within {client.timeout_s:g} s")


@dataclass(frozen=True)
class EyeChange:
    """Record of a change of the eye during a stream.

    Attributes
    ----------
    generation, previous_generation : the service's eye counter; None before any eye
    frames_through_previous : frames filtered with the old eye during preparation
    ready : the service's Ready message of the new eye
    """

    generation: int
    previous_generation: int | None
    frames_through_previous: int
    ready: Ready

    def summary(self) -> dict[str, Any]:
        """Return the change as plain numbers."""
        return {
            "generation": self.generation,
            "previous_generation": self.previous_generation,
            "frames_through_previous_eye": self.frames_through_previous,
            "build_ms": round(self.ready.build_ms, 1),
            "psf_count": self.ready.psf_count,
            "memory_mb": round(self.ready.memory_mb, 2),
            "notes": list(self.ready.notes),
        }


def change_eye(
    client: FilterClient,
    body: Mapping[str, Any],
    *,
    settings: Mapping[str, Any],
    frames: Sequence[SceneFrame],
    has_eye: bool,
    on_progress: Callable[[float, str], None] = lambda fraction, stage: None,
) -> EyeChange:
    """Request another eye and continue the stream until it is ready.

    Parameters
    ----------
    body : profile, such as ``{"kind": "preset", "name": "myopia"}``
    settings : fields of `FilterSettings`
    frames : sent in a loop meanwhile; the eye is prepared for the first one's camera
    has_eye : whether an earlier eye can filter them
    on_progress : called with (fraction 0..1, stage)

    Raises
    ------
    FilterError
        If the profile is rejected, or its preparation fails or takes too long.
    """
    accepted = client.set_profile(
        body,
        settings=settings,
        views=[view_of(frames[0])],
        wait=False,
        timeout_s=client.timeout_s,
    )
    assert isinstance(accepted, Accepted)
    watch = _ChangeWatch(accepted, on_progress)
    deadline_s = time.monotonic() + _BUILD_LIMIT_S
    next_send_s, index = time.monotonic(), 0
    while watch.ready is None or client.n_unanswered:
        now_s = time.monotonic()
        if now_s > deadline_s:
            raise ServiceTimeout(f"the eye was not ready within {_BUILD_LIMIT_S:g} s")
        is_due = has_eye and watch.ready is None and now_s >= next_send_s
        if is_due and not client.n_unanswered:
            _submit(client, frames[index % len(frames)])
            index, next_send_s = index + 1, now_s + 1 / _PREVIEW_HZ
        for event in client.poll(0.05):
            watch.take(event)
        if client.welcome is None:
            raise ConnectionLost(_LOST)
    return EyeChange(
        accepted.generation, watch.old_generation, watch.n_through_old, watch.ready
    )


class _ChangeWatch:
    """Collects events while an eye is prepared."""

    def __init__(
        self, accepted: Accepted, on_progress: Callable[[float, str], None]
    ) -> None:
        self._accepted, self._on_progress = accepted, on_progress
        self.ready: Ready | None = None
        self.old_generation: int | None = None
        self.n_through_old = 0

    def take(self, event: Event) -> None:
        """Count frames, report progress and keep Ready; raise on errors."""
        if isinstance(event, ErrorReply):
            raise event.exception()
        _check_connection(event)
        if isinstance(event, FilteredFrame):
            if event.header.generation != self._accepted.generation:
                self.n_through_old += 1
                self.old_generation = event.header.generation
        elif getattr(event, "profile_id", None) == self._accepted.profile_id:
            if isinstance(event, Progress):
                self._on_progress(event.fraction, event.stage)
            elif isinstance(event, Ready) and event.is_complete:
                self.ready = event
