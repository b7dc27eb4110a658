"""Latency of frames through a service, by transport, mono and stereo.

What `ocufilter latency` measures, of services that this benchmark starts: pre-rendered
frames on a fixed schedule (a frame's due time does not depend on earlier replies) by
tcp, ipc, shared memory beside ipc, and tcp with encryption (``curve``).  Mono is
1280x720 at 10 Hz; stereo is a headset's 2 x 1832x1920 at 3 Hz.

A row is a stage of a frame, or a sum: ``added_ms`` is the round trip less the
renderer's stages, ``service_total_ms`` the time in the service, ``age_ms`` counts from
the schedule.  ``bare_socket`` is the round trip of as many bytes over a bare socket
between two processes: a lower bound for any protocol.  The error is the PSNR of 8-bit
images less the same frames in this process, with no tolerance for errors of rendering.
``frames`` has what became of the frames, and their bytes.
"""

import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from clients.latency.measure import (
    REFERENCE,
    Case,
    Measured,
    Target,
    compare,
)
from clients.latency.measure import measure as measure_case
from clients.service_process import ServiceProcess
from filter_service.keys import KeyRing
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of

MINUTES = 8
TRANSPORTS = ("tcp", "ipc", "shm", "curve")
PROFILE = {"kind": "prescription", "eye_side": "OS", "sphere_dpt": -2}
STATIC = {"pupil_range_mm": (4.0, 4.0), "focus_range_dpt": (0.0, 0.0)}
"""Of a stream whose pupil and focus stay: the eye it is compared with is exact for a
whole range, which would take minutes."""

KINDS = {
    # size of a view in px, views, rate in Hz, frames
    "mono": ((1280, 720), 1, 10.0, 60),
    "stereo": ((1832, 1920), 2, 3.0, 42),
}
QUICK = {"mono": ((320, 180), 1, 20.0, 10)}
N_EXCHANGES, PAUSE_S = 40, 0.03
"""Pause between exchanges, about that of a stream, during which processes sleep."""

ANSWER_WITH = """
import socket, sys
family, address, n_up, n_down = sys.argv[1:]
end = socket.socket(getattr(socket, family))
end.connect(("127.0.0.1", int(address)) if family == "AF_INET" else address)
room, answer = memoryview(bytearray(int(n_up))), bytes(int(n_down))
while True:
    count = 0
    while count < len(room):
        read = end.recv_into(room[count:])
        if not read:
            raise SystemExit
        count += read
    end.sendall(answer)
"""


def bare_socket_ms(transport: str, n_up: int, n_down: int) -> list[float]:
    """Return round trips of a request and a reply of so many bytes."""
    family = "AF_INET" if transport in ("tcp", "curve") else "AF_UNIX"
    times_ms, request, room = [], bytes(n_up), memoryview(bytearray(n_down))
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(getattr(socket, family)) as listener,
    ):
        is_tcp = family == "AF_INET"
        listener.bind(("127.0.0.1", 0) if is_tcp else f"{folder}/floor")
        listener.listen(1)
        listener.settimeout(10.0)
        name = listener.getsockname()
        where = [family, str(name[1] if is_tcp else name), str(n_up), str(n_down)]
        peer = subprocess.Popen([sys.executable, "-c", ANSWER_WITH, *where])
        try:
            with listener.accept()[0] as end:
                for _ in range(N_EXCHANGES):
                    start_s = time.perf_counter()
                    end.sendall(request)
                    count = 0
                    while count < n_down:
                        count += end.recv_into(room[count:])
                    times_ms.append(1e3 * (time.perf_counter() - start_s))
                    time.sleep(PAUSE_S)
        finally:
            peer.wait(10.0)
    return times_ms


def measured(transport: str, kind: str, cases: dict) -> tuple[Target, Measured]:
    """Start a service and measure one case."""
    size_px, n_views, rate_hz, n_frames = cases[kind]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        settings, key_file = {}, None
        if transport in ("ipc", "shm"):
            settings = {"bind": f"ipc://{folder}/service"}
        elif transport == "curve":
            key_file, keys = folder / "key.toml", KeyRing(folder / "keys")
            keys.add("benchmark", key_file)
            settings = {"keys_dir": str(keys.folder)}
        service = stack.enter_context(ServiceProcess(settings))
        target = Target(
            *(service.endpoint, key_file, 30.0, PROFILE, STATIC, n_frames),
            is_moving=False,
        )
        how = "shared-memory" if transport == "shm" else "tcp"
        return target, measure_case(target, Case(how, size_px, n_views, rate_hz))


def rows_of(transport: str, kind: str, found: Measured) -> tuple[list[Row], dict]:
    """Return a row for each stage, for the sums and the bare socket, and the counts."""
    run, settings = found.run, found.run.settings
    sent, received = run.n_bytes_per_frame
    stages = {name: run.stages_ms[name] for name in run.stage_names()}
    stages["bare_socket"] = bare_socket_ms(transport, sent, received)
    views = f"{settings.n_views} x " * (settings.n_views > 1)
    setting = (
        f"{views}{settings.width_px}x{settings.height_px}, {settings.rate_hz:g} Hz "
        f"for {settings.duration_s:g} s, {run.renderer}"
    )
    case = f"{transport}, {kind}"
    error_db = (found.error or {}).get("psnr_db", float("nan"))
    rows = [
        row_of(
            *("latency", name, case, setting, times_ms),
            *("psnr_db", error_db, REFERENCE),
            used_mb=run.memory_end_mb,
        )
        for name, times_ms in stages.items()
    ]
    return rows, {
        "case": case,
        "scheduled": settings.n_scheduled,
        "filtered": run.n_filtered,
        "dropped": dict(run.drops),
        "filtered_hz": round(run.n_filtered / run.duration_s, 3),
        "bytes_sent_per_frame": sent,
        "bytes_received_per_frame": received,
        "profile_change_ms": round(float(np.median(found.change_ms)), 1),
    }


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return the rows of all cases, and the counts of their frames."""
    cases = QUICK if run.is_quick else KINDS
    rows: list[Row] = []
    frames: list[dict] = []
    for kind in cases:
        found = []
        for transport in TRANSPORTS:
            target, one = measured(transport, kind, cases)
            found.append(one)
            print(f"latency: {transport}, {kind}", file=sys.stderr, flush=True)
        compare(target, found)  # after the streams: it takes all cores
        for transport, one in zip(TRANSPORTS, found, strict=True):
            of_case, counts = rows_of(transport, kind, one)
            rows += of_case
            frames.append(counts)
    return rows, {"frames": frames}
