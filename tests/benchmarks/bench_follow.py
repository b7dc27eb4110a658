"""Streams whose pupil and focus change in every frame: share of complete frames.

A frame is whole when it shows the state that it asks for and is delivered within two
frame intervals of its submission; dropped frames count against it.  Walks: the demo's,
and a panned photograph (`stream_walks`), at 480x270 and 30 frames a second, and through
two eyes at 1280x720 and 8 a second or 0.6 of the eye's own frame rate, in this process
and through the service; half way the eye changes.  Then, with calls that wait: the
slowest frame of the walk against the median, and how long the first frame after a step
takes (pupil 3 to 6 mm and focus 0 to 2.5 dpt at once).  Error: the share of whole
frames.  The setting also states the memory of kernels and tables of PSFs.
"""

import math
import socket
import sys
import time
import urllib.request
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from filter_service import Camera, EyeFilter
from filter_service.building.jobs import BuildLimits
from filter_service.building.worker_handle import WorkerHandle
from filter_service.filtering.builder import Builder
from filter_service.filtering.stream_eyes import EyeReady
from filter_service.rendering.native.renderer import NativeLanes
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.rows import row_of
from tests.benchmarks.stream_walks import Moment, demo_walk, photograph_walk

MINUTES = 8
EYES = CONDITIONS
STREAM_S = 6.0
SIZES = (((480, 270), 30.0, EYES), ((1280, 720), 8.0, ("emmetropia", "keratoconus")))
"""Sizes, frames a second and eyes."""

OF_OWN_RATE = 0.6
LIMITS = BuildLimits()
STEP = ((3.0, 0.0), (6.0, 2.5))
WAIT_S = 120.0


def preset(name: str) -> dict[str, str]:
    """Return a preset's profile."""
    return {"kind": "preset", "name": name}


@dataclass
class Seen:
    """What came of one stream."""

    n_frames: int = 0
    n_whole: int = 0
    n_dropped: int = 0
    times_ms: list[float] = field(default_factory=list)
    new_eye_s: float = math.inf
    kernels_mb: float = 0.0
    tables_mb: float = 0.0

    @property
    def words(self) -> str:
        """Return the counts and the memory in words."""
        return (
            f"{self.n_dropped} of {self.n_frames} dropped, new eye after "
            f"{self.new_eye_s:.2f} s, kernels {self.kernels_mb:.0f} MB, "
            f"tables {self.tables_mb:.0f} MB"
        )


class Following:
    """An `EyeFilter` with an engine and a worker of its own."""

    def __init__(self, eye: str, camera: Camera) -> None:
        self.builder = Builder(WorkerHandle(), NativeLanes(), LIMITS)
        self.ready_s: list[float] = []
        self.filter = EyeFilter(
            preset(eye), camera, on_event=self._note, builder=self.builder
        )
        self.filter.wait(WAIT_S)

    def _note(self, event: object) -> None:
        if isinstance(event, EyeReady):
            self.ready_s.append(time.monotonic())

    def __enter__(self) -> "Following":
        """Return it."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """End the engine and the worker."""
        self.filter.close()
        self.builder.close()
        self.builder.engine.close()

    def waited(self, moment: Moment) -> float:
        """Filter a frame however long it takes; ms."""
        begin_s = time.perf_counter()
        self.filter.filter(
            moment.view,
            **moment.state,
        )
        return 1e3 * (time.perf_counter() - begin_s)

    def stream(
        self, moments: Sequence[Moment], rate_hz: float, new_eye: str | None
    ) -> Seen:
        """Send frames in real time; those due while one is filtered are dropped."""
        seen = Seen()
        started_s, changed_s, half = time.monotonic(), math.inf, len(moments) // 2
        for number, moment in enumerate(moments):
            due_s = started_s + number / rate_hz
            if number == half and new_eye is not None:
                self.filter.set_profile(preset(new_eye))
                changed_s = time.monotonic()
            seen.n_frames += 1
            if time.monotonic() > due_s + 1.0 / rate_hz:
                seen.n_dropped += 1
                continue
            while time.monotonic() < due_s:
                time.sleep(0.0005)
            begin_s = time.perf_counter()
            shown = self.filter.try_filter(
                [moment.view],
                **moment.state,
            )
            seen.times_ms.append(1e3 * (time.perf_counter() - begin_s))
            end_s = time.monotonic()
            is_whole = bool(shown)
            seen.n_whole += is_whole and end_s - due_s <= 2.0 / rate_hz
            if is_whole and shown.generation > 1:
                seen.new_eye_s = min(seen.new_eye_s, end_s - changed_s)
        seen.kernels_mb = self.builder.stores_mb
        seen.tables_mb = self.builder.tables_mb
        return seen


def service_memory_mb(metrics_port: int) -> list[float]:
    """Return the memory of kernels and of tables, by the metrics of a service."""
    url = f"http://127.0.0.1:{metrics_port}/metrics"
    with urllib.request.urlopen(url, timeout=10.0) as reply:
        lines = reply.read().decode().splitlines()
    values = dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    return [float(values[f"ocufilter_{n}_bytes"]) / 1e6 for n in ("psfs", "psf_tables")]


def free_port() -> int:
    """Return a port that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def served(
    eye: str, moments: Sequence[Moment], rate_hz: float, new_eye: str | None
) -> Seen:
    """Send the same frames through the service, on this machine."""
    from clients.filter_client import FilterClient, FilteredFrame
    from clients.service_process import ServiceProcess

    seen, sent_s, port = Seen(), {}, free_port()
    settings = {"engine": "native", "metrics_port": port}
    with (
        ServiceProcess(settings, start_timeout_s=WAIT_S) as service,
        FilterClient(service.endpoint, timeout_s=WAIT_S, max_in_flight=2) as client,
    ):
        client.set_profile(preset(eye), views=[moments[0].view])
        started_s, changed_s, half = time.monotonic(), math.inf, len(moments) // 2

        def take(events: Sequence[Any]) -> None:
            now_s = time.monotonic()
            for event in events:
                if not isinstance(event, FilteredFrame):
                    continue
                took_s = now_s - sent_s[event.frame_id]
                seen.times_ms.append(1e3 * took_s)
                is_whole = event.is_complete
                seen.n_whole += is_whole and took_s <= 2.0 / rate_hz
                if is_whole and event.generation > 1:
                    seen.new_eye_s = min(seen.new_eye_s, now_s - changed_s)

        for number, moment in enumerate(moments):
            due_s = started_s + number / rate_hz
            while (left_s := due_s - time.monotonic()) > 0.0:
                take(client.poll(min(left_s, 0.002)))
            if number == half and new_eye is not None:
                client.request_profile(preset(new_eye), views=[moment.view])
                changed_s = time.monotonic()
            seen.n_frames += 1
            if client.n_unanswered >= 2:
                seen.n_dropped += 1
                continue
            frame_id = client.submit(
                moment.view,
                **moment.state,
            )
            sent_s[frame_id] = due_s
        end_s = time.monotonic() + 2.0
        while client.n_unanswered and time.monotonic() < end_s:
            take(client.poll(0.01))
        seen.kernels_mb, seen.tables_mb = service_memory_mb(port)
    return seen


def _row(method: str, case: str, setting: str, times_ms, name: str, value) -> Row:
    return row_of(
        *("follow", method, case, setting, times_ms, name, value),
        "all submitted frames",
    )


def eye_rows(
    eye: str, size_px: tuple[int, int], rate_hz: float, stream_s: float
) -> list[Row]:
    """Rows of one eye and size."""
    rows: list[Row] = []
    case = f"{eye} {size_px[0]}"
    new_eye = EYES[(EYES.index(eye) + 1) % len(EYES)]
    few = photograph_walk(size_px, 12, rate_hz)
    camera = few[0].view.camera
    with Following(eye, camera) as following:
        for moment in few:  # computes their PSFs
            following.waited(moment)
        own_ms = float(np.median([following.waited(moment) for moment in few]))
        rate_hz = (
            min(rate_hz, OF_OWN_RATE * 1e3 / own_ms) if size_px[0] > 480 else rate_hz
        )
    count = int(stream_s * rate_hz)
    setting = f"{rate_hz:.1f} a second"
    for name, walk_of in (("photograph", photograph_walk), ("demo", demo_walk)):
        moments = walk_of(size_px, count, rate_hz)
        with Following(eye, moments[0].view.camera) as following:
            seen = following.stream(moments, rate_hz, new_eye)
        found = [("in process", seen)]
        found.append(("service", served(eye, moments, rate_hz, new_eye)))
        for where, seen in found:
            rows.append(
                _row(
                    *(f"{name}, {where}", case, f"{setting}; {seen.words}"),
                    *(seen.times_ms, "whole frames, %"),
                    100.0 * seen.n_whole / seen.n_frames,
                )
            )
        with Following(eye, moments[0].view.camera) as following:
            times_ms = [following.waited(moment) for moment in moments][1:]
        rows.append(
            _row(
                *(f"{name}, waiting", case, setting, times_ms),
                *("slowest / median", max(times_ms) / np.median(times_ms)),
            )
        )
    with Following(eye, camera) as following:
        for state in STEP:
            took_ms = following.waited(Moment(few[0].view, *state))
    rows.append(
        _row("step", case, "", [took_ms], "first whole frame, s", took_ms / 1e3)
    )
    return rows


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes and sizes, or of one of each."""
    sizes, stream_s = SIZES, STREAM_S
    if run.is_quick:
        sizes, stream_s = (((96, 54), 30.0, EYES[:1]),), 1.0
    rows: list[Row] = []
    for size_px, rate_hz, eyes in sizes:
        for eye in eyes:
            rows += eye_rows(eye, size_px, rate_hz, stream_s)
            print(f"{eye} {size_px[0]}", file=sys.stderr, flush=True)
    return rows
