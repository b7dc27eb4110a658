"""Frames through a service on a fixed schedule, and their times.

The schedule is open-loop: a frame's due time does not depend on earlier replies, and
ages count from it.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.filter_client import (
    Event,
    FilterClient,
    FilteredFrame,
    RgbdView,
)
from clients.streaming import events_of
from filter_service import Output
from filter_service.errors import ServiceTimeout
from filter_service.messages import (
    Compression,
    DepthEncoding,
    Dropped,
    EyeName,
    ViewState,
    tangents_from_fov,
)

N_FRAMES = 8
"""Number of images in the loop, which the warm-up sends once."""

WARM_UP = (
    f"{N_FRAMES} frames before the clock starts, each answered before the next is "
    "sent, with pupils and foci over the whole range"
)
VERTICAL_FOV_DEG = 45.0
HEADSET_EDGES_DEG = (-52.0, 42.0, 43.0, -53.0)
"""Left, right, up and down of a headset's left view; the right one's is mirrored."""

EYES: tuple[EyeName, ...] = ("left", "right")
PUPIL_RANGE_MM, PUPIL_PERIOD_S = (2.9, 5.5), 6.0
FOCUS_RANGE_DPT, FOCUS_PERIOD_S = (0.0, 2.5), 4.5
"""States of a stream that moves."""

SHOWN_STEP_S = 1e-3
STRAGGLER_S = 10.0
FIRST_FRAME_S = 60.0
CHANGE_LIMIT_S = 120.0

CLIENT_STAGES = ("client_wait_ms", "wire_and_queue_ms")
SERVICE_STAGES = ("decode_ms", "queue_ms", "copy_out_ms", "other_ms")
"""Stages of the service outside the renderer."""

SUMS = ("added_ms", "service_total_ms", "round_trip_ms", "age_ms")


@dataclass(frozen=True)
class StreamSettings:
    """Content and transport of a stream."""

    width_px: int
    height_px: int
    n_views: int
    rate_hz: float
    duration_s: float
    profile: dict[str, Any]
    profile_settings: dict[str, Any]
    pupil_diameter_mm: float
    focus_dpt: float
    output: Output
    max_in_flight: int
    transport: str = "tcp"
    compression: Compression = "none"
    depth_encoding: DepthEncoding = "float32"
    right_profile: dict[str, Any] | None = None  # then `profile` is the left eye's
    is_moving: bool = False  # then pupil and focus change in every frame

    @property
    def tangents(self) -> list[tuple[float, float, float, float]]:
        """Return the tangents of each view: a headset's if there are two eyes."""
        if self.right_profile is None:
            usual = tangents_from_fov(VERTICAL_FOV_DEG, self.width_px, self.height_px)
            return [usual] * self.n_views
        left, right, up, down = (
            math.tan(math.radians(edge_deg)) for edge_deg in HEADSET_EDGES_DEG
        )
        return [(left, right, up, down), (-right, -left, up, down)]

    @property
    def states(self) -> list[ViewState]:
        """Return the view states, which select the eye of each view."""
        if self.right_profile is None:
            return [ViewState()] * self.n_views
        return [ViewState(eye) for eye in EYES]

    @property
    def n_scheduled(self) -> int:
        """Return the number of frames."""
        return max(1, round(self.rate_hz * self.duration_s))

    def frame_values(self, at_s: float) -> dict[str, Any]:
        """Return the arguments of `FilterClient.submit` for a frame due at a time."""
        pupil_mm, focus_dpt = self.pupil_diameter_mm, self.focus_dpt
        if self.is_moving:
            pupil_mm = _between(PUPIL_RANGE_MM, at_s / PUPIL_PERIOD_S)
            focus_dpt = _between(FOCUS_RANGE_DPT, at_s / FOCUS_PERIOD_S)
        return {
            "pupil_diameter_mm": pupil_mm,
            "focus_dpt": focus_dpt,
            "output": self.output,
            "depth_encoding": self.depth_encoding,
            "states": self.states,
        }


def _between(span: tuple[float, float], n_periods: float) -> float:
    low, high = span
    return low + (high - low) * (0.5 + 0.5 * math.sin(2.0 * math.pi * n_periods))


@dataclass(frozen=True)
class KeptFrame:
    """Images that came back, whose error is computed later.

    Attributes
    ----------
    index : int
        Number of the frame in the schedule.
    values : dict
        State that the frame asked for.
    colors : tuple of (height, width, 3) arrays
    """

    index: int
    values: dict[str, Any]
    colors: tuple[NDArray[Any], ...]


@dataclass
class LatencyRun:
    """Samples of one stream; one entry per filtered frame.

    Attributes
    ----------
    settings : StreamSettings
    renderer : str
    stages_ms : dict of lists
        ``client_wait_ms`` from the schedule to the send; ``wire_and_queue_ms``, the
        round trip minus the service's own total; the service's stages;
        ``added_ms``, the round trip minus the renderer's stages;
        ``service_total_ms``, ``round_trip_ms``, and ``age_ms`` from the schedule to the
        reply (includes delays of a late client: the schedule never waits).
    due_s : list
        Scheduled time of each filtered frame, from the start of the run.
    shown_age_ms : list
        Age of the newest picture that has arrived, every millisecond from the first
        reply on: it grows until the next one arrives, and beyond that with each drop.
    n_in_memory : int
        Number of frames whose result was in shared memory.
    max_repeat_difference : float
        Largest difference between two replies to the same frame, in units of the
        output (levels of 255, or linear light); reveals mixed up or torn images.
        0 for a stream that moves.
    n_bytes : (sent, received)
        Total size of the run's messages.
    floor_ms : float
        Round trip of the same number of bytes over a bare socket between two processes.
    kept : list of KeptFrame
        Replies whose images were kept.
    """

    settings: StreamSettings
    renderer: str
    stages_ms: dict[str, list[float]] = field(default_factory=dict)
    due_s: list[float] = field(default_factory=list)
    drops: Counter[str] = field(default_factory=Counter)
    duration_s: float = 0.0
    memory_start_mb: float = 0.0
    memory_end_mb: float = 0.0
    max_repeat_difference: float = 0.0
    n_bytes: tuple[int, int] = (0, 0)
    floor_ms: float = 0.0
    shown_age_ms: list[float] = field(default_factory=list)
    n_in_memory: int = 0
    kept: list[KeptFrame] = field(default_factory=list)

    def add(self, due_s: float, times_ms: dict[str, float]) -> None:
        """Add one filtered frame."""
        self.due_s.append(due_s)
        for name, value_ms in times_ms.items():
            self.stages_ms.setdefault(name, []).append(value_ms)

    @property
    def n_filtered(self) -> int:
        """Return the number of filtered frames."""
        return len(self.due_s)

    def stage_names(self) -> list[str]:
        """Return the stages in the order that a frame passes them, then the sums."""
        inner = [n for n in self.stages_ms if n not in (*CLIENT_STAGES, *SUMS)]
        ordered = [*CLIENT_STAGES, *inner, *SUMS]
        return [name for name in ordered if name in self.stages_ms]

    @property
    def n_bytes_per_frame(self) -> tuple[int, int]:
        """Return the bytes sent and received per frame."""
        sent, received = self.n_bytes
        n_frames = max(1, self.n_filtered)
        return sent // n_frames, received // n_frames


def make_frames(settings: StreamSettings) -> list[list[RgbdView]]:
    """Return a loop of frames: a slanted checkered floor and a moving near disc."""
    width_px, height_px = settings.width_px, settings.height_px
    x, y = np.meshgrid(np.arange(width_px), np.arange(height_px))
    cell_px = max(height_px // 24, 2)
    checks = ((x // cell_px + y // cell_px) % 2).astype(np.float32)
    depth_m = (6.0 - 5.0 * y / height_px).astype(np.float32)
    frames = []
    for k in range(N_FRAMES):
        center_x = width_px * (0.2 + 0.6 * k / (N_FRAMES - 1))
        near = (x - center_x) ** 2 + (y - height_px / 2) ** 2 < (height_px / 6) ** 2
        color = np.stack([0.2 + 0.6 * checks, y / height_px, x / width_px], axis=-1)
        color[near] = (0.9, 0.7, 0.2)
        image: NDArray[Any] = np.rint(255 * color).astype(np.uint8)
        depth = np.where(near, np.float32(0.5), depth_m)
        if settings.output == "linear":
            image = (color.astype(np.float32)) ** np.float32(2.2)
        frames.append([RgbdView(image, depth, edges) for edges in settings.tangents])
    return frames


def measure_stream(
    client: FilterClient,
    settings: StreamSettings,
    read_memory_mb: Callable[[], float],
    *,
    n_kept: int = 0,
) -> LatencyRun:
    """Prepare the eye, warm up and send the frames on schedule.

    Parameters
    ----------
    client : FilterClient
    settings : StreamSettings
    read_memory_mb : callable
        Returns the memory of the service, in 10⁶ bytes.
    n_kept : int
        Number of replies whose images are kept, evenly distributed over the schedule.

    Raises
    ------
    FilterError
        If the service rejects the profile or a frame, does not answer or disconnects.
    """
    frames = make_frames(settings)
    set_profiles(client, settings, frames[0])
    first_replies = [
        client.filter(
            frame,
            **settings.frame_values(k * PUPIL_PERIOD_S / N_FRAMES),
            timeout_s=FIRST_FRAME_S,
        )
        for k, frame in enumerate(frames)
    ]
    welcome = client.hello()
    run = LatencyRun(settings, welcome.server["renderer"])
    run.memory_start_mb = read_memory_mb()
    before = client.n_bytes
    loop = _Loop(client, run, settings, n_kept)
    if not settings.is_moving:
        loop.first_colors = [  # copies, because images in shared memory hold a slot
            tuple(np.array(color) for color in reply.colors) for reply in first_replies
        ]
    del first_replies
    loop.start_s = time.monotonic()
    for k in range(run.settings.n_scheduled):
        at_s = k / settings.rate_hz
        loop.take_until(loop.start_s + at_s)
        frame_id = client.submit(frames[k % N_FRAMES], **settings.frame_values(at_s))
        loop.sent[frame_id] = k
    end_s = time.monotonic() + STRAGGLER_S
    while client.n_unanswered and time.monotonic() < end_s:
        loop.take_until(time.monotonic() + 0.01)
    loop.take_until(time.monotonic())
    run.drops["unanswered"] += client.n_unanswered
    run.drops += type(run.drops)()  # removes zero counts
    run.duration_s = time.monotonic() - loop.start_s
    run.shown_age_ms = loop.shown_ages_ms()
    run.memory_end_mb = read_memory_mb()
    sent, received = client.n_bytes
    run.n_bytes = sent - before[0], received - before[1]
    return run


def set_profiles(
    client: FilterClient, settings: StreamSettings, views: Sequence[RgbdView]
) -> None:
    """Set the profile of each eye and wait until they are ready."""
    how = settings.profile_settings
    if settings.right_profile is None:
        client.set_profile(settings.profile, settings=how, views=views)
        return
    profiles = settings.profile, settings.right_profile
    for eye, profile, view in zip(EYES, profiles, views, strict=True):
        client.set_profile(profile, eye=eye, settings=how, views=[view])


def profile_change_ms(
    client: FilterClient, settings: StreamSettings, profile: Mapping[str, Any]
) -> float:
    """Return the time from a request for another eye to its first frame.

    The stream continues through the previous eye meanwhile.  Frames with two eyes
    change both.

    Raises
    ------
    FilterError
        If the service rejects the profile or a frame, does not answer in time or
        disconnects.
    """
    frames = make_frames(settings)
    how, frame = settings.profile_settings, frames[0]
    start_s = time.monotonic()
    if settings.right_profile is None:
        one = client.request_profile(profile, settings=how, views=frame)
        wanted = [one] * len(frame)
    else:
        wanted = [
            client.request_profile(profile, eye=eye, settings=how, views=[view])
            for eye, view in zip(EYES, frame, strict=True)
        ]
    k = 0
    while time.monotonic() < start_s + CHANGE_LIMIT_S:
        at_s = k / settings.rate_hz
        client.submit(frames[k % N_FRAMES], **settings.frame_values(at_s))
        k += 1
        due_s = start_s + k / settings.rate_hz
        is_first_poll = True
        while is_first_poll or time.monotonic() < due_s:
            is_first_poll = False
            for event in events_of(client, due_s - time.monotonic()):
                if isinstance(event, FilteredFrame):
                    used = [view.profile_id for view in event.views]
                    if used == wanted:
                        return 1000 * (time.monotonic() - start_s)
    raise ServiceTimeout(
        f"no frame through the new profile within {CHANGE_LIMIT_S:g} s"
    )


class _Loop:
    """Receives replies between due frames."""

    def __init__(
        self,
        client: FilterClient,
        run: LatencyRun,
        settings: StreamSettings,
        n_kept: int,
    ) -> None:
        self._client = client
        self._run = run
        self._settings = settings
        self._kept_from = [settings.n_scheduled * i // n_kept for i in range(n_kept)]
        self._arrivals: list[tuple[float, float]] = []  # of frames: due, arrived
        self.first_colors: list[tuple[NDArray[Any], ...]] = []
        self.sent: dict[int, int] = {}
        self.start_s = 0.0

    def take_until(self, end_s: float) -> None:
        while True:
            for event in events_of(self._client, end_s - time.monotonic()):
                self._take(event)
            if time.monotonic() >= end_s:
                return

    def shown_ages_ms(self) -> list[float]:
        due_s, arrived_s = np.array(self._arrivals).reshape(-1, 2).T
        if not len(due_s):
            return []
        end_s = max(
            (self._settings.n_scheduled - 1) / self._settings.rate_hz, arrived_s[-1]
        )
        at_s = np.arange(arrived_s[0], end_s + SHOWN_STEP_S, SHOWN_STEP_S)
        shown = np.searchsorted(arrived_s, at_s, side="right") - 1
        newest_due_s = np.maximum.accumulate(due_s)[shown]
        return (1000 * (at_s - newest_due_s)).tolist()

    def _take(self, event: Event) -> None:
        if isinstance(event, FilteredFrame):
            now_s = time.monotonic()
            index = self.sent.pop(event.frame_id)
            due_s = index / self._settings.rate_hz
            age_ms = 1000 * (now_s - self.start_s - due_s)
            header = event
            stages_ms = header.stage_times_ms
            wire_ms = event.round_trip_ms - header.total_ms
            own_ms = sum(stages_ms.get(name, 0.0) for name in SERVICE_STAGES)
            times_ms = {
                "client_wait_ms": age_ms - event.round_trip_ms,
                "wire_and_queue_ms": wire_ms,
                **stages_ms,
                "added_ms": wire_ms + own_ms,
                "service_total_ms": header.total_ms,
                "round_trip_ms": event.round_trip_ms,
                "age_ms": age_ms,
            }
            self._run.add(due_s, times_ms)
            self._run.n_in_memory += header.in_memory
            self._arrivals.append((due_s, now_s - self.start_s))
            self._keep(event, index)
            if self.first_colors:
                self._compare(event, index % N_FRAMES)
        elif isinstance(event, Dropped):
            self._run.drops[event.reason] += 1

    def _keep(self, event: FilteredFrame, index: int) -> None:
        if self._kept_from and index >= self._kept_from[0]:
            del self._kept_from[0]
            colors = tuple(np.array(color) for color in event.colors)  # frees its slot
            values = self._settings.frame_values(index / self._settings.rate_hz)
            self._run.kept.append(KeptFrame(index, values, colors))

    def _compare(self, event: FilteredFrame, image: int) -> None:
        """Compare with the first reply to this frame, on every 16th pixel for speed."""
        for first, now in zip(self.first_colors[image], event.colors, strict=True):
            part = slice(None, None, 4)
            difference = first[part, part].astype(np.float32) - now[part, part]
            self._run.max_repeat_difference = max(
                self._run.max_repeat_difference, float(np.abs(difference).max())
            )
