"""Two engines of one thread behind one socket: throughput, fairness and failover.

    python -m tests.benchmarks.bench_devices [--quick] [--json]

Clients stream 1280x720 through -2 dpt, each as fast as its frames come back: one alone
on one of the two engines, one on each, two on each, and for comparison two on one
engine of two threads.  These take turns, again and again, so that whatever else the
machine does falls on all.  Time: the period of a client's frames.  Errors: of
throughput, how far all clients' frames a second are from twice those of one alone in
the same round; of fairness, how far the slowest client's frames are from an equal
share.  The rows of "processor" have what a frame takes of it in all processes of the
service.  Clients and door need the processor, too: where it has no more cores than
there are engines, twice is out of reach; so the same is measured of engines that sleep
for 50 ms.

One killed: the other's period until the first picture of the struck one, and how long
that takes; error: frames that were not filtered.  Writes results/devices.json.
"""

import argparse
import os
import signal
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame
from clients.service_process import SERVE_COMMAND, ServiceProcess
from tests.benchmarks.bench_overload import PROFILE, SEE, view_of
from tests.benchmarks.harness import Row, publish

SIZE_PX = (1280, 720)
SETTINGS = {
    "pupil_range_mm": (4.0, 4.0),
    "focus_range_dpt": (0.0, 0.0),
    "object_range_dpt": (0.0, 1.0),
    "prepare": "ranges",  # nothing is built beside the stream
}
TWO, WHOLE = ("native:1",) * 2, ("native:2",)
SLEEP_MS = 50
DOUBLE = (
    *(sys.executable, "-m", "tests.end_to_end.double_service"),
    *("--filter-ms", str(SLEEP_MS)),
)
TICKS_A_S = os.sysconf("SC_CLK_TCK")
TIMEOUT_S = 180.0
SETTLE_S = 0.5
LIMIT_S = 60.0
RETRY_S = 0.05


@dataclass
class Stream:
    """When a client's frames came back, and how many did not."""

    done_s: list[float] = field(default_factory=list)
    n_lost: int = 0


@dataclass
class Case:
    """Clients of a service that stream beside each other, and what each round gave."""

    name: str
    service: ServiceProcess
    clients: list[FilterClient]
    periods_ms: list[float] = field(default_factory=list)
    rates_hz: list[float] = field(default_factory=list)
    unfair: list[float] = field(default_factory=list)
    processor_ms: list[float] = field(default_factory=list)

    def take_turn(self, seconds: float) -> None:
        """Stream for a while, and note what came of it."""
        before_s = processor_s(self.service)
        streams = stream_all(self.clients, lambda _: time.sleep(seconds))
        n_done = sum(len(stream.done_s) for stream in streams)
        used_s = processor_s(self.service) - before_s
        self.processor_ms.append(1e3 * used_s / n_done)
        # Whole periods of each, without the first.
        spans = [(len(s.done_s) - 1, s.done_s[-1] - s.done_s[0]) for s in streams]
        self.rates_hz.append(sum(n / span_s for n, span_s in spans))
        counts = [len(stream.done_s) for stream in streams]
        self.unfair.append(1.0 - min(counts) / float(np.mean(counts)))
        for stream in streams:
            self.periods_ms += list(1e3 * np.diff(stream.done_s))


def processor_s(service: ServiceProcess) -> float:
    """Return what all processes of the service have used of the processor (Linux)."""
    ticks = 0
    for pid in service.pids().values():
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(words[11]) + int(words[12])
    return ticks / TICKS_A_S


def stream_one(client: FilterClient, view, stream: Stream, is_over) -> None:
    """Keep one frame on its way until it is over."""
    while not is_over():
        if not client.n_unanswered:
            client.submit(view, **SEE)
        for event in client.poll(0.05):
            if isinstance(event, FilteredFrame):
                stream.done_s.append(time.monotonic())
            elif getattr(event, "frame_id", None) is not None:
                stream.n_lost += 1
                time.sleep(RETRY_S)
    while client.n_unanswered:
        client.poll(0.5)


def stream_all(clients: list[FilterClient], until) -> list[Stream]:
    """Stream to all clients until ``until`` returns; return what each got."""
    view, is_over = view_of(SIZE_PX), threading.Event()
    streams = [Stream() for _ in clients]
    threads = [
        threading.Thread(target=stream_one, args=(client, view, stream, is_over.is_set))
        for client, stream in zip(clients, streams, strict=True)
    ]
    for thread in threads:
        thread.start()
    try:
        until(streams)
    finally:
        is_over.set()
        for thread in threads:
            thread.join()
    return streams


def opened(closing: ExitStack, devices, count: int, *, sleeps: bool = False):
    """Return a service, and clients whose eyes are ready."""
    command = DOUBLE if sleeps else SERVE_COMMAND
    service = closing.enter_context(
        ServiceProcess({"devices": list(devices)}, command=command)
    )
    profile = {"kind": "double", "mark": 1} if sleeps else PROFILE
    view, clients = view_of(SIZE_PX), []
    for _ in range(count):
        client = FilterClient(service.endpoint, timeout_s=TIMEOUT_S, max_in_flight=1)
        clients.append(closing.enter_context(client))
        client.set_profile(profile, settings=SETTINGS, views=[view])
        for _ in range(3):
            client.filter(view, **SEE)
    return service, clients


def throughput_and_fairness(rounds: int, seconds: float) -> list[Row]:
    """Let one, two and four clients take turns, on two engines and on one."""
    rows = []
    with ExitStack() as closing:
        two, clients = opened(closing, TWO, 4)
        whole, others = opened(closing, WHOLE, 2)
        asleep, dreamers = opened(closing, TWO, 2, sleeps=True)
        engines = "two engines of a thread"
        groups = (
            [
                Case(f"{engines}, 1 client", two, clients[:1]),
                Case(f"{engines}, 2 clients", two, clients[:2]),
                Case(f"{engines}, 4 clients", two, clients),
                Case("one of two threads, 2 clients", whole, others),
            ],
            [
                Case("two that sleep, 1 client", asleep, dreamers[:1]),
                Case("two that sleep, 2 clients", asleep, dreamers),
            ],
        )
        for _ in range(rounds):
            for case in (*groups[0], *groups[1]):
                time.sleep(SETTLE_S)
                case.take_turn(seconds)
        for group in groups:
            for case in group:
                rows += rows_of(case, group[0])
    return rows


def rows_of(case: Case, alone: Case) -> list[Row]:
    """Return a case's rows; throughput is compared round by round."""
    times = np.array(case.rates_hz) / np.array(alone.rates_hz)
    text = f"{np.median(case.rates_hz):.2f} frames/s, {np.median(times):.2f} x one"
    memory_mb = case.service.memory_mb
    rows = [_row(case.name, "processor", case.processor_ms, memory_mb, ("none", 0.0))]
    if case is alone:
        return [_row(case.name, text, case.periods_ms, memory_mb, ("none", 0.0)), *rows]
    errors = (
        ("short_of_twice", 1.0 - float(np.median(times)) / 2.0),
        ("short_of_equal_share", float(np.median(case.unfair))),
    )
    streamed = [
        _row(case.name, text, case.periods_ms, memory_mb, error) for error in errors
    ]
    return streamed + rows


def one_killed(seconds: float) -> list[Row]:
    """Kill the engine of one of two clients in mid-stream."""
    with ExitStack() as closing:
        service, clients = opened(closing, TWO, 2)
        times_s = []

        def kill(streams: list[Stream]) -> None:
            time.sleep(seconds)
            os.kill(service.pids()["render 0"], signal.SIGKILL)
            killed_s = time.monotonic()
            while not streams[0].done_s or streams[0].done_s[-1] < killed_s + 0.5:
                if time.monotonic() > killed_s + LIMIT_S:
                    raise RuntimeError(f"no frame came within {LIMIT_S:g} s")
                time.sleep(0.05)
            back_s = next(s for s in streams[0].done_s if s > killed_s + 0.1)
            times_s.extend((killed_s, back_s))

        struck, other = stream_all(clients, kill)
        memory_mb = service.memory_mb
    killed_s, back_s = times_s
    before = [s for s in other.done_s if s < killed_s]
    meanwhile = [s for s in other.done_s if killed_s - 0.5 < s < back_s]
    found = {
        "the other before": (1e3 * np.diff(before), 0),
        "the other meanwhile": (1e3 * np.diff(meanwhile), other.n_lost),
        "to its next picture": ([1e3 * (back_s - killed_s)], struck.n_lost),
    }
    return [
        _row(
            *("one of two killed", case, times_ms, memory_mb),
            ("frames_not_filtered", float(n_lost)),
        )
        for case, (times_ms, n_lost) in found.items()
    ]


def _row(method: str, case: str, times_ms, memory_mb: float, error) -> Row:
    return Row(
        bench="devices",
        method=method,
        case=case,
        setting="1280x720, -2 dpt, 4 mm",
        n=len(times_ms),
        median_ms=float(np.median(times_ms)),
        p95_ms=float(np.percentile(times_ms, 95)),
        memory_mb=memory_mb,
        error_name=error[0],
        error=error[1],
        reference="one client alone on one of the engines, in the same round",
    )


def main(argv=None) -> None:
    """Run all cases, print and publish them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="seconds, not minutes")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rounds, seconds = (2, 1.5) if options.quick else (10, 2.5)
    rows = throughput_and_fairness(rounds, seconds) + one_killed(4.0)
    publish("devices", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
