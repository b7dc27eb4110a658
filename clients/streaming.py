"""Streaming of rendered frames in order, and while an eye is prepared."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from clients.filter_client import Event, FilterClient, FilteredFrame
from clients.frame_log import FrameLog
from clients.scene_renderer import SceneFrame
from filter_service.errors import ConnectionLost, ServiceTimeout
from filter_service.messages import (
    Accepted,
    Dropped,
    ErrorReply,
    Progress,
    Ready,
    ViewState,
)

_BUILDING_HZ = 4.0
"""Frame rate while an eye is being prepared: enough to show that the stream continues,
and low enough to leave the processor to the preparation."""

_BUILD_LIMIT_S = 180.0
"""Longest time without progress of an eye's preparation."""

_POLL_S = 0.05


def submit(client: FilterClient, frame: SceneFrame) -> int:
    """Submit a frame with its state; return its frame_id."""
    is_stereo = frame.right_view is not None
    return client.submit(
        frame.views,
        pupil_diameter_mm=frame.pupil_diameter_mm,
        focus_dpt=frame.focus_dpt,
        gaze_deg=frame.state.gaze_deg,
        states=(ViewState("left"), ViewState("right")) if is_stereo else (),
    )


def filter_in_order(
    client: FilterClient, frames: Iterable[SceneFrame], log: FrameLog
) -> Iterator[FilteredFrame]:
    """Send frames one by one and yield each filtered.

    A frame that the service drops is counted and sent again.

    Raises
    ------
    FilterError
        If the service rejects a frame, does not answer in time or disconnects.
    """
    for frame in frames:
        while isinstance(answer := _filtered(client, frame), Dropped):
            log.drops[answer.reason] += 1
        log.add(answer)
        yield answer


def _filtered(client: FilterClient, frame: SceneFrame) -> FilteredFrame | Dropped:
    """Send a frame and wait for its result."""
    submit(client, frame)
    deadline_s = time.monotonic() + client.timeout_s
    while time.monotonic() < deadline_s:
        for event in events_of(client):
            if isinstance(event, FilteredFrame | Dropped):
                return event
    raise ServiceTimeout(f"no reply to a frame within {client.timeout_s:g} s")


def change_eye(
    client: FilterClient,
    body: Mapping[str, Any],
    *,
    settings: Mapping[str, Any],
    frames: Sequence[SceneFrame],
    has_eye: bool,
    on_progress: Callable[[float, str], None] = lambda fraction, stage: None,
) -> dict[str, Any]:
    """Request another eye and continue the stream until it is ready.

    Parameters
    ----------
    client : FilterClient
        Connected client.
    body : mapping
        Profile, such as ``{"kind": "preset", "name": "myopia"}``.
    settings : mapping
        Fields of `FilterSettings`.
    frames : sequence of SceneFrame
        Frames to send in a loop meanwhile; the eye is prepared for the first one's
        camera.
    has_eye : bool
        Whether an earlier eye can filter the frames.
    on_progress : callable
        Called with the completed fraction, 0 to 1, and the stage.

    Returns
    -------
    dict
        Generations of the new and the previous eye, the number of frames filtered with
        the previous one, and the figures of the service's Ready message.

    Raises
    ------
    FilterError
        If the profile is rejected, or its preparation fails or no longer advances.
    """
    views = [frames[0].view]
    accepted = client.set_profile(
        body, settings=settings, views=views, wait=False, timeout_s=client.timeout_s
    )
    assert isinstance(accepted, Accepted)
    ready: Ready | None = None
    previous_generation, n_through_previous = None, 0
    next_send_s, index = time.monotonic(), 0
    deadline_s, reached = next_send_s + _BUILD_LIMIT_S, (0.0, "")
    while ready is None or client.n_unanswered:
        now_s = time.monotonic()
        if now_s > deadline_s:
            raise ServiceTimeout(
                f"the preparation of the eye has not advanced for {_BUILD_LIMIT_S:g} s"
            )
        is_due = has_eye and ready is None and now_s >= next_send_s
        if is_due and not client.n_unanswered:
            submit(client, frames[index % len(frames)])
            index, next_send_s = index + 1, now_s + 1 / _BUILDING_HZ
        for event in events_of(client):
            if isinstance(event, FilteredFrame):
                if event.generation != accepted.generation:
                    n_through_previous += 1
                    previous_generation = event.generation
            elif getattr(event, "profile_id", None) != accepted.profile_id:
                continue
            elif isinstance(event, Progress):
                on_progress(event.fraction, event.stage)
                if (event.fraction, event.stage) != reached:
                    reached = event.fraction, event.stage
                    deadline_s = time.monotonic() + _BUILD_LIMIT_S
            elif isinstance(event, Ready):
                ready = event
    return {
        "generation": accepted.generation,
        "previous_generation": previous_generation,
        "frames_through_previous_eye": n_through_previous,
        "build_ms": round(ready.build_ms, 1),
        "psf_count": ready.psf_count,
        "memory_mb": round(ready.memory_mb, 2),
        "notes": list(ready.notes),
    }


def events_of(client: FilterClient, timeout_s: float = _POLL_S) -> list[Event]:
    """Poll for replies.

    Raises
    ------
    FilterError
        An error that the service replied, or ConnectionLost if it has disconnected.
    """
    events = client.poll(max(0.0, timeout_s))
    for event in events:
        if isinstance(event, ErrorReply):
            raise event.exception()
    is_lost = any(getattr(e, "reason", None) == "connection_lost" for e in events)
    # Without a connection, a frame that was not sent yet would wait for the next one.
    if is_lost or client.welcome is None:
        raise ConnectionLost("the service closed the connection")
    return events
