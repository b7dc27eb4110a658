"""Service under hostile clients: throughput, latency and memory of the other clients.

    python -m tests.benchmarks.bench_abuse [--quick] [--json]

A real service with a renderer double (5 ms a frame) and a well-behaved client that
streams.  Each attack of `attacks.py` runs twice for some seconds: against a second
service beside the first, which is the baseline (it burns the same two cores), and
against the first; connections that say nothing also under limits of open files, with
keys and without.  Errors: the client's rate over its baseline, its longest wait for a
picture, the time until a newcomer is welcomed, processor time afterwards, lost
processes.  Then the assertion of libzmq that a guessed routing id sets off, files that
are no keys, and heavy clients beside light ones on the native engine.  On that engine,
too, floods of profiles: a client's rate beside each over its rate beside a second
session that streams frames.  Writes results/abuse.json.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.service_process import ServiceProcess
from filter_service.camera import tangents_from_fov
from filter_service.errors import FilterError
from filter_service.keys import KeyRing
from filter_service.service.router import SEED_VARIABLE
from tests.benchmarks.attacks import ATTACKS, FLOODS
from tests.benchmarks.harness import Row, publish
from tests.benchmarks.mutated_messages import view_of

COMMAND = (sys.executable, "-m", "tests.end_to_end.double_service", "--filter-ms", "5")
ATTACK = (sys.executable, "-m", "tests.benchmarks.attacks")
OTHER_ATTACKS = [
    name
    for name in ATTACKS
    if name not in ("bare", "one_byte", "stream") and not name.startswith("flood_")
]
LIMITS = ((256, False), (256, True), (1024, False), (1024, True))
SIZE_PX = (320, 180)
ATTACK_S, QUICK_S = 6.0, 2.0
N_WINDOWS = 3


class Guest:
    """A client that streams in a thread and counts what comes back."""

    def __init__(
        self, endpoint: str, key_file: Path | None = None, body: dict | None = None
    ) -> None:
        self._body = body or {"kind": "double", "mark": 7}
        self.n_filtered = 0
        self.errors: Counter[str] = Counter()
        self._arrived_s: list[float] = []
        self._endpoint, self._key_file = endpoint, key_file
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._stream)

    def __enter__(self):
        """Begin to stream."""
        self._thread.start()
        return self

    def __exit__(self, *exc_info):
        """End."""
        self._is_over.set()
        self._thread.join()

    def _stream(self) -> None:
        view = view_of(SIZE_PX)
        with FilterClient(
            self._endpoint, key_file=self._key_file, timeout_s=20.0, max_in_flight=2
        ) as client:
            client.set_profile(self._body, views=[view])
            mark = self._body.get("mark")
            while not self._is_over.is_set():
                if client.n_unanswered < 2:
                    client.submit(view, pupil_diameter_mm=4.0, focus_dpt=0.0)
                for event in client.poll(0.05):
                    if isinstance(event, FilteredFrame):
                        self.n_filtered += 1
                        self._arrived_s.append(time.monotonic())
                        if mark is not None and event.color[0, 0, 0] != mark:
                            self.errors["wrong eye"] += 1
                    elif hasattr(event, "code"):
                        self.errors[event.code] += 1

    def rate_hz(self, duration_s: float) -> float:
        """Return the rate over some seconds."""
        return self.watch(duration_s)[0]

    def watch(self, duration_s: float) -> tuple[float, float]:
        """Return the rate, and the longest time between two pictures, s."""
        start_s = time.monotonic()
        time.sleep(duration_s)
        end_s = time.monotonic()
        times_s = [t for t in list(self._arrived_s) if start_s <= t <= end_s]
        gaps_s = np.diff([start_s, *times_s, end_s])
        return len(times_s) / (end_s - start_s), float(gaps_s.max())


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

    def processor_s() -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    begin_s = processor_s()
    time.sleep(2.0)
    return (processor_s() - begin_s) / 2.0


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
        guest = closing.enter_context(Guest(service.endpoint, key_file))
        time.sleep(2.0)
        before = service.pids()
        load_before = front_end_load(before["front-end"])
        words = [f"{n_files} files"] * bool(n_files) + ["keys"] * has_keys
        for name in names:
            measured = []
            for endpoint in (other.endpoint, service.endpoint):
                attack = subprocess.Popen(
                    [*ATTACK, name, endpoint, str(duration_s + 2.0)],
                    stdout=subprocess.PIPE,
                    text=True,
                )
                time.sleep(1.5)
                measured.append(guest.watch(duration_s))
                newcomer_s = welcome_s(service.endpoint, key_file)
                counts = json.loads(attack.communicate()[0])
            time.sleep(1.0)
            load_after = front_end_load(before["front-end"])
            (base_hz, _), (hz, silence_s) = measured
            case = ", ".join([*words, f"{base_hz:.0f}/s"])
            setting = ", ".join(f"{value} {key}" for key, value in counts.items())
            lost = sum(service.pids().get(k) != pid for k, pid in before.items())
            rows += [
                Row(
                    *("abuse", name, case, setting[:60], 1),
                    *(1e3 / base_hz, 1e3 / max(hz, 1e-3), service.memory_mb),
                    *(what, float(value), "the same against another service"),
                )
                for what, value in (
                    ("rate ratio", hz / base_hz),
                    ("longest silence, s", silence_s),
                    ("welcome, s", newcomer_s),
                    ("front end's load, more than before", load_after - load_before),
                    ("processes lost", lost),
                    ("errors of the client", sum(guest.errors.values())),
                )
            ]
    return rows


def assertion_rows() -> list[Row]:
    """Return what a forced assertion of libzmq costs a stream."""
    os.environ[SEED_VARIABLE] = "1"
    try:
        with (
            ServiceProcess({"max_sessions": 32}, command=COMMAND) as service,
            Guest(service.endpoint) as guest,
        ):
            time.sleep(2.0)
            before = service.pids()["front-end"]
            attack = subprocess.Popen(
                [*ATTACK, "chosen_ids", service.endpoint, "4"],
                stdout=subprocess.DEVNULL,
            )
            end_s = time.monotonic() + 5.0
            gaps_s = []
            while (
                service.pids().get("front-end") == before and time.monotonic() < end_s
            ):
                gaps_s.append(guest.watch(0.2)[1])
            attack.kill()
            attack.wait()
            gap_s = max([*gaps_s, guest.watch(3.0)[1]])
            rate_hz = guest.rate_hz(1.0)
            is_ended = service.pids().get("front-end") != before
            n_begun = service.log.count("started ('filter_client')")
    finally:
        del os.environ[SEED_VARIABLE]
    return [
        Row(
            *("abuse", "forced assertion", f"{rate_hz:.0f}/s after", "", 1),
            *(1e3 * gap_s, 1e3 * gap_s, 0.0, what, float(value), "a known seed"),
        )
        for what, value in (
            ("longest silence, s", gap_s),
            ("front ends ended", is_ended),
            ("sessions begun anew", n_begun - 1),
        )
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
            Guest(service.endpoint, folder / "client.toml") as guest,
        ):
            time.sleep(2.0)
            before, base_hz = service.pids(), guest.rate_hz(3.0)
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
                target=lambda: watched.append(guest.watch(duration_s))
            )
            watch.start()
            n_changes = 0
            while watch.is_alive():
                ring.add("brief", folder / "brief.toml")
                ring.remove("brief")
                (folder / "brief.toml").unlink()
                n_changes += 1
            watch.join()
            named = service.log.count(".toml")
            lost = sum(service.pids().get(k) != pid for k, pid in before.items())
            memory_mb = service.memory_mb
    ((hz, silence_s),) = watched
    return [
        Row(
            *("abuse", "bad key files", f"{base_hz:.0f}/s", f"{n_changes} changes", 10),
            *(1e3 / base_hz, 1e3 / hz, memory_mb, what, float(value), "before them"),
        )
        for what, value in (
            ("rate ratio", hz / base_hz),
            ("longest silence, s", silence_s),
            ("times that one of 10 is named", named / 10),
            ("processes lost", lost),
            ("errors of the client", sum(guest.errors.values())),
        )
    ]


def blocks_of(side_px: int) -> RgbdView:
    """Return squares of 16 px at two distances: noise would be merged nowhere."""
    small = view_of((side_px // 16, side_px // 16)).color
    color = np.repeat(np.repeat(small, 16, axis=0), 16, axis=1)
    depth_m = np.full((side_px, side_px), 2.0, np.float32)
    depth_m[:, : side_px // 2] = 0.8
    return RgbdView(color, depth_m, tangents_from_fov(60.0, side_px, side_px))


def fairness_rows(n_heavy_frames: int, heavy_px: int) -> list[Row]:
    """Return how two heavy clients and twenty light ones share the native engine."""
    heavy, light = blocks_of(heavy_px), view_of((160, 90))
    settings = {"max_sessions": 32, "engine": "native", "max_image_mb": 4000}
    with ExitStack() as closing:
        service = closing.enter_context(ServiceProcess(settings, start_timeout_s=120.0))
        views = [heavy, heavy, *[light] * 20]
        clients = []
        for view in views:
            # One frame in flight each: a second one is replaced by the next, again and
            # again, and copying those takes processor time from the service.
            client = FilterClient(service.endpoint, timeout_s=120.0, max_in_flight=1)
            clients.append(closing.enter_context(client))
            client.set_profile({"kind": "prescription", "sphere_dpt": -2}, views=[view])
        used_s, waits_s = np.zeros(22), [[] for _ in clients]
        costs_s: list[list[float]] = [[] for _ in clients]
        seen_s = [time.monotonic()] * len(clients)
        while sum(map(len, costs_s[:2])) < n_heavy_frames:
            for i, (client, view) in enumerate(zip(clients, views, strict=True)):
                if client.n_unanswered < 1:
                    client.submit(view, pupil_diameter_mm=4.0, focus_dpt=0.0)
                for event in client.poll(0.0):
                    if isinstance(event, FilteredFrame):
                        stages = event.stage_times_ms
                        outside = ("decode_ms", "queue_ms", "other_ms", "rests_ms")
                        cost_s = 1e-3 * sum(
                            ms for name, ms in stages.items() if name not in outside
                        )
                        used_s[i] += cost_s
                        costs_s[i].append(cost_s)
                        now_s = time.monotonic()
                        rest_s = 1e-3 * stages.get("rests_ms", 0.0)
                        waits_s[i].append(now_s - seen_s[i] - cost_s - rest_s)
                        seen_s[i] = now_s
            time.sleep(0.001)
    own_s = float(np.median(costs_s[0] + costs_s[1]))
    light_waits_s = np.concatenate(waits_s[2:])
    light_own_s = float(np.median(np.concatenate(costs_s[2:])))
    # A frame waits for what its session has used, which is the one before.
    waits = [
        wait_s / (len(views) * max(own[k], own[k + 1]))
        for own, waited_s in zip(costs_s[:2], waits_s[:2], strict=True)
        for k, wait_s in enumerate(waited_s[1:])
    ]
    return [
        Row(
            *("abuse", "2 heavy, 20 light", f"{heavy_px} px", f"{own_s:.2f} s a frame"),
            *(n_heavy_frames, 1e3 * own_s, 1e3 * light_own_s, 0.0),
            *(what, float(value), "equal shares"),
        )
        for what, value in (
            ("heavy shares apart, own frames", np.ptp(used_s[:2]) / own_s),
            ("light shares apart, of mean", np.ptp(used_s[2:]) / used_s[2:].mean()),
            ("heavy wait, of 22 own frames, longest", max(waits)),
            ("heavy wait, of 22 own frames, median", float(np.median(waits))),
            ("light wait, p95, s", float(np.percentile(light_waits_s, 95))),
            ("light wait, longest, s", float(light_waits_s.max())),
        )
    ]


def flood_rows(kinds: Sequence[str], duration_s: float) -> list[Row]:
    """Return a client's rate beside floods of profiles and beside another stream.

    Windows alternate, because the rest of the machine is not idle.
    """
    rows: list[Row] = []
    settings = {"max_sessions": 8, "engine": "native"}
    body = {"kind": "prescription", "sphere_dpt": -2}
    with (
        ServiceProcess(settings, start_timeout_s=120.0) as service,
        Guest(service.endpoint, body=body) as guest,
    ):
        while not guest.n_filtered:
            time.sleep(0.1)
        before = service.pids()
        for kind in kinds:
            rates_hz: dict[str, list[float]] = {"stream": [], f"flood_{kind}": []}
            silences_s, counts = [], {}
            for name in [*rates_hz] * N_WINDOWS:
                attack = subprocess.Popen(
                    [*ATTACK, name, service.endpoint, str(duration_s + 1.0)],
                    stdout=subprocess.PIPE,
                    text=True,
                )
                assert attack.stdout.readline() == "begun\n"
                time.sleep(0.5)
                hz, silence_s = guest.watch(duration_s)
                rates_hz[name].append(hz)
                printed = json.loads(attack.communicate()[0])
                if name != "stream":
                    silences_s.append(silence_s)
                    counts = printed
            base_hz, hz = (float(np.median(found)) for found in rates_hz.values())
            setting = ", ".join(f"{value} {key}" for key, value in counts.items())
            lost = sum(service.pids().get(k) != pid for k, pid in before.items())
            rows += [
                Row(
                    *("abuse", f"flood of {kind}", f"{base_hz:.0f}/s", setting[:60]),
                    *(N_WINDOWS, 1e3 / base_hz, 1e3 / max(hz, 1e-3)),
                    *(service.memory_mb, what, float(value), "beside a stream"),
                )
                for what, value in (
                    ("rate ratio", hz / base_hz),
                    ("longest silence, s", max(silences_s)),
                    ("processes lost", lost),
                    ("errors of the client", sum(guest.errors.values())),
                )
            ]
    return rows


def measure(duration_s: float) -> list[Row]:
    """Return the rows of all attacks."""
    is_quick = duration_s < ATTACK_S
    rows = attack_rows(OTHER_ATTACKS, duration_s)
    for n_files, has_keys in LIMITS[-1:] if is_quick else LIMITS:
        names = ("bare", "one_byte")
        rows += attack_rows(names, duration_s, n_files=n_files, has_keys=has_keys)
    rows += assertion_rows()
    rows += key_file_rows(duration_s if is_quick else 30.0)
    rows += flood_rows(list(FLOODS)[-1:] if is_quick else list(FLOODS), duration_s)
    return rows + fairness_rows(*((4, 1024) if is_quick else (20, 4096)))


def main() -> None:
    """Run, print, and write results/abuse.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="2 s an attack")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    duration_s = QUICK_S if options.quick else ATTACK_S
    publish(
        "abuse", measure(duration_s), as_json=options.json, is_whole=not options.quick
    )


if __name__ == "__main__":
    main()
