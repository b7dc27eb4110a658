"""Memory, frame rate and processor time by the number of clients and eyes.

    python -m tests.benchmarks.bench_clients [--quick] [--json]

1, 2 and 4 clients stream at once through eyes of their own, with one or two eyes each:
640x360 pixels per eye, as fast as the service answers.  Pupil and focus change in every
frame, through a cycle whose PSFs exist before the measurement.  Images are in shared
memory.  Each case runs three times, and the best run counts, because other programs
slow down a run and never speed it up.

Times: processor time of all processes of the service per frame and eye, of the best and
of the worst run.  Memory: that of `ocufilter status`, at the end.  Error: frames
without a result.  Writes results/clients.json, with the frame rate, the memory of all
processes including those that `status` does not count, and the memory without a client.
"""

import argparse
import math
import os
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clients.filter_client import FilterClient, FilteredFrame, ViewState
from clients.latency.stream import EYES, StreamSettings, make_frames
from clients.service_process import ServiceProcess
from filter_service.messages import Dropped, ErrorReply
from tests.benchmarks.harness import Row, publish

SIZE_PX = (640, 360)
WARM_UP_S, MEASURED_S = 1.0, 6.0
N_STATES = 24
PREPARE_LIMIT_S = 120.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass
class Stream:
    """One client, its number of eyes and what it counts."""

    index: int
    n_eyes: int
    n_filtered: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    failures: list[BaseException] = field(default_factory=list)

    def run(self, endpoint: str, barrier: threading.Barrier) -> None:
        """Prepare the eyes, wait for the others and stream."""
        try:
            with FilterClient(endpoint, timeout_s=PREPARE_LIMIT_S) as client:
                self._stream(client, barrier)
        except BaseException as error:
            self.failures.append(error)
            barrier.abort()

    def _profile(self, eye: int) -> dict:
        side = ("OS", "OD")[eye]
        sphere_dpt = -1.0 - self.index - 0.25 * eye
        return {"kind": "prescription", "eye_side": side, "sphere_dpt": sphere_dpt}

    def _stream(self, client: FilterClient, barrier: threading.Barrier) -> None:
        right = self._profile(1) if self.n_eyes == 2 else None
        settings = StreamSettings(
            *SIZE_PX,
            *(self.n_eyes, 0.0, 1.0, self._profile(0), {}, 4.0, 0.0, "srgb8", 2),
            right_profile=right,
        )
        frames = make_frames(settings)
        if right is None:
            client.set_profile(settings.profile, views=frames[0])
        else:
            for eye, name in enumerate(EYES):
                client.set_profile(self._profile(eye), eye=name, views=[frames[0][eye]])
        states = settings.states if right else [ViewState()]

        def values(n: int) -> dict[str, Any]:
            phase = 2 * math.pi * (n / N_STATES + self.index / 4)
            return {
                "pupil_diameter_mm": 4 + math.sin(phase),
                "focus_dpt": 1 + math.cos(phase),
                "states": states,
            }

        for n in range(N_STATES):
            client.filter(
                frames[n % len(frames)], timeout_s=PREPARE_LIMIT_S, **values(n)
            )
        barrier.wait()
        start_s = time.monotonic()
        begin_s, end_s = start_s + WARM_UP_S, start_s + WARM_UP_S + MEASURED_S
        n_submitted = 0
        while time.monotonic() < end_s:
            if not client.n_unanswered:
                frame = frames[n_submitted % len(frames)]
                client.submit(frame, **values(n_submitted % N_STATES))
                n_submitted += 1
                continue
            for event in client.poll(1.0):
                is_counted = time.monotonic() >= begin_s
                self.n_filtered += is_counted and isinstance(event, FilteredFrame)
                if isinstance(event, Dropped):
                    self.failed[event.reason] += 1
                elif isinstance(event, ErrorReply):
                    self.failed[event.code] += 1
        barrier.wait()  # memory is read while all sessions exist
        barrier.wait()


def processes_of(pid: int) -> list[int]:
    """Return a process and all its descendants (Linux)."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += processes_of(int(child))
    return found


def cpu_s_of(pids: list[int]) -> float:
    """Return the processor time that processes have used, user and system."""
    ticks = 0
    for pid in pids:
        words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        ticks += int(words[11]) + int(words[12])
    return ticks / TICKS_PER_S


def memory_mb_of(pids: list[int]) -> float:
    """Return the proportional set size of processes."""
    kilobytes = 0
    for pid in pids:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                kilobytes += int(line.split()[1])
    return 1.024e-3 * kilobytes


def measure(n_clients: int, n_eyes: int) -> dict:
    """Run the streams once against a new service; return the figures."""
    streams = [Stream(i, n_eyes) for i in range(n_clients)]
    barrier = threading.Barrier(n_clients + 1, timeout=300.0)
    with ServiceProcess({"threads": len(os.sched_getaffinity(0))}) as service:
        pids = processes_of(service.process.pid)
        with FilterClient(service.endpoint, timeout_s=30.0) as observer:
            idle_mb = observer.ping()[1].memory_mb
            threads = [
                threading.Thread(target=stream.run, args=(service.endpoint, barrier))
                for stream in streams
            ]
            for thread in threads:
                thread.start()
            barrier.wait()
            time.sleep(WARM_UP_S)
            pids = processes_of(service.process.pid)
            cpu_s, start_s = cpu_s_of(pids), time.monotonic()
            barrier.wait()
            cpu_s, duration_s = cpu_s_of(pids) - cpu_s, time.monotonic() - start_s
            memory_mb = observer.ping()[1].memory_mb
            all_mb = memory_mb_of(processes_of(service.process.pid))
            barrier.wait()
            for thread in threads:
                thread.join()
        for stream in streams:
            if stream.failures:
                raise stream.failures[0]
    n_images = n_eyes * sum(stream.n_filtered for stream in streams)
    rates_hz = [stream.n_filtered / MEASURED_S for stream in streams]
    return {
        "clients": n_clients,
        "eyes_per_client": n_eyes,
        "frames_per_s_of_each_client": round(sum(rates_hz) / n_clients, 1),
        "slowest_client_frames_per_s": round(min(rates_hz), 1),
        "images_per_s": round(sum(rates_hz) * n_eyes, 1),
        "cores_used": round(cpu_s / duration_s, 2),
        "cpu_ms_per_image": round(1e3 * cpu_s / max(n_images, 1), 2),
        "images_per_core_second": round(n_images / cpu_s, 1),
        "memory_idle_mb": round(idle_mb),
        "memory_mb": round(memory_mb),
        "memory_all_processes_mb": round(all_mb),
        "failed_frames": dict(sum((s.failed for s in streams), Counter())),
    }


def main(argv=None) -> None:
    """Run all cases, print and publish them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one run of each case")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rows, bests = [], []
    for n_eyes in (1, 2):
        for n_clients in (1, 2, 4):
            runs = [
                measure(n_clients, n_eyes) for _ in range(1 if options.quick else 3)
            ]
            best = min(runs, key=lambda run: run["cpu_ms_per_image"])
            n_failed = sum(sum(run["failed_frames"].values()) for run in runs)
            bests.append(best)
            rows.append(
                Row(
                    bench="clients",
                    method=f"{n_clients} clients",
                    case=f"{n_eyes} eyes each",
                    setting=f"{SIZE_PX[0]}x{SIZE_PX[1]} per eye",
                    n=len(runs),
                    median_ms=best["cpu_ms_per_image"],
                    p95_ms=max(run["cpu_ms_per_image"] for run in runs),
                    memory_mb=max(run["memory_mb"] for run in runs),
                    error_name="failed frames",
                    error=float(n_failed),
                    reference="a result for every frame",
                )
            )
    is_whole, details = not options.quick, {"best_runs": bests}
    publish("clients", rows, as_json=options.json, is_whole=is_whole, details=details)


if __name__ == "__main__":
    main()
