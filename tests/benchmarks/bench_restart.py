"""Time from the end of the render worker to the next picture of a live stream.

    python -m tests.benchmarks.bench_restart [--quick] [--json]

A client streams 1280x720 at 30 Hz through -2 dpt; the process is killed, and the time
counts from there to the first frame that comes back.  With PSFs on disk, without (then
the first frame is seen through a preview), and with a second process that stands by.
Error: of the first frame seen through the whole eye again, against the same frame
before: the eye is the same, the part of it that was prepared may be another.  Writes
results/restart.json.
"""

import argparse
import os
import signal
import tempfile
import time
from pathlib import Path

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame
from clients.latency.stream import StreamSettings, make_frames
from clients.service_process import ServiceProcess
from tests.benchmarks.harness import Row, publish

PROFILE = {"kind": "prescription", "eye_side": "OD", "sphere_dpt": -2}
SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
RATE_HZ = 30.0
SETTLE_S = 12.0  # a process that stands by is ready, too
LIMIT_S = 30.0


def stream_until(client: FilterClient, view, is_wanted) -> FilteredFrame:
    """Stream on a schedule until a frame is as wanted; return it."""
    due_s = begin_s = time.monotonic()
    while time.monotonic() < begin_s + LIMIT_S:
        client.submit(view, **SEE)
        due_s += 1.0 / RATE_HZ
        while (wait_s := due_s - time.monotonic()) > 0:
            for event in client.poll(wait_s):
                if isinstance(event, FilteredFrame) and is_wanted(event):
                    return event
    raise RuntimeError(f"no such frame within {LIMIT_S:g} s")


def rows_of(case: str, settings: dict, repeats: int) -> list[Row]:
    """Kill the process again and again; return times to the first frame and whole."""
    frames = make_frames(
        StreamSettings(1280, 720, 1, RATE_HZ, 1.0, PROFILE, {}, 4.0, 0.0, "srgb8", 1)
    )
    view = frames[0][0]
    first_ms, whole_ms, errors = [], [], []
    with (
        ServiceProcess(settings) as service,
        FilterClient(service.endpoint, timeout_s=60.0) as client,
    ):
        client.set_profile(PROFILE, views=[view])
        before = client.filter(view, **SEE).color.astype(np.float32)
        for _ in range(repeats):
            settle(client, view)
            os.kill(service.pids()["render"], signal.SIGKILL)
            killed_s = time.monotonic()
            stream_until(client, view, lambda frame: True)
            first_ms.append(1e3 * (time.monotonic() - killed_s))
            whole = stream_until(client, view, lambda frame: frame.is_complete)
            whole_ms.append(1e3 * (time.monotonic() - killed_s))
            errors.append(float(np.sqrt(np.mean((whole.color - before) ** 2))))
        memory_mb = service.memory_mb
    return [
        Row(
            bench="restart",
            method=method,
            case=case,
            setting=f"1280x720 at {RATE_HZ:g} Hz, -2 dpt",
            n=repeats,
            median_ms=float(np.median(times_ms)),
            p95_ms=float(max(times_ms)),
            memory_mb=memory_mb,
            error_name="rmse_levels",
            error=max(errors),
            reference="the same frame before, once the whole eye is there again",
        )
        for method, times_ms in (("first frame", first_ms), ("whole eye", whole_ms))
    ]


def settle(client: FilterClient, view) -> None:
    """Stream until nothing more is built or loaded."""
    end_s = time.monotonic() + SETTLE_S
    stream_until(client, view, lambda frame: time.monotonic() > end_s)


def main(argv=None) -> None:
    """Run all cases, print and publish them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one repeat")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    repeats = 1 if options.quick else 4
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        kept = Path(folder) / "eyes"
        for case, settings in (
            ("PSFs on disk", {"store_cache_dir": str(kept)}),
            ("PSFs built anew", {}),
            ("built anew, standby", {"standby": True}),
            ("on disk, standby", {"standby": True, "store_cache_dir": str(kept)}),
        ):
            rows += rows_of(case, settings, repeats)
    publish("restart", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
