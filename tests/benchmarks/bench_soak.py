"""Stream of 30 minutes with a new eye every 20 s: memory and lost frames.

    python -m tests.benchmarks.bench_soak [--minutes N] [--quick] [--json]

A real service, a client at 10 frames a second (640x360, pupil and focus changing) and a
profile of another prescription every 20 s.  Every 5 s: memory, descriptors and threads
of each process of the service, and the age of frames.  Error: slopes over the run,
fitted to all but its first fifth, per hour.  Writes results/soak.json.
"""

import argparse
import re
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame
from clients.service_process import ServiceProcess
from filter_service.wire.replies import Dropped
from tests.benchmarks.harness import Row, publish
from tests.benchmarks.mutated_messages import view_of

SIZE_PX = (640, 360)
RATE_HZ = 10.0
PROFILE_S, SAMPLE_S = 20.0, 5.0
SPHERES_DPT = np.linspace(-6.0, 2.0, 33)
SKIPPED = 0.2


def process_counts(pid: int) -> dict[str, float]:
    """Return memory in MB, open descriptors and threads of a process (Linux)."""
    status = Path(f"/proc/{pid}/status").read_text()

    def field(name: str) -> int:
        return int(re.search(rf"^{name}:\s+(\d+)", status, re.MULTILINE)[1])

    return {
        "memory_mb": field("VmRSS") / 1e3,
        "descriptors": len(list(Path(f"/proc/{pid}/fd").iterdir())),
        "threads": field("Threads"),
    }


def soak(minutes: float) -> tuple[dict[str, list], dict[str, int]]:
    """Return samples by name, with their times, and counts of what came back."""
    samples, counts = defaultdict(list), defaultdict(int)
    view = view_of(SIZE_PX)
    with ServiceProcess() as service, FilterClient(service.endpoint) as client:
        sphere = iter(np.tile(np.random.default_rng(0).permutation(SPHERES_DPT), 999))
        client.set_profile(profile(next(sphere)), views=[view])
        start_s = time.monotonic()
        next_profile_s, next_sample_s = start_s + PROFILE_S, start_s
        due_s: dict[int, float] = {}
        n = 0
        while (elapsed_s := time.monotonic() - start_s) < 60.0 * minutes:
            now_s = time.monotonic()
            if now_s >= next_profile_s:
                next_profile_s += PROFILE_S
                client.set_profile(profile(next(sphere)), views=[view], wait=False)
                counts["profiles"] += 1
            if now_s >= next_sample_s:
                next_sample_s += SAMPLE_S
                for name, pid in service.pids().items():
                    for what, value in process_counts(pid).items():
                        samples[f"{name} {what}"].append((elapsed_s, value))
                say(elapsed_s, minutes, counts)
            phase = 0.5 + 0.5 * np.sin(elapsed_s / 7.0)
            frame_id = client.submit(
                view, pupil_diameter_mm=3.0 + phase, focus_dpt=0.5 * phase
            )
            due_s[frame_id] = start_s + n / RATE_HZ
            n += 1
            while (wait_s := start_s + n / RATE_HZ - time.monotonic()) > 0.0:
                for event in client.poll(wait_s):
                    if isinstance(event, FilteredFrame):
                        age_ms = 1e3 * (time.monotonic() - due_s.pop(event.frame_id))
                        samples["frame age_ms"].append((elapsed_s, age_ms))
                        counts["filtered"] += 1
                    elif isinstance(event, Dropped):
                        counts[f"dropped, {event.reason}"] += 1
                    elif getattr(event, "code", "") not in ("", "build_cancelled"):
                        counts[f"error, {event.code}"] += 1
    return samples, counts


def profile(sphere_dpt: float) -> dict:
    """Return an eye."""
    return {"kind": "prescription", "sphere_dpt": float(sphere_dpt)}


def say(elapsed_s: float, minutes: float, counts: dict[str, int]) -> None:
    """Say on stderr how far it is."""
    done = f"{elapsed_s / 60:.1f} of {minutes:g} minutes"
    print(f"soak: {done}, {counts['filtered']} frames", file=sys.stderr, flush=True)


def rows_of(samples: dict[str, list], counts: dict[str, int], minutes: float):
    """Return a row for each thing sampled."""
    setting = f"{minutes:g} min, {counts['profiles']} profiles"
    ages_ms = np.array(samples["frame age_ms"])[:, 1]
    p50, p95 = np.percentile(ages_ms, (50, 95)).tolist()
    rows = []
    for name, found in samples.items():
        times_s, values = np.array(found).T
        late = times_s >= SKIPPED * times_s[-1]
        per_s = np.polyfit(times_s[late], values[late], 1)[0] if late.sum() > 2 else 0.0
        rows.append(
            Row(
                *("soak", name, f"{values[late].min():g} to {values[late].max():g}"),
                *(setting, len(values), p50, p95, float(values.max())),
                *("slope per hour", float(3600.0 * per_s), "flat"),
            )
        )
    for name, value in counts.items():
        rows.append(
            Row(
                *("soak", name, "count", setting, int(value), p50, p95, 0.0),
                *("count", float(value), "none lost"),
            )
        )
    return rows


def main() -> None:
    """Run, print, and write results/soak.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--quick", action="store_true", help="half a minute")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    minutes = 0.5 if options.quick else options.minutes
    samples, counts = soak(minutes)
    rows = rows_of(samples, counts, minutes)
    publish("soak", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
