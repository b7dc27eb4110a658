"""More frames than can be filtered: frame age, memory and fairness.

    python -m tests.benchmarks.bench_overload [--quick] [--json]

Overload: a producer three times too fast, 1280x720 through -2 dpt.  Its rows hold the
age of what comes back, counted from the schedule; error: the median age in periods of
the filter (goal 1.5), and by how many MB the service's memory changed.

Sharing: two clients without end, of which one floods, or sends frames many times as
large.  A client's share is the time in which its frames were filtered, over that of
both; error: how far it is from a half (goal 0.1 of it).  Beside it what its frames take
alone: they take longer where the other's program needs the processor, too.
Writes results/overload.json.
"""

import argparse
import threading
import time
from dataclasses import dataclass, field

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.service_process import ServiceProcess
from filter_service.camera import tangents_from_fov
from filter_service.messages import Dropped
from tests.benchmarks.harness import Row, publish

PROFILE = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -2}
SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
TOO_FAST = 3.0
CREDIT = 2
FRAMES_ALONE = 12
SETTLE_S = 3.0
TIMEOUT_S = 180.0
WAITS = ("decode_ms", "queue_ms", "rests_ms", "other_ms")


@dataclass
class Stream:
    """One client that keeps so many frames on their way, and when answers came."""

    name: str
    size_px: tuple[int, int]
    in_flight: int
    alone_ms: float = 0.0
    done_s: list[float] = field(default_factory=list)
    ages_ms: list[float] = field(default_factory=list)
    used_ms: list[float] = field(default_factory=list)


def view_of(size_px: tuple[int, int]) -> RgbdView:
    """Return squares of colour over a slanted floor."""
    width, height = size_px
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 256, (height // 16 + 1, width // 16 + 1, 3), np.uint8)
    color = cells.repeat(16, 0).repeat(16, 1)[:height, :width]
    ramp_m = np.linspace(1.0, 6.0, height, dtype=np.float32)[:, None]
    depth_m = np.repeat(ramp_m, width, axis=1)
    tangents = tangents_from_fov(45.0, width, height)
    return RgbdView(np.ascontiguousarray(color), depth_m, tangents)


def prepared(endpoint: str, view: RgbdView, in_flight: int) -> FilterClient:
    """Return a client whose eye is ready."""
    client = FilterClient(endpoint, timeout_s=TIMEOUT_S, max_in_flight=in_flight)
    client.set_profile(PROFILE, views=[view], timeout_s=TIMEOUT_S)
    for _ in range(3):
        client.filter(view, **SEE)
    return client


def closed_loop(client: FilterClient, view: RgbdView, stream: Stream, is_over) -> None:
    """Keep the client's frames on their way until it is over."""
    while not is_over():
        while client.n_unanswered < stream.in_flight:
            client.submit(view, **SEE)
        for event in client.poll(0.05):
            if isinstance(event, FilteredFrame):
                stream.done_s.append(time.monotonic())
                stream.ages_ms.append(event.age_ms)
                stages_ms = event.stage_times_ms
                waits_ms = sum(stages_ms.get(name, 0.0) for name in WAITS)
                stream.used_ms.append(event.total_ms - waits_ms)
    while client.n_unanswered:
        client.poll(0.5)


def overload(service: ServiceProcess, *, seconds: float) -> list[Row]:
    """Submit on a schedule three times too fast."""
    view = view_of((1280, 720))
    with prepared(service.endpoint, view, 1) as client:
        alone = Stream("alone", (1280, 720), 1)
        closed_loop(client, view, alone, lambda: len(alone.done_s) >= FRAMES_ALONE)
        period_s = float(np.median(np.diff(alone.done_s)))
        start_s, due, ages_ms, memory_mb = time.monotonic(), {}, [], []
        n, n_dropped = 0, 0

        def take(wait_s: float) -> None:
            nonlocal n_dropped
            for event in client.poll(wait_s):
                if isinstance(event, FilteredFrame):
                    ages_ms.append(1e3 * (time.monotonic() - due[event.frame_id]))
                n_dropped += isinstance(event, Dropped)

        while (due_s := start_s + n * period_s / TOO_FAST) < start_s + seconds:
            while (wait_s := due_s - time.monotonic()) > 0:
                take(wait_s)
            due[client.submit(view, **SEE)] = due_s
            n += 1
            if due_s - start_s > SETTLE_S:
                memory_mb.append(service.memory_mb)
        while client.n_unanswered:
            take(1.0)
    lost = n - len(ages_ms) - n_dropped
    return [
        _row(
            "overload",
            f"1280x720, {TOO_FAST:g} times too fast, {seconds:g} s",
            ages_ms,
            max(memory_mb),
            (name, error),
        )
        for name, error in (
            ("median_age_periods", float(np.median(ages_ms)) / (1e3 * period_s)),
            ("memory_change_mb", max(memory_mb) - min(memory_mb)),
            ("frames_lost_silently", float(lost)),
        )
    ]


def alone_ms(endpoint: str, stream: Stream) -> float:
    """Return a stream's period while nobody else streams."""
    view = view_of(stream.size_px)
    with prepared(endpoint, view, stream.in_flight) as client:
        seen = Stream(stream.name, stream.size_px, stream.in_flight)
        begin_s = time.monotonic()
        closed_loop(
            client,
            view,
            seen,
            lambda: len(seen.done_s) >= 4 and time.monotonic() - begin_s > SETTLE_S,
        )
    return 1e3 * float(np.median(np.diff(seen.done_s)))


def sharing(endpoint: str, first: Stream, second: Stream, *, seconds: float):
    """Let two clients stream beside each other; return a row for each."""
    for stream in (first, second):
        stream.alone_ms = alone_ms(endpoint, stream)
    end_s = float("inf")

    def run(stream: Stream, client: FilterClient, view: RgbdView) -> None:
        with client:
            closed_loop(client, view, stream, lambda: time.monotonic() > end_s)

    threads = []
    for stream in (first, second):
        view = view_of(stream.size_px)
        client = prepared(endpoint, view, stream.in_flight)
        threads.append(threading.Thread(target=run, args=(stream, client, view)))
    for thread in threads:
        thread.start()
    end_s = time.monotonic() + seconds
    for thread in threads:
        thread.join()
    # From one answer of the slower to another: whole frames of it.
    slow = max((first, second), key=lambda stream: stream.alone_ms)
    settled = [s for s in slow.done_s if s > end_s - seconds + SETTLE_S]
    begin_s, last_s = settled[0], settled[-1]
    used_ms = {
        stream.name: sum(
            used_ms
            for done_s, used_ms in zip(stream.done_s, stream.used_ms, strict=True)
            if begin_s < done_s <= last_s
        )
        for stream in (first, second)
    }
    whole_ms = sum(used_ms.values())
    return [
        _row(
            f"sharing, {stream.name}",
            f"beside {other.name}; alone {stream.alone_ms:.0f} ms a frame",
            stream.ages_ms,
            0.0,
            ("share_from_a_half", abs(used_ms[stream.name] / whole_ms / 0.5 - 1.0)),
        )
        for stream, other in ((first, second), (second, first))
    ]


def _row(method, case, ages_ms, memory_mb, error) -> Row:
    return Row(
        bench="overload",
        method=method,
        case=case,
        setting=f"-2 dpt, 4 mm, credit {CREDIT}",
        n=len(ages_ms),
        median_ms=float(np.median(ages_ms)),
        p95_ms=float(np.percentile(ages_ms, 95)),
        memory_mb=memory_mb,
        error_name=error[0],
        error=error[1],
        reference="the service with one client alone",
    )


def main(argv=None) -> None:
    """Run all cases, print and publish them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="seconds, not minutes")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    seconds = 8.0 if options.quick else 30.0
    large = (2048, 2048) if options.quick else (4096, 4096)
    rows = []
    with ServiceProcess() as service:
        rows += overload(service, seconds=seconds)
        for first, second in (
            (Stream("a flood", (640, 360), CREDIT), Stream("one", (640, 360), 1)),
            (Stream("720p", (1280, 720), CREDIT), Stream("180p", (320, 180), CREDIT)),
            (Stream("large", large, CREDIT), Stream("small", (640, 360), CREDIT)),
        ):
            longer = 2.0 if first.name == "large" else 1.0
            rows += sharing(service.endpoint, first, second, seconds=longer * seconds)
    publish("overload", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
