"""A service under a hostile client: what it answers, and what others notice.

    python -m tests.benchmarks.bench_abuse [--quick] [--json]

A real service with a renderer double (5 ms a frame) and one well-behaved client, whose
rate is measured first alone, then beside each attack.  Attacks: mutated messages of all
kinds (bytes and fields changed, nested, cut, repeated; sent by DEALERs that read their
answers), garbage and half handshakes on raw sockets, idle connections, sizes of up to
2^62 bytes claimed, messages that never end.  Error: the client's rate over its rate
alone, answers that are none of the protocol's errors, and processes that were lost.
Writes results/abuse.json.
"""

import argparse
import json
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import Counter

import msgpack
import numpy as np
import zmq

from clients.filter_client import FilterClient, FilteredFrame, RgbdView
from clients.service_process import ServiceProcess
from filter_service.camera import tangents_from_fov
from filter_service.messages import (
    Frame,
    Hello,
    Ping,
    ProfileRequest,
    Share,
    Unshare,
    ViewHeader,
    ViewImages,
    decode_reply,
    encode,
)
from tests.benchmarks.harness import Row, publish

COMMAND = (sys.executable, "-m", "tests.end_to_end.double_service", "--filter-ms", "5")
SIZE_PX = (320, 180)
BATCH = 50
PACED_HZ = 2000
ATTACK_S = 6.0
CEILING_MB = 400
FAULT = "filter_error"


def view_of(size_px) -> RgbdView:
    """Return a picture of noise."""
    width, height = size_px
    color = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    depth_m = np.full((height, width), 2.0, np.float32)
    return RgbdView(color, depth_m, tangents_from_fov(60.0, width, height))


class Guest:
    """A client that streams in a thread and counts what comes back."""

    def __init__(self, endpoint: str) -> None:
        self.n_filtered = 0
        self.errors: Counter[str] = Counter()
        self._endpoint = endpoint
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
        with FilterClient(self._endpoint, timeout_s=20.0, max_in_flight=2) as client:
            client.set_profile({"kind": "double", "mark": 7}, views=[view])
            while not self._is_over.is_set():
                if client.n_unanswered < 2:
                    client.submit(view, pupil_diameter_mm=4.0, focus_dpt=0.0)
                for event in client.poll(0.05):
                    if isinstance(event, FilteredFrame):
                        self.n_filtered += 1
                        if event.color[0, 0, 0] != 7:
                            self.errors["wrong eye"] += 1
                    elif hasattr(event, "code"):
                        self.errors[event.code] += 1

    def rate_hz(self, duration_s: float) -> float:
        """Return the rate over some seconds."""
        before, start_s = self.n_filtered, time.monotonic()
        time.sleep(duration_s)
        return (self.n_filtered - before) / (time.monotonic() - start_s)


def examples() -> list[list[bytes]]:
    """Return one message of each kind, as parts."""
    view = view_of((8, 4))
    frame = Frame(
        3,
        (ViewHeader.describing(view),),
        4.0,
        0.5,
        images=(ViewImages(view.color, view.depth_m),),
    )
    messages = [
        Hello("abuse"),
        frame,
        ProfileRequest(5, {"kind": "double", "mark": 1}, views=(view.camera,)),
        ProfileRequest(6, {"kind": "preset", "name": "keratoconus"}),
        Ping(1.0),
        Share(4096),
        Unshare(1),
    ]
    return [[bytes(part) for part in encode(message)] for message in messages]


def strange_value(rng: random.Random, depth: int = 0):
    """Return something that a field does not expect."""
    if depth < 3 and rng.random() < 0.3:
        inner = [strange_value(rng, depth + 1) for _ in range(rng.randrange(4))]
        if rng.random() < 0.5:
            return inner
        return {str(k): value for k, value in enumerate(inner)}
    return rng.choice(
        [
            *(None, True, -1, 0, 2**31, 2**63, 2**64 - 1, -(2**63), 1e308, -0.0),
            *(float("nan"), float("inf"), "", "x" * 300, "\0", b"raw", "\u202e"),
            rng.randrange(-(2**40), 2**40),
            rng.uniform(-100, 100),
        ]
    )


def mutated(rng: random.Random, parts: list[bytes]) -> list[bytes]:
    """Return a message with something wrong, or maybe right by chance."""
    parts = list(parts)
    kind = rng.randrange(7)
    if kind == 0:  # a byte
        at = rng.randrange(len(parts))
        data = bytearray(parts[at] or b"\0")
        data[rng.randrange(len(data))] = rng.randrange(256)
        parts[at] = bytes(data)
    elif kind == 1:  # a field, maybe inside
        header = msgpack.unpackb(parts[0])
        target = header
        inner = [value for value in header.values() if isinstance(value, dict)]
        if inner and rng.random() < 0.5:
            target = rng.choice(inner)
        if target:
            target[rng.choice(sorted(target))] = strange_value(rng)
        parts[0] = msgpack.packb(header)
    elif kind == 2:  # a field too many or too few
        header = msgpack.unpackb(parts[0])
        header.pop(rng.choice(sorted(header)))
        header[rng.choice(["views", "slot", "memory", "zzz"])] = strange_value(rng)
        parts[0] = msgpack.packb(header)
    elif kind == 3:  # parts
        rng.choice([parts.pop, lambda: parts.append(b""), parts.reverse])()
    elif kind == 4:  # cut
        parts[0] = parts[0][: rng.randrange(len(parts[0]) + 1)]
    elif kind == 5:  # nested
        opening = rng.choice([b"\x91", b"\x81\xa1a", b"\xdc\xff\xff", b"\xdf"])
        parts[0] = opening * rng.randrange(1, 1200)
    else:
        parts = [rng.randbytes(rng.randrange(60)) for _ in range(rng.randrange(1, 12))]
    return parts


class Mutants:
    """Sends mutated messages and counts the answers by kind."""

    def __init__(self, endpoint: str, seed: int) -> None:
        self.answers: Counter[str] = Counter()
        self.n_sent = 0
        self._rng = random.Random(seed)
        self._examples = examples()
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.linger = 0
        self._socket.sndtimeo = 5000
        self._socket.connect(endpoint)

    def send(self, count: int) -> None:
        """Send so many; read what has come."""
        for _ in range(count):
            parts = mutated(self._rng, self._rng.choice(self._examples))
            self._socket.send_multipart(parts or [b""])
            self.n_sent += 1
            self._read()

    def _read(self) -> None:
        while self._socket.poll(0):
            reply = decode_reply(self._socket.recv_multipart())
            self.answers[getattr(reply, "code", reply.type_name)] += 1

    def close(self) -> None:
        """Read the last answers and close."""
        end_s = time.monotonic() + 2.0
        while time.monotonic() < end_s:
            self._socket.poll(50)
            self._read()
        self._socket.close(linger=0)
        self._context.term()


def raw(endpoint: str) -> socket.socket:
    """Return a plain connection."""
    host, port = endpoint.removeprefix("tcp://").split(":")
    return socket.create_connection((host, int(port)), 5.0)


GREETING = b"\xff" + b"\0" * 8 + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + b"\0" * 32
READY = b"\x05READY\x0bSocket-Type" + struct.pack(">I", 6) + b"DEALER"


def garbage(endpoint: str, rng: random.Random) -> None:
    """Random bytes, before and after the greeting."""
    with raw(endpoint) as connection:
        start = rng.choice([b"", GREETING[: rng.randrange(65)], GREETING])
        connection.sendall(start + rng.randbytes(rng.randrange(1, 400)))


def claim(endpoint: str, rng: random.Random) -> socket.socket:
    """A part that says it is very long, and never comes."""
    connection = raw(endpoint)
    connection.sendall(GREETING + b"\x04" + bytes([len(READY)]) + READY)
    size = rng.choice([2**62, 2**63 - 1, 2**40, 90_000_000])
    connection.sendall(b"\x03" + struct.pack(">Q", size) + b"x" * 10_000)
    return connection


def endless(endpoint: str, n_bytes: int) -> socket.socket:
    """A message of parts that never ends."""
    connection = raw(endpoint)
    connection.sendall(GREETING + b"\x04" + bytes([len(READY)]) + READY)
    part = b"\x03" + struct.pack(">Q", 10**6) + bytes(10**6)
    try:
        for _ in range(n_bytes // 10**6):
            connection.sendall(part)
    except OSError:
        pass
    return connection


def sockets_attack(endpoint: str, duration_s: float) -> int:
    """All of it at once, for a while; return the number of connections."""
    rng, count = random.Random(1), 0
    held: list[socket.socket] = []
    end_s = time.monotonic() + duration_s
    try:
        for _ in range(500):
            held.append(raw(endpoint))
            count += 1
        for _ in range(8):
            held.append(endless(endpoint, 45_000_000))
            count += 1
        while time.monotonic() < end_s:
            garbage(endpoint, rng)
            held.append(claim(endpoint, rng))
            count += 2
            time.sleep(0.002)
            if len(held) > 800:
                held.pop(300).close()
    finally:
        for connection in held:
            connection.close()
    return count


def _row(method, setting, n, times_s, memory_mb, name, error) -> Row:
    return Row(
        *("abuse", method, "double, 5 ms", setting, n),
        *(1e3 * times_s / max(n, 1), 1e3 * times_s / max(n, 1), memory_mb),
        *(name, float(error), "the client alone"),
    )


def mutant_rows(
    service: ServiceProcess,
    guest: Guest,
    alone_hz: float,
    n_messages: int,
    rate_hz: float,
) -> list[Row]:
    """Return rows of mutated messages at a rate, 0 for as fast as they go."""
    before_n, start_s = guest.n_filtered, time.monotonic()
    command = (sys.executable, "-m", "tests.benchmarks.bench_abuse", "--attack")
    attack = subprocess.Popen(
        [*command, service.endpoint, str(n_messages), str(rate_hz)],
        stdout=subprocess.PIPE,
        text=True,
    )
    peak_mb = 0.0
    while attack.poll() is None:
        peak_mb = max(peak_mb, service.memory_mb)
        time.sleep(0.2)
    took_s = time.monotonic() - start_s
    during_hz = (guest.n_filtered - before_n) / took_s
    answers = json.loads(attack.stdout.read())
    pace = f"{rate_hz:g} a second" if rate_hz else "as fast as can be"
    setting = f"{pace}, {sum(answers.values())} answers"
    return [
        _row("mutated messages", setting, n_messages, took_s, peak_mb, name, value)
        for name, value in (
            ("rate ratio", during_hz / alone_hz),
            ("unforeseen errors", answers.get(FAULT, 0)),
        )
    ]


def attack(endpoint: str, n_messages: int, rate_hz: float) -> None:
    """Send mutated messages from a process of its own; print the answers by kind."""
    mutants, start_s = Mutants(endpoint, int(rate_hz)), time.monotonic()
    while mutants.n_sent < n_messages:
        mutants.send(BATCH)
        if rate_hz:
            due_s = start_s + mutants.n_sent / rate_hz
            time.sleep(max(0.0, due_s - time.monotonic()))
    mutants.close()
    print(json.dumps(mutants.answers))


def measure(n_messages: int, attack_s: float) -> list[Row]:
    """Return the rows of all attacks."""
    rows = []
    settings = {"max_socket_mb": CEILING_MB, "max_sessions": 32}
    with ServiceProcess(settings, command=COMMAND) as service:
        before = service.pids()
        with Guest(service.endpoint) as guest:
            time.sleep(2.0)
            alone_hz = guest.rate_hz(attack_s)
            for rate_hz in (PACED_HZ, 0):
                rows += mutant_rows(service, guest, alone_hz, n_messages, rate_hz)
            counted: list[int] = []
            start_s = time.monotonic()
            attack = threading.Thread(
                target=lambda: counted.append(
                    sockets_attack(service.endpoint, attack_s + 3.0)
                )
            )
            attack.start()
            time.sleep(1.0)
            during_hz = guest.rate_hz(attack_s)
            peak_mb = service.memory_mb
            attack.join()
            took_s = time.monotonic() - start_s
            rows.append(
                _row(
                    *("raw sockets", f"{counted[0]} connections", counted[0]),
                    *(took_s, peak_mb, "rate ratio", during_hz / alone_hz),
                )
            )
            time.sleep(1.0)
            after_hz = guest.rate_hz(attack_s / 2)
            rows.append(
                _row(
                    *("afterwards", "the same client", 1, took_s, service.memory_mb),
                    *("rate ratio", after_hz / alone_hz),
                )
            )
        lost = sum(service.pids().get(name) != pid for name, pid in before.items())
        rows.append(
            _row(
                *("all of it", f"{alone_hz:.0f} Hz alone", 1, took_s),
                *(service.memory_mb, "processes lost", lost),
            )
        )
        wrong = sum(guest.errors.values())
        rows.append(
            _row(
                *("all of it", f"errors: {dict(guest.errors)}", 1, took_s),
                *(service.memory_mb, "errors of the client", wrong),
            )
        )
    return rows


def main() -> None:
    """Run, print, and write results/abuse.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="2,000 messages")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--attack", nargs=3, metavar=("ENDPOINT", "COUNT", "HZ"), help=argparse.SUPPRESS
    )
    options = parser.parse_args()
    if options.attack:
        endpoint, count, rate_hz = options.attack
        attack(endpoint, int(count), float(rate_hz))
        return
    n_messages, attack_s = (2_000, 2.0) if options.quick else (120_000, ATTACK_S)
    rows = measure(n_messages, attack_s)
    publish("abuse", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
