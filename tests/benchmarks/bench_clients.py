"""Memory, frame rate and processor time by the number of clients and eyes.

1, 2 and 4 clients stream at once through eyes of their own, with one or two eyes each:
640x360 pixels per eye, as fast as the service answers.  Pupil and focus change in every
frame, through a cycle whose PSFs exist before the measurement.  Images are in shared
memory.  Each case runs twice, and the better run counts, because other programs
slow down a run and never speed it up.

Times: processor time of all processes of the service per frame and eye, of the better
and of the worse run.  Memory: that of `ocufilter status`, at the end.  Error: frames
without a result.  ``best_runs`` has the frame rate, the memory of all processes
including those that `status` does not count, and the memory without a client.
"""

import math
import os
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from clients.filter_client import FilterClient, ViewState
from clients.latency.stream import EYES, StreamSettings, make_frames
from clients.service_process import ServiceProcess
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.service_stream import Stream, processor_s

MINUTES = 3
SIZE_PX = (640, 360)
WARM_UP_S, MEASURED_S = 1.0, 4.0
N_RUNS = 2
N_STATES = 24
PREPARE_LIMIT_S = 120.0


def prepared_stream(endpoint: str, index: int, n_eyes: int) -> Stream:
    """Return a client whose eyes and PSFs exist."""
    profiles = [
        {
            "kind": "prescription",
            "eye_side": side,
            "sphere_dpt": -1.0 - index - 0.25 * eye,
        }
        for eye, side in enumerate(("OS", "OD"))
    ]
    settings = StreamSettings(
        *SIZE_PX,
        *(n_eyes, 0.0, 1.0, profiles[0], {}, 4.0, 0.0, "srgb8", 2),
        right_profile=profiles[1] if n_eyes == 2 else None,
    )
    frames = make_frames(settings)

    def state(number: int) -> dict[str, Any]:
        phase = 2 * math.pi * (number / N_STATES + index / 4)
        return {
            "pupil_diameter_mm": 4 + math.sin(phase),
            "focus_dpt": 1 + math.cos(phase),
            "states": settings.states if n_eyes == 2 else [ViewState()],
        }

    def prepare(client: FilterClient) -> None:
        if n_eyes == 1:
            client.set_profile(profiles[0], views=frames[0])
        else:
            for eye, name in enumerate(EYES):
                client.set_profile(profiles[eye], eye=name, views=[frames[0][eye]])
        for number in range(N_STATES):
            frame = frames[number % len(frames)]
            client.filter(frame, timeout_s=PREPARE_LIMIT_S, **state(number))

    return Stream(endpoint, frames, state=state, prepare=prepare)


def processes_of(pid: int) -> list[int]:
    """Return a process and all its descendants (Linux)."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += processes_of(int(child))
    return found


def memory_mb_of(pids: list[int]) -> float:
    """Return the proportional set size of processes."""
    kilobytes = 0
    for pid in pids:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                kilobytes += int(line.split()[1])
    return 1.024e-3 * kilobytes


def streamed(n_clients: int, n_eyes: int) -> dict:
    """Run the streams once against a new service; return the figures."""
    with ExitStack() as closing:
        service = closing.enter_context(
            ServiceProcess({"threads": len(os.sched_getaffinity(0))})
        )
        observer = closing.enter_context(FilterClient(service.endpoint, timeout_s=30.0))
        idle_mb = observer.ping()[1].memory_mb
        streams = [
            prepared_stream(service.endpoint, index, n_eyes)
            for index in range(n_clients)
        ]
        for stream in streams:
            closing.enter_context(stream)
        time.sleep(WARM_UP_S)
        pids = processes_of(service.process.pid)
        cpu_s, start_s = processor_s(pids), time.monotonic()
        time.sleep(MEASURED_S)
        cpu_s, end_s = processor_s(pids) - cpu_s, time.monotonic()
        for stream in streams:
            stream.stop()
        memory_mb = observer.ping()[1].memory_mb
        all_mb = memory_mb_of(processes_of(service.process.pid))
    duration_s = end_s - start_s
    counts = [
        sum(start_s <= one.at_s <= end_s for one in stream.filtered())
        for stream in streams
    ]
    failed: Counter[str] = Counter()
    for stream in streams:
        failed += Counter(o.kind for o in stream.seen if o.kind != "filtered")
    n_images, rates_hz = n_eyes * sum(counts), [n / duration_s for n in counts]
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
        "failed_frames": dict(failed),
    }


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return a row and the best run of each case."""
    rows, bests = [], []
    cases = [(eyes, clients) for eyes in (1, 2) for clients in (1, 2, 4)]
    for n_eyes, n_clients in cases[3:4] if run.is_quick else cases:
        runs = [
            streamed(n_clients, n_eyes) for _ in range(1 if run.is_quick else N_RUNS)
        ]
        best = min(runs, key=lambda one: one["cpu_ms_per_image"])
        bests.append(best)
        rows.append(
            Row(
                bench="clients",
                method=f"{n_clients} clients",
                case=f"{n_eyes} eyes each",
                setting=f"{SIZE_PX[0]}x{SIZE_PX[1]} per eye",
                n=len(runs),
                median_ms=best["cpu_ms_per_image"],
                p95_ms=max(one["cpu_ms_per_image"] for one in runs),
                memory_mb=max(one["memory_mb"] for one in runs),
                error_name="failed frames",
                error=float(sum(sum(one["failed_frames"].values()) for one in runs)),
                reference="a result for every frame",
            )
        )
    return rows, {"best_runs": bests}
