"""A service under load and faults: overload, unequal clients, lost processes, upgrades.

- ``overload``: a schedule three times too fast.  Errors: the median age in periods of
  the filter (goal 1.5), by how many MB the service's memory changed, and frames
  without an event.  Times: age, counted from the schedule.
- ``sharing``: two clients without end, of which one floods, or sends frames many times
  as large.  A client's share is the time in which its frames were filtered, over that
  of both; error: how far it is from a half (goal 0.1 of it).  The case has what its
  frames take alone.
- ``one of two killed``: two engines of one thread behind one socket, of which one is
  killed: the other client's periods before and meanwhile, and the time to the next
  picture of the struck one.  Error: frames that were not filtered.
- ``first frame`` and ``whole eye``: from the end of the render worker of a live stream
  to the next picture, and to one through the whole eye.  Error: RMS of the latter less
  the same frame before, in levels of 255.
- ``live stream`` and ``filter calls``: the service is stopped, and the new version
  starts at the same endpoint at once (``--old`` names the program of the version to
  upgrade from).  Times: the pause between the last frame of the old service and the
  first of the new one.  Error: frames without any event, plus surplus events.
- ``soak``: 10 frames per second with changing pupil and focus, and a new prescription
  every 20 s.  Errors: slopes of memory, descriptors, threads and of the age of frames
  per hour, fitted to all but the first fifth.  Times: age of the frames.
"""

import os
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from functools import partial
from pathlib import Path

import numpy as np

from clients.service_process import SERVE_COMMAND, ServiceProcess
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.benchmarks.service_stream import PROFILE, Stream, view_of

MINUTES = 8
CASES = ("overload", "sharing", "killed", "restart", "upgrade", "soak")
RATE_HZ = 30.0
TOO_FAST = 3.0
N_ALONE = 12
STREAM_S = 15.0
SETTLE_S, SETTLE_STANDBY_S = 3.0, 12.0  # by then, a process that stands by is ready
N_RESTARTS, N_UPGRADES, SOAK_MINUTES = 2, 2, 3.0
UPGRADE_S = 3.0  # before the upgrade, and after the first frame of the new service

STATIC = {
    "pupil_range_mm": (4.0, 4.0),
    "focus_range_dpt": (0.0, 0.0),
    "object_range_dpt": (0.0, 1.0),
    "prepare": "ranges",  # nothing is built beside the stream
}
ALONE = "the service with one client alone"
SOAK_SIZE_PX, SOAK_HZ, PROFILE_S, SAMPLE_S = (640, 360), 10.0, 20.0, 5.0
SPHERES_DPT = np.linspace(-6.0, 2.0, 33)

row = partial(row_of, "faults")


def options(parser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--only", choices=CASES, help="one kind of cases")
    parser.add_argument("--old", metavar="PROGRAM", help="`ocufilter` to upgrade from")


def overload_rows(quick: bool) -> list[Row]:
    """Submit on a schedule that is too fast."""
    seconds, view, memory_mb = 8.0 if quick else STREAM_S, view_of((1280, 720)), []
    with ServiceProcess() as service, Stream(service.endpoint, view) as stream:
        while len(stream.filtered()) < N_ALONE:
            time.sleep(0.05)
        stream.stop()
        period_ms = stream.period_ms()
        stream.rate_hz = 1e3 * TOO_FAST / period_ms
        stream.start()
        time.sleep(SETTLE_S)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            memory_mb.append(service.memory_mb)
            time.sleep(0.1)
        stream.stop()
    ages_ms = [one.age_ms for one in stream.filtered()]
    case = f"1280x720, {TOO_FAST:g} times too fast, {seconds:g} s"
    return [
        row(
            *("overload", case, "-2 dpt, 4 mm", ages_ms, name, error, ALONE),
            used_mb=max(memory_mb),
        )
        for name, error in (
            ("median_age_periods", float(np.median(ages_ms)) / period_ms),
            ("memory_change_mb", max(memory_mb) - min(memory_mb)),
            ("frames_lost_silently", stream.n_unreported()),
        )
    ]


def sharing_rows(quick: bool) -> list[Row]:
    """Let two clients stream beside each other; return a row for each."""
    seconds, large = (8.0, (2048, 2048)) if quick else (STREAM_S, (4096, 4096))
    pairs = (
        (("a flood", (640, 360), 2), ("one", (640, 360), 1)),
        (("720p", (1280, 720), 2), ("180p", (320, 180), 2)),
        (("large", large, 2), ("small", (640, 360), 2)),
    )
    rows = []
    with ServiceProcess() as service:
        for pair in pairs:
            streams, alone_ms = {}, {}
            for name, size_px, in_flight in pair:
                streams[name] = Stream(
                    service.endpoint, view_of(size_px), in_flight=in_flight
                )
                streams[name].start()
                time.sleep(SETTLE_S)
                while len(streams[name].filtered()) < 4:
                    time.sleep(0.05)
                streams[name].stop()
                alone_ms[name] = streams[name].period_ms()
            for stream in streams.values():
                stream.start()
            time.sleep(SETTLE_S)
            begin_s = time.monotonic()
            time.sleep(seconds * (2.0 if pair[0][0] == "large" else 1.0))
            for stream in streams.values():
                stream.stop()
            # From one result of the slower to another: whole frames of it.
            slow = streams[max(alone_ms, key=alone_ms.get)]
            whole_s = [o.at_s for o in slow.filtered() if o.at_s > begin_s]
            used_ms = {
                name: sum(
                    one.used_ms
                    for one in stream.filtered()
                    if whole_s[0] < one.at_s <= whole_s[-1]
                )
                for name, stream in streams.items()
            }
            for name, other in (list(streams), list(streams)[::-1]):
                share = used_ms[name] / sum(used_ms.values())
                case = f"beside {other}; alone {alone_ms[name]:.0f} ms a frame"
                ages_ms = [one.age_ms for one in streams[name].filtered()]
                rows.append(
                    row(
                        *(f"sharing, {name}", case, "-2 dpt, 4 mm", ages_ms),
                        *("share_from_a_half", abs(share / 0.5 - 1.0), ALONE),
                    )
                )
            for stream in streams.values():
                stream.client.close()
    return rows


def killed_rows(quick: bool) -> list[Row]:
    """Kill the engine of one of two clients while both stream."""
    view = view_of((1280, 720))
    with (
        ServiceProcess({"devices": ["native:1", "native:1"]}) as service,
        Stream(service.endpoint, view, settings=STATIC) as struck,
        Stream(service.endpoint, view, settings=STATIC) as other,
    ):
        time.sleep(2.0 if quick else 4.0)
        os.kill(service.pids()["render 0"], signal.SIGKILL)
        killed_s = time.monotonic()
        back_s = struck.wait_for(lambda one: one.due_s > killed_s).at_s
        for stream in (struck, other):
            stream.stop()
        memory_mb = service.memory_mb
    times_s = np.array([one.at_s for one in other.filtered()])
    periods_ms = 1e3 * np.diff(times_s)
    found = {
        "the other before": (periods_ms[times_s[1:] < killed_s], 0),
        "the other meanwhile": (
            periods_ms[(times_s[1:] > killed_s - 0.5) & (times_s[1:] < back_s)],
            len(other.seen) - len(times_s),
        ),
        "to its next picture": (
            [1e3 * (back_s - killed_s)],
            len(struck.seen) - len(struck.filtered()),
        ),
    }
    return [
        row(
            *("one of two killed", case, "1280x720, -2 dpt, 4 mm", times_ms),
            *("frames_not_filtered", n_lost, ALONE),
            used_mb=memory_mb,
        )
        for case, (times_ms, n_lost) in found.items()
    ]


def restart_rows(quick: bool) -> list[Row]:
    """Kill the render worker of a live stream, again and again."""
    view, rows = view_of((1280, 720)), []
    with tempfile.TemporaryDirectory() as folder:
        on_disk = {"store_cache_dir": str(Path(folder) / "eyes")}
        cases = {
            "PSFs on disk": on_disk,
            "PSFs built anew": {},
            "built anew, standby": {"standby": True},
            "on disk, standby": {"standby": True, **on_disk},
        }
        for case, settings in list(cases.items())[: 1 if quick else None]:
            first_ms, whole_ms, errors = [], [], []
            with (
                ServiceProcess(settings) as service,
                Stream(service.endpoint, view, rate_hz=RATE_HZ) as stream,
            ):
                stream.wait_for(lambda one: one.is_complete)
                before = stream.last.color.astype(np.float32)
                for _ in range(1 if quick else N_RESTARTS):
                    is_standby = settings.get("standby", False)
                    time.sleep(SETTLE_STANDBY_S if is_standby else SETTLE_S)
                    os.kill(service.pids()["render"], signal.SIGKILL)
                    killed_s = time.monotonic()
                    for times_ms, is_whole in ((first_ms, False), (whole_ms, True)):
                        seen = stream.wait_for(
                            lambda one, killed_s=killed_s, is_whole=is_whole: (
                                one.due_s > killed_s and one.is_complete >= is_whole
                            )
                        )
                        times_ms.append(1e3 * (seen.at_s - killed_s))
                    change = stream.last.color - before
                    errors.append(float(np.sqrt(np.mean(change**2))))
                memory_mb = service.memory_mb
            rows += [
                row(
                    *(method, case, f"1280x720 at {RATE_HZ:g} Hz, -2 dpt", times_ms),
                    *("rmse_levels", max(errors), "the same frame before"),
                    used_mb=memory_mb,
                )
                for method, times_ms in (
                    ("first frame", first_ms),
                    ("whole eye", whole_ms),
                )
            ]
    return rows


def upgraded(old: tuple[str, ...], settings: dict, calls: bool) -> dict:
    """Upgrade the service under one client; return what became of its frames."""
    view = view_of((640, 360))
    service = ServiceProcess(settings, command=old)
    try:
        stream = Stream(service.endpoint, view, rate_hz=RATE_HZ, calls=calls)
        with stream:
            before = stream.last.color.astype(np.float32)
            time.sleep(UPGRADE_S)
            times_s = [time.monotonic()]
            service.stop()
            times_s.append(time.monotonic())
            service = ServiceProcess(settings | {"bind": service.endpoint})
            times_s.append(time.monotonic())
            known = stream.filtered()[0].session
            stream.wait_for(lambda one: one.session != known)
            time.sleep(UPGRADE_S)
            stream.stop()
            memory_mb = service.memory_mb
    finally:
        service.stop()
    seen = stream.filtered()
    at = next(i for i, one in enumerate(seen) if one.session != known)
    ids = sorted(stream.due_s)
    change = stream.last.color - before
    stop_ms, start_ms = (1e3 * np.diff(times_s)).round(1).tolist()
    return {
        "submitted": len(ids),
        **Counter(one.kind for one in stream.seen),
        # `filter` submits a frame again under a new id, and returns the last one's.
        **({"sent_again": ids[-1] - ids[0] + 1 - len(ids)} if calls else {}),
        "without_event": stream.n_unreported(),
        "pause_ms": round(1e3 * (seen[at].at_s - seen[at - 1].at_s), 1),
        "stop_ms": stop_ms,
        "start_ms": start_ms,
        "versions": sorted({one.session[1] for one in seen}),
        "rms_levels": round(float(np.sqrt(np.mean(change**2))), 3),
        "memory_mb": round(memory_mb),
    }


def upgrade_rows(quick: bool, old: str | None) -> tuple[list[Row], list[dict]]:
    """Upgrade a service under a live stream, and under calls of `filter`."""
    rows, runs = [], []
    command = (old, "serve") if old else SERVE_COMMAND
    for case in ("eyes computed anew", "eyes on disk")[: 1 if quick else None]:
        for method in ("live stream", "filter calls"):
            with tempfile.TemporaryDirectory() as folder:
                on_disk = {"store_cache_dir": str(Path(folder) / "eyes")}
                settings = on_disk if case == "eyes on disk" else {}
                found = [
                    upgraded(command, settings, method == "filter calls")
                    for _ in range(1 if quick else N_UPGRADES)
                ]
            runs += [{"method": method, "case": case, **one} for one in found]
            rows.append(
                row(
                    *(method, case, "640x360, -2 dpt"),
                    *([one["pause_ms"] for one in found], "without event"),
                    sum(one["without_event"] for one in found),
                    "one event for every submitted frame",
                    used_mb=max(one["memory_mb"] for one in found),
                )
            )
    return rows, runs


def process_counts(pid: int) -> dict[str, float]:
    """Return memory in MB, open descriptors and threads of a process (Linux)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    return {
        "memory_mb": int(status["VmRSS"].split()[0]) / 1e3,
        "descriptors": len(list(Path(f"/proc/{pid}/fd").iterdir())),
        "threads": int(status["Threads"]),
    }


def soak_rows(quick: bool) -> list[Row]:
    """Stream for minutes; return a row for each thing that is sampled."""
    minutes, samples = 0.5 if quick else SOAK_MINUTES, defaultdict(list)
    spheres = iter(np.tile(np.random.default_rng(0).permutation(SPHERES_DPT), 999))
    counts, view = Counter(), view_of(SOAK_SIZE_PX)
    due_s = [time.monotonic() + PROFILE_S]

    def state(_: int) -> dict:
        """Return pupil and focus; ask for another eye when it is due."""
        if time.monotonic() >= due_s[0]:
            due_s[0] += PROFILE_S
            body = PROFILE | {"sphere_dpt": float(next(spheres))}
            stream.client.set_profile(body, views=[view], wait=False)
            counts["profiles"] += 1
        phase = 0.5 + 0.5 * np.sin(time.monotonic() / 7.0)
        return {"pupil_diameter_mm": 3.0 + phase, "focus_dpt": 0.5 * phase}

    with ServiceProcess() as service:
        with Stream(service.endpoint, view, rate_hz=SOAK_HZ, in_flight=2) as stream:
            stream.state = state
            start_s = time.monotonic()
            while (elapsed_s := time.monotonic() - start_s) < 60.0 * minutes:
                for name, pid in service.pids().items():
                    for what, value in process_counts(pid).items():
                        samples[f"{name} {what}"].append((elapsed_s, value))
                time.sleep(SAMPLE_S)
        counts |= Counter(one.kind for one in stream.seen) + stream.errors
    seen = stream.filtered()
    samples["frame age_ms"] = [(one.at_s - start_s, one.age_ms) for one in seen]
    ages_ms, setting = [one.age_ms for one in seen], f"{minutes:g} min, 640x360"
    rows = []
    for name, found in samples.items():
        times_s, values = np.array(found).T
        late = times_s >= 0.2 * times_s[-1]
        slope = 3600.0 * np.polyfit(times_s[late], values[late], 1)[0]
        case = f"{name}: {values[late].min():g} to {values[late].max():g}"
        rows.append(
            row("soak", case, setting, ages_ms, "slope per hour", slope, "flat")
        )
    rows += [
        row("soak", name, setting, ages_ms, "count", value, "none lost")
        for name, value in counts.items()
    ]
    return rows


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return the rows of some or all cases, and the counts of each upgrade."""
    rows, runs = [], []
    simple = {
        "overload": overload_rows,
        "sharing": sharing_rows,
        "killed": killed_rows,
        "restart": restart_rows,
        "soak": soak_rows,
    }
    for name in [run.options.only] if run.options.only else CASES:
        print(f"faults: {name}", file=sys.stderr, flush=True)
        if name == "upgrade":
            found, runs = upgrade_rows(run.is_quick, run.options.old)
            rows += found
        else:
            rows += simple[name](run.is_quick)
    return rows, {"runs": runs} if runs else {}
