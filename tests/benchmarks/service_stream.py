"""A client that streams to a service in a thread, and what became of its frames."""

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from filter_service.camera import tangents_from_fov
from filter_service.messages import Dropped, ErrorReply

PROFILE = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -2}
SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
N_PREPARED = 3
TIMEOUT_S = 180.0
LIMIT_S = 60.0
RETRY_S = 0.05
WAITS = ("decode_ms", "queue_ms", "rests_ms", "other_ms")
"""Stages of a frame in which nothing is filtered."""


def view_of(size_px: tuple[int, int]) -> RgbdView:
    """Return squares of color over a slanted floor."""
    width_px, height_px = size_px
    rng = np.random.default_rng(0)
    shape = (height_px // 16 + 1, width_px // 16 + 1, 3)
    cells = rng.integers(0, 256, shape, np.uint8)
    color = cells.repeat(16, 0).repeat(16, 1)[:height_px, :width_px]
    ramp_m = np.linspace(1.0, 6.0, height_px, dtype=np.float32)[:, None]
    depth_m = np.repeat(ramp_m, width_px, axis=1)
    tangents = tangents_from_fov(45.0, width_px, height_px)
    return RgbdView(np.ascontiguousarray(color), depth_m, tangents)


def processor_s(pids) -> float:
    """Return the processor time that processes have used, user and system (Linux)."""
    ticks = 0
    for pid in pids:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(words[11]) + int(words[12])
    return ticks / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Seen:
    """An event of a frame.

    Attributes
    ----------
    kind : "filtered", or the reason or code of a frame that was not
    age_ms : from when the frame was due
    used_ms : time in which the service filtered it
    """

    at_s: float
    frame_id: int
    kind: str
    due_s: float
    age_ms: float
    used_ms: float = 0.0
    is_complete: bool = False
    session: tuple[str, str] = ("", "")  # key, version of the service


class Stream:
    """One client with one frame size that streams between `start` and `stop`.

    Parameters
    ----------
    endpoint : str
    view : RgbdView or list of them
        A frame, or frames in a loop.
    profile : mapping
        An eye whose kind is ``double`` is checked by the mark in its images.
    rate_hz : float, optional
        Of a schedule; without it, ``in_flight`` frames are kept unanswered.
    state : callable, optional
        Returns the arguments of a frame, by its number.
    prepare : callable, optional
        Sets the profiles of a client instead of ``profile``.
    calls : bool
        Whether `FilterClient.filter` is called, frame after frame.
    settings, key_file : as of `FilterClient`
    """

    def __init__(
        self,
        endpoint: str,
        view: RgbdView | list,
        *,
        profile: Mapping[str, Any] = PROFILE,
        settings: Mapping[str, Any] = MappingProxyType({}),
        rate_hz: float | None = None,
        in_flight: int = 1,
        state: Callable[[int], Mapping[str, Any]] = lambda _: SEE,
        prepare: Callable[[FilterClient], object] | None = None,
        calls: bool = False,
        key_file: Path | None = None,
    ) -> None:
        self.frames = view if isinstance(view, list) else [view]
        self.rate_hz, self.in_flight, self.state = rate_hz, in_flight, state
        self.calls, self.profile = calls, profile
        self.seen: list[Seen] = []
        self.due_s: dict[int, float] = {}
        self.errors: Counter[str] = Counter()
        self.last: FilteredFrame | None = None
        self.failure: BaseException | None = None
        self._is_over = threading.Event()
        self._thread: threading.Thread | None = None
        self.client = FilterClient(
            endpoint, key_file=key_file, timeout_s=TIMEOUT_S, max_in_flight=in_flight
        )
        if prepare is None:
            self.client.set_profile(
                profile, settings=settings, views=[self.frames[0]], timeout_s=TIMEOUT_S
            )
        else:
            prepare(self.client)
        for number in range(N_PREPARED):
            self.last = self.client.filter(self.frames[0], **state(number))

    def __enter__(self) -> "Stream":
        """Start to stream."""
        self.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Stop, and close the client."""
        try:
            self.stop()
        finally:
            self.client.close()

    def start(self) -> None:
        """Start to stream, with nothing seen yet."""
        self.seen, self.due_s = [], {}
        self._is_over.clear()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, after the replies to all frames; raise what the thread raised."""
        self._is_over.set()
        if self._thread is not None:
            self._thread.join()
        if self.failure is not None:
            raise self.failure

    def filtered(self) -> list[Seen]:
        """Return the filtered frames so far."""
        return [one for one in list(self.seen) if one.kind == "filtered"]

    def period_ms(self) -> float:
        """Return the median time between two results."""
        return 1e3 * float(np.median(np.diff([one.at_s for one in self.filtered()])))

    def watch(self, duration_s: float) -> tuple[float, float]:
        """Return the rate in Hz and the longest time between two results in s."""
        start_s = time.monotonic()
        time.sleep(duration_s)
        end_s = time.monotonic()
        times_s = [o.at_s for o in self.filtered() if start_s <= o.at_s <= end_s]
        gaps_s = np.diff([start_s, *times_s, end_s])
        return len(times_s) / (end_s - start_s), float(gaps_s.max())

    def wait_for(self, is_wanted: Callable[[Seen], bool]) -> Seen:
        """Return the first filtered frame that is wanted.

        Raises
        ------
        RuntimeError
            If there is none within `LIMIT_S`.
        """
        end_s, n_known = time.monotonic() + LIMIT_S, 0
        while time.monotonic() < end_s and self.failure is None:
            found = self.filtered()
            for one in found[n_known:]:
                if is_wanted(one):
                    return one
            n_known = len(found)
            time.sleep(0.002)
        raise self.failure or RuntimeError(f"no such frame within {LIMIT_S:g} s")

    def n_unreported(self) -> int:
        """Return the number of frames without an event and of surplus events."""
        counts = Counter(one.frame_id for one in self.seen)
        return sum(abs(counts[frame_id] - 1) for frame_id in self.due_s)

    def _run(self) -> None:
        try:
            if self.calls:
                self._call()
                return
            due_s, client = time.monotonic(), self.client
            while not self._is_over.is_set():
                if self.rate_hz is None:
                    for _ in range(self.in_flight - client.n_unanswered):
                        self._submit(time.monotonic())
                    self._take(0.05)
                    continue
                self._submit(due_s)
                due_s += 1.0 / self.rate_hz
                while (wait_s := due_s - time.monotonic()) > 0:
                    self._take(wait_s)
            end_s = time.monotonic() + LIMIT_S
            while client.n_unanswered and time.monotonic() < end_s:
                self._take(0.1)
        except BaseException as error:
            self.failure = error

    def _call(self) -> None:
        while not self._is_over.is_set():
            start_s, number = time.monotonic(), len(self.due_s)
            frame = self.frames[number % len(self.frames)]
            reply = self.client.filter(frame, timeout_s=LIMIT_S, **self.state(number))
            self.due_s[reply.frame_id] = start_s
            self._add(reply)

    def _submit(self, due_s: float) -> None:
        number = len(self.due_s)
        frame = self.frames[number % len(self.frames)]
        self.due_s[self.client.submit(frame, **self.state(number))] = due_s

    def _take(self, wait_s: float) -> None:
        n_refused = 0
        for event in self.client.poll(wait_s):
            if isinstance(event, FilteredFrame):
                self._add(event)
            elif isinstance(event, Dropped):
                self._note(event.frame_id, event.reason)
                n_refused += 1
            elif isinstance(event, ErrorReply):
                if event.code != "build_cancelled":
                    self.errors[event.code] += 1
                if event.frame_id is not None:
                    self._note(event.frame_id, event.code)
                    n_refused += 1
        if n_refused and self.rate_hz is None:  # the next one would be refused at once
            time.sleep(RETRY_S)

    def _note(self, frame_id: int, kind: str, **more) -> None:
        now_s = time.monotonic()
        due_s = self.due_s.get(frame_id, now_s)
        age_ms = 1e3 * (now_s - due_s)
        self.seen.append(Seen(now_s, frame_id, kind, due_s, age_ms, **more))

    def _add(self, reply: FilteredFrame) -> None:
        mark, welcome = self.profile.get("mark"), self.client.welcome
        if mark is not None and reply.color[0, 0, 0] != mark:
            self.errors["wrong eye"] += 1
        waits_ms = sum(reply.stage_times_ms.get(name, 0.0) for name in WAITS)
        self._note(
            reply.frame_id,
            "filtered",
            used_ms=reply.total_ms - waits_ms,
            is_complete=reply.is_complete,
            session=(welcome.session_key, welcome.server["version"])
            if welcome
            else ("", ""),
        )
        self.last = reply
