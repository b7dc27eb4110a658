"""Frames of a streaming client while the service is upgraded.

    python -m tests.benchmarks.bench_upgrade [--old PROGRAM] [--quick] [--json]

A client sends 640x360 frames through -2 dpt.  The service is stopped with SIGTERM, and
the new version starts at the same endpoint at once.  ``--old`` is the `ocufilter`
program of another environment, with the version to upgrade from; without it, both
versions are this checkout.

A live stream calls `submit` 30 times per second and `poll`.  The other client calls
`filter` frame after frame.  Every submitted frame is matched with its event: filtered,
dropped with a reason, or refused.  Times: the pause between the last frame of the old
service and the first of the new one, of which the service needs ``stop_ms`` to end and
``start_ms`` until it is ready.  Error: frames without any event, plus events
beyond the first of a frame.  Writes results/upgrade.json, with the counts of each run.
"""

import argparse
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.latency.stream import StreamSettings, make_frames
from clients.service_process import SERVE_COMMAND, ServiceProcess
from filter_service.messages import Dropped, ErrorReply
from tests.benchmarks.harness import Row, publish

PROFILE = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -2}
SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
RATE_HZ = 30.0
STREAM_S = 3.0  # before the upgrade, and after the first frame of the new service
LIMIT_S = 60.0


@dataclass
class Run:
    """Frames and events of one client during one upgrade."""

    submitted: list[int] = field(default_factory=list)
    outcomes: dict[int, list[str]] = field(default_factory=dict)
    times_s: list[float] = field(default_factory=list)
    sessions: list[str] = field(default_factory=list)  # of the filtered frames
    versions: list[str] = field(default_factory=list)
    rms_levels: float = 0.0
    stop_ms: float = 0.0
    start_ms: float = 0.0

    def add(self, event: object, client: FilterClient) -> None:
        """Record an event that concerns a frame."""
        if isinstance(event, FilteredFrame):
            outcome = "filtered"
            self.times_s.append(time.monotonic())
            welcome = client.welcome
            if welcome is not None:
                self.sessions.append(welcome.session_key)
                self.versions.append(welcome.server["version"])
        elif isinstance(event, Dropped):
            outcome = event.reason
        elif isinstance(event, ErrorReply) and event.frame_id is not None:
            outcome = event.code
        else:
            return
        self.outcomes.setdefault(event.frame_id, []).append(outcome)

    @property
    def is_served_again(self) -> bool:
        """Return whether the new service has filtered a frame."""
        return len(set(self.sessions)) > 1

    @property
    def n_unreported(self) -> int:
        """Return the number of frames without an event and of surplus events."""
        counts = [len(self.outcomes.get(i, ())) for i in self.submitted]
        return sum(abs(n - 1) for n in counts)

    @property
    def pause_ms(self) -> float:
        """Return the time without frames between the two services."""
        first = self.sessions.index(self.sessions[-1])
        return 1e3 * (self.times_s[first] - self.times_s[first - 1])

    def counts(self) -> dict:
        """Return what became of the frames."""
        kinds = Counter(kind for kinds in self.outcomes.values() for kind in kinds)
        return {
            "submitted": len(self.submitted),
            **dict(kinds.most_common()),
            "without_event": self.n_unreported,
            "pause_ms": round(self.pause_ms, 1),
            "stop_ms": round(self.stop_ms, 1),
            "start_ms": round(self.start_ms, 1),
            "versions": sorted(set(self.versions)),
            "rms_levels": round(self.rms_levels, 3),
        }


def stream(client: FilterClient, view: RgbdView, run: Run) -> None:
    """Submit frames on a schedule until the new service has served for a while."""
    due_s = start_s = time.monotonic()
    end_s = None
    while end_s is None or time.monotonic() < end_s:
        if time.monotonic() > start_s + LIMIT_S:
            raise RuntimeError(f"no frame of the new service within {LIMIT_S:g} s")
        run.submitted.append(client.submit(view, **SEE))
        due_s += 1.0 / RATE_HZ
        while (wait_s := due_s - time.monotonic()) > 0:
            for event in client.poll(wait_s):
                run.add(event, client)
        if end_s is None and run.is_served_again:
            end_s = time.monotonic() + STREAM_S
    while client.n_unanswered and time.monotonic() < end_s + LIMIT_S:
        for event in client.poll(0.1):
            run.add(event, client)


def filter_frames(client: FilterClient, view: RgbdView, run: Run) -> None:
    """Call `filter` until the new service has served for a while."""
    end_s = None
    while end_s is None or time.monotonic() < end_s:
        reply = client.filter(view, **SEE, timeout_s=LIMIT_S)
        # `filter` submits under a new id each time, and returns the last one's result.
        n_before = len(run.submitted)
        run.submitted.append(reply.frame_id)
        run.add(reply, client)
        sent_again = reply.frame_id - (run.submitted[-2] + 1 if n_before else 0)
        if n_before and sent_again:
            run.outcomes.setdefault(-1, []).extend(["sent_again"] * sent_again)
        if end_s is None and run.is_served_again:
            end_s = time.monotonic() + STREAM_S


WAYS = {"live stream": stream, "filter calls": filter_frames}


def upgrade(way: str, old: tuple[str, ...], settings: dict) -> tuple[Run, float]:
    """Upgrade the service under one client; return the run and the memory in MB."""
    frames = make_frames(
        StreamSettings(640, 360, 1, RATE_HZ, 1.0, PROFILE, {}, 4.0, 0.0, "srgb8", 1)
    )
    view = frames[0][0]
    run = Run()
    failures: list[BaseException] = []

    def send() -> None:
        try:
            WAYS[way](client, view, run)
        except BaseException as error:
            failures.append(error)

    service = ServiceProcess(settings, command=old)
    try:
        with FilterClient(service.endpoint, timeout_s=LIMIT_S) as client:
            client.set_profile(PROFILE, views=[view])
            before = client.filter(view, **SEE).color.astype(np.float32)
            thread = threading.Thread(target=send, daemon=True)
            thread.start()
            time.sleep(STREAM_S)
            times_s = [time.monotonic()]
            service.stop()
            times_s.append(time.monotonic())
            service = ServiceProcess(settings | {"bind": service.endpoint})
            times_s.append(time.monotonic())
            run.stop_ms, run.start_ms = (1e3 * np.diff(times_s)).tolist()
            thread.join()
            if failures:
                raise failures[0]
            after = client.filter(view, **SEE).color
            run.rms_levels = float(np.sqrt(np.mean((after - before) ** 2)))
            return run, service.memory_mb
    finally:
        service.stop()


def main(argv=None) -> None:
    """Run all cases, print and publish them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--old", metavar="PROGRAM", help="`ocufilter` of the old one")
    parser.add_argument("--quick", action="store_true", help="one repeat")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    old = (options.old, "serve") if options.old else SERVE_COMMAND
    rows, counts = [], []
    for case in ("eyes computed anew", "eyes on disk"):
        for way in WAYS:
            with tempfile.TemporaryDirectory() as folder:
                on_disk = {"store_cache_dir": str(Path(folder) / "eyes")}
                settings = on_disk if case == "eyes on disk" else {}
                runs = []
                for _ in range(1 if options.quick else 3):
                    run, memory_mb = upgrade(way, old, settings)
                    runs.append(run)
                    counts.append({"method": way, "case": case, **run.counts()})
            pauses_ms = [run.pause_ms for run in runs]
            rows.append(
                Row(
                    bench="upgrade",
                    method=way,
                    case=case,
                    setting="640x360, -2 dpt",
                    n=len(runs),
                    median_ms=float(np.median(pauses_ms)),
                    p95_ms=float(max(pauses_ms)),
                    memory_mb=memory_mb,
                    error_name="without event",
                    error=float(sum(run.n_unreported for run in runs)),
                    reference="one event for every submitted frame",
                )
            )
    is_whole, details = not options.quick, {"runs": counts}
    publish("upgrade", rows, as_json=options.json, is_whole=is_whole, details=details)


if __name__ == "__main__":
    main()
