"""Service under hostile clients: throughput, latency and memory of the other clients.

A real service with a renderer double (5 ms a frame) and a well-behaved client that
streams.  Each attack of `tests/attacks.py` runs twice for some seconds: against a
second service beside the first, which is the baseline (it burns the same two cores),
and against the first; connections that say nothing also under limits of open files,
with keys and without.  Errors: the client's rate over its baseline, its longest wait
for a picture, the time until a newcomer is welcomed, processor time afterwards, lost
processes.  Then the assertion of libzmq that a guessed routing id sets off, and files
that are no keys.  On the native engine, floods of profiles: a client's rate beside each
over its rate beside a second session that streams frames.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

from clients.filter_client import FilterClient
from clients.service_process import ServiceProcess
from filter_service.errors import FilterError
from filter_service.keys import KeyRing
from filter_service.service.router import SEED_VARIABLE
from tests.attacks import ATTACKS
from tests.benchmarks.harness import ROOT, Row, Run
from tests.benchmarks.rows import row_of
from tests.benchmarks.service_stream import PROFILE, Stream, processor_s
from tests.mutated_messages import view_of

MINUTES = 5
COMMAND = (sys.executable, "-m", "tests.end_to_end.double_service", "--filter-ms", "5")
ATTACK = (sys.executable, "-m", "tests.attacks")
OTHER_ATTACKS = [
    name
    for name in ATTACKS
    if name not in ("bare", "one_byte", "stream") and not name.startswith("flood_")
]
LIMITS = ((256, True), (1024, False))
SIZE_PX = (320, 180)
ATTACK_S, QUICK_S, BAD_KEYS_S = 2.5, 2.0, 10.0
N_WINDOWS = 3
FLOODED = ("surfaces", "items")
"""The valid profile that takes longest to check, and one that is refused late."""

QUICK = ("pings", "mutated_messages")


DOUBLE = {"kind": "double", "mark": 7}
row = partial(row_of, "abuse")


def guest(endpoint: str, key_file: Path | None = None, body: dict = DOUBLE) -> Stream:
    """Return a well-behaved client."""
    return Stream(
        endpoint, view_of(SIZE_PX), profile=body, in_flight=2, key_file=key_file
    )


def started(name: str, endpoint: str, duration_s: float) -> subprocess.Popen:
    """Start an attack in a process of its own."""
    command = [*ATTACK, name, endpoint, str(duration_s)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def rows_of(
    method: str,
    case: str,
    counts: Mapping[str, int],
    rates_hz: tuple[float, float],
    errors: Mapping[str, float],
    reference: str,
    used_mb: float,
) -> list[Row]:
    """Return a row for each error; times are a frame's without and with the attack."""
    setting = ", ".join(f"{value} {key}" for key, value in counts.items())
    base_hz, hz = rates_hz
    times_ms = [1e3 / max(base_hz, 1e-3), 1e3 / max(hz, 1e-3)]
    return [
        row(
            method,
            case,
            setting[:60],
            times_ms,
            what,
            error,
            reference,
            n=1,
            used_mb=used_mb,
        )
        for what, error in errors.items()
    ]


def limited(n_files: int) -> tuple[str, ...]:
    """Return the command of the service with so many open files, soft and hard."""
    if not n_files:
        return COMMAND
    script = f'ulimit -Sn {n_files}; ulimit -Hn {n_files}; exec "$@"'
    return ("sh", "-c", script, "sh", *COMMAND)


def welcome_s(endpoint: str, key_file: Path | None) -> float:
    """Return how long a newcomer waits for its welcome; infinity beyond 20 s."""
    start_s = time.monotonic()
    try:
        with FilterClient(endpoint, key_file=key_file) as client:
            client.hello(timeout_s=20.0)
    except FilterError:
        return math.inf
    return time.monotonic() - start_s


def front_end_load(pid: int) -> float:
    """Return the share of a core that a process takes while the client streams."""

    begin_s = processor_s([pid])
    time.sleep(2.0)
    return (processor_s([pid]) - begin_s) / 2.0


def n_lost(service: ServiceProcess, before: Mapping[str, int]) -> int:
    """Return how many processes of a service are others than before."""
    now = service.pids()
    return sum(now.get(name) != pid for name, pid in before.items())


def attack_rows(
    names: Sequence[str], duration_s: float, *, n_files: int = 0, has_keys: bool = False
) -> list[Row]:
    """Return the rows of attacks on one service, each beside the same on another."""
    rows: list[Row] = []
    with ExitStack() as closing:
        settings: dict[str, object] = {"max_sessions": 32}
        key_file = None
        if has_keys:
            folder = Path(closing.enter_context(tempfile.TemporaryDirectory()))
            ring = KeyRing(folder / "keys")
            ring.create()
            key_file = folder / "client.toml"
            ring.add("client", key_file)
            settings["keys_dir"] = str(ring.folder)
        command = limited(n_files)
        service, other = (
            closing.enter_context(ServiceProcess(settings, command=command))
            for _ in range(2)
        )
        stream = closing.enter_context(guest(service.endpoint, key_file))
        time.sleep(2.0)
        before = service.pids()
        load_before = front_end_load(before["front-end"])
        words = [f"{n_files} files"] * bool(n_files) + ["keys"] * has_keys
        for name in names:
            watched = []
            for endpoint in (other.endpoint, service.endpoint):
                attack = started(name, endpoint, duration_s + 2.0)
                time.sleep(1.5)
                watched.append(stream.watch(duration_s))
                newcomer_s = welcome_s(service.endpoint, key_file)
                counts = json.loads(attack.communicate()[0])
            time.sleep(1.0)
            load = front_end_load(before["front-end"]) - load_before
            (base_hz, _), (hz, silence_s) = watched
            errors = {
                "rate ratio": hz / base_hz,
                "longest silence, s": silence_s,
                "welcome, s": newcomer_s,
                "front end's load, more than before": load,
                "processes lost": n_lost(service, before),
                "errors of the client": stream.errors.total(),
            }
            rows += rows_of(
                *(name, ", ".join([*words, f"{base_hz:.0f}/s"]), counts, (base_hz, hz)),
                *(errors, "the same against another service", service.memory_mb),
            )
            print(f"abuse: {name}", file=sys.stderr, flush=True)
    return rows


def assertion_rows() -> list[Row]:
    """Return what a forced assertion of libzmq costs a stream."""
    os.environ[SEED_VARIABLE] = "1"
    try:
        with (
            ServiceProcess({"max_sessions": 32}, command=COMMAND) as service,
            guest(service.endpoint) as stream,
        ):
            time.sleep(2.0)
            before = service.pids()["front-end"]
            attack = started("chosen_ids", service.endpoint, 4.0)
            end_s = time.monotonic() + 5.0
            gaps_s = []
            while (
                service.pids().get("front-end") == before and time.monotonic() < end_s
            ):
                gaps_s.append(stream.watch(0.2)[1])
            attack.kill()
            attack.communicate()
            gap_s = max([*gaps_s, stream.watch(3.0)[1]])
            rate_hz, _ = stream.watch(1.0)
            is_ended = service.pids().get("front-end") != before
            n_begun = service.log.count("started ('filter_client')")
    finally:
        del os.environ[SEED_VARIABLE]
    errors = {
        "longest silence, s": gap_s,
        "front ends ended": is_ended,
        "sessions begun anew": n_begun - 1,
    }
    return [
        row(
            *("forced assertion", f"{rate_hz:.0f}/s after", "", [1e3 * gap_s]),
            *(what, error, "a known seed"),
            used_mb=0.0,
        )
        for what, error in errors.items()
    ]


def key_file_rows(duration_s: float) -> list[Row]:
    """Return what bad key files, and a folder that keeps changing, cost a stream."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ring = KeyRing(folder / "keys")
        ring.create()
        ring.add("client", folder / "client.toml")
        clients = ring.folder / "clients"
        with (
            ServiceProcess({"keys_dir": str(ring.folder)}, command=COMMAND) as service,
            guest(service.endpoint, folder / "client.toml") as stream,
        ):
            time.sleep(2.0)
            before, (base_hz, _) = service.pids(), stream.watch(3.0)
            for number, content in enumerate(
                (b"", b"\xff\xfe", b"public = 'x'", b"public = 7", b"[" * 3000)
            ):
                (clients / f"bad{number}.toml").write_bytes(content)
            (clients / "huge.toml").write_bytes(bytes(10**7))
            (clients / "dangling.toml").symlink_to("nowhere")
            (clients / "loop.toml").symlink_to("loop.toml")
            (clients / "folder.toml").mkdir()
            os.mkfifo(clients / "pipe.toml")
            watched: list[tuple[float, float]] = []
            watch = threading.Thread(
                target=lambda: watched.append(stream.watch(duration_s))
            )
            watch.start()
            n_changes = 0
            while watch.is_alive():
                ring.add("brief", folder / "brief.toml")
                ring.remove("brief")
                (folder / "brief.toml").unlink()
                n_changes += 1
            watch.join()
            ((hz, silence_s),) = watched
            errors = {
                "rate ratio": hz / base_hz,
                "longest silence, s": silence_s,
                "times that one of 10 is named": service.log.count(".toml") / 10,
                "processes lost": n_lost(service, before),
                "errors of the client": stream.errors.total(),
            }
            return rows_of(
                *("bad key files", f"{base_hz:.0f}/s", {"changes": n_changes}),
                *((base_hz, hz), errors, "before them", service.memory_mb),
            )


def flood_rows(kinds: Sequence[str], duration_s: float) -> list[Row]:
    """Return a client's rate beside floods of profiles and beside another stream.

    Windows alternate, because the rest of the machine is not idle.
    """
    rows: list[Row] = []
    settings = {"max_sessions": 8, "engine": "native"}
    with (
        ServiceProcess(settings, start_timeout_s=120.0) as service,
        guest(service.endpoint, body=PROFILE) as stream,
    ):
        before = service.pids()
        for kind in kinds:
            rates_hz: dict[str, list[float]] = {"stream": [], f"flood_{kind}": []}
            silences_s, counts = [], {}
            for name in [*rates_hz] * N_WINDOWS:
                attack = started(name, service.endpoint, duration_s + 1.0)
                assert attack.stdout.readline() == "begun\n"
                time.sleep(0.5)
                hz, silence_s = stream.watch(duration_s)
                rates_hz[name].append(hz)
                printed = json.loads(attack.communicate()[0])
                if name != "stream":
                    silences_s.append(silence_s)
                    counts = printed
            base_hz, hz = (float(np.median(found)) for found in rates_hz.values())
            errors = {
                "rate ratio": hz / base_hz,
                "longest silence, s": max(silences_s),
                "processes lost": n_lost(service, before),
                "errors of the client": stream.errors.total(),
            }
            rows += rows_of(
                *(f"flood of {kind}", f"{base_hz:.0f}/s", counts, (base_hz, hz)),
                *(errors, "beside a stream", service.memory_mb),
            )
    return rows


def measure(run: Run) -> list[Row]:
    """Return the rows of all attacks, or of a few kinds."""
    duration_s = QUICK_S if run.is_quick else ATTACK_S
    names = [n for n in OTHER_ATTACKS if n in QUICK or not run.is_quick]
    rows = attack_rows(names, duration_s)
    for n_files, has_keys in LIMITS[-1:] if run.is_quick else LIMITS:
        held = ("bare", "one_byte")[: 1 if run.is_quick else None]
        rows += attack_rows(held, duration_s, n_files=n_files, has_keys=has_keys)
    rows += assertion_rows()
    rows += key_file_rows(duration_s if run.is_quick else BAD_KEYS_S)
    return rows + flood_rows(FLOODED[-1:] if run.is_quick else FLOODED, duration_s)
