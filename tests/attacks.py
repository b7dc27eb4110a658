"""Hostile clients of the filter service: ``python -m`` this NAME ENDPOINT SECONDS.

Each runs in a process of its own for a while and prints what it counted as JSON.  The
endpoints are services of this machine that a benchmark or a test has started.
"""

import json
import random
import resource
import socket
import struct
import sys
import time
from collections import Counter
from contextlib import suppress
from functools import partial

import zmq

from filter_service.messages import (
    Frame,
    Hello,
    Ping,
    ProfileRequest,
    Share,
    ViewHeader,
    ViewImages,
    decode_reply,
    encode,
)
from tests.mutated_messages import examples, mutated, view_of

N_BARE = 1500
N_PARTS = 6_000_000
PROFILE_BYTES = 1_000_000
PINGS_HZ = 20_000
FIRST_ID = 0x6B8B4567
"""Where libzmq's ids began in every process without a seed of its own."""


def as_address(endpoint: str) -> tuple[str, int]:
    """Return host and port."""
    host, port = endpoint.removeprefix("tcp://").split(":")
    return host, int(port)


def raise_limit() -> None:
    """Let this process open as many files as it may."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def dealer(endpoint: str, *, identity: bytes = b"", **options):
    """Return a context and a DEALER that is connected."""
    context = zmq.Context()
    client = context.socket(zmq.DEALER)
    client.linger = 0
    client.sndtimeo = 200
    for name, value in options.items():
        setattr(client, name, value)
    if identity:
        client.setsockopt(zmq.IDENTITY, identity)
    client.connect(endpoint)
    return context, client


def small_frame(frame_id: int, size_px=(320, 180)) -> Frame:
    """Return a frame of noise."""
    view = view_of(size_px)
    header, images = ViewHeader.describing(view), ViewImages(view.color, view.depth_m)
    return Frame(frame_id, (header,), 4.0, 0.0, images=(images,))


def bare(endpoint: str, duration_s: float) -> dict:
    """1,500 connections that say nothing; those that are closed are opened again."""
    return _hold(endpoint, duration_s, b"")


def one_byte(endpoint: str, duration_s: float) -> dict:
    """The same with one byte each."""
    return _hold(endpoint, duration_s, b"\xff")


def _hold(endpoint: str, duration_s: float, opening: bytes) -> dict:
    raise_limit()
    address, held, counts = as_address(endpoint), [], Counter()
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        if len(held) < N_BARE:
            connection = socket.socket()
            connection.settimeout(0.5)
            try:
                connection.connect(address)
                connection.sendall(opening)
                connection.setblocking(False)
                held.append(connection)
                counts["opened"] += 1
            except OSError:
                connection.close()
                counts["refused"] += 1
            continue
        counts["held"] = 1
        alive = []
        for connection in held:
            try:
                closed = not connection.recv(4096)
            except BlockingIOError:
                closed = False
            except OSError:
                closed = True
            if closed:
                connection.close()
                counts["closed"] += 1
            else:
                alive.append(connection)
        held = alive
        time.sleep(0.05)
    return counts


GREETING = b"\xff" + b"\0" * 8 + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + b"\0" * 32
READY = b"\x05READY\x0bSocket-Type" + struct.pack(">I", 6) + b"DEALER"


def spoken_to(endpoint: str) -> socket.socket:
    """Return a connection after the handshake of ZMTP 3.0, as a DEALER."""
    connection = socket.create_connection(as_address(endpoint), 5.0)
    connection.sendall(GREETING + b"\x04" + bytes([len(READY)]) + READY)
    received = b""
    while b"ROUTER" not in received:  # what comes before the answer ends the connection
        data = connection.recv(4096)
        if not data:
            raise ConnectionError("closed during the handshake")
        received += data
    return connection


def half_greeted(endpoint: str, duration_s: float) -> dict:
    """Connections that begin the handshake and never end it, 400 at a time."""
    raise_limit()
    address, held, counts = as_address(endpoint), [], Counter()
    end_s = time.monotonic() + duration_s
    rng = random.Random(1)
    while time.monotonic() < end_s:
        connection = socket.socket()
        connection.settimeout(0.5)
        try:
            connection.connect(address)
            connection.sendall(GREETING[: rng.randrange(65)])
            held.append(connection)
            counts["opened"] += 1
        except OSError:
            connection.close()
            counts["refused"] += 1
        if len(held) > 400:
            held.pop(rng.randrange(len(held))).close()
        time.sleep(0.001)
    return counts


def silent_dealers(endpoint: str, duration_s: float) -> dict:
    """Finished handshakes that say nothing, 600 of them in one context."""
    raise_limit()
    context = zmq.Context()
    context.max_sockets = 2000
    sockets = []
    for _ in range(600):
        client = context.socket(zmq.DEALER)
        client.linger = 0
        client.connect(endpoint)
        sockets.append(client)
    time.sleep(duration_s)
    for client in sockets:
        client.close(linger=0)
    context.term()
    return {"opened": len(sockets)}


def chosen_ids(endpoint: str, duration_s: float) -> dict:
    """DEALERs that take the routing ids that libzmq would hand out next."""
    counts, start, n = Counter(), FIRST_ID, 0
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        pairs = []
        for first in (FIRST_ID, 0xE43C9869):
            for k in range(20):
                identity = b"\0" + struct.pack(">I", (first + n + k) % 2**32)
                pairs.append(dealer(endpoint, identity=identity))
        n += 7
        for _ in range(5):  # libzmq gives these ids of its own
            context, client = dealer(endpoint)
            client.send_multipart(encode(Hello("id")))
            if client.poll(500):
                reply = decode_reply(client.recv_multipart())
                counts[getattr(reply, "code", reply.type_name)] += 1
            else:
                counts["silent"] += 1
            pairs.append((context, client))
        for context, client in pairs:
            client.close(linger=0)
            context.term()
        counts["tried"] += len(pairs)
    counts.pop("start", start)
    return counts


def bad_profile(kind: int) -> list[bytes]:
    """Return a profile of a megabyte that is none."""
    header = encode(ProfileRequest(5, {"kind": "preset", "name": "x"}))[0]
    count = PROFILE_BYTES // (3 if kind == 0 else 2) - 40
    item = b"[]," if kind == 0 else b"1,"
    body = b'{"kind":"preset","name":[' + item * count + item[:-1] + b"]}"
    return [bytes(header), body]


def profiles(endpoint: str, duration_s: float, rate_hz: float = 20.0) -> dict:
    """Profiles of a megabyte, faster than once a second."""
    context, client = dealer(endpoint)
    client.send_multipart(encode(Hello("profiles")))
    counts, end_s, n = Counter(), time.monotonic() + duration_s, 0
    while time.monotonic() < end_s:
        try:
            client.send_multipart(bad_profile(n % 2))
            n += 1
        except zmq.Again:
            counts["held back"] += 1
        _read(client, counts)
        time.sleep(1 / rate_hz)
    counts["sent"] = n
    client.close(linger=0)
    context.term()
    return counts


def valid_profiles(endpoint: str, duration_s: float) -> dict:
    """Profiles that are right, 150 a second for each of three eyes."""
    context, client = dealer(endpoint)
    client.send_multipart(encode(Hello("profiles")))
    camera = small_frame(1).views[0].camera
    counts, end_s, n = Counter(), time.monotonic() + duration_s, 0
    while time.monotonic() < end_s:
        body = {"kind": "double", "mark": n % 250}
        for eye in ("both", "left", "right"):
            request = ProfileRequest(n, body, views=(camera,), eye=eye)
            with suppress(zmq.Again):
                client.send_multipart(encode(request))
            n += 1
        _read(client, counts)
        time.sleep(1 / 150)
    counts["sent"] = n
    client.close(linger=0)
    context.term()
    return counts


def _zernike_set() -> dict:
    terms = [(n, m) for n in range(2, 7) for m in range(-n, n + 1, 2)]
    measured = {"pupil_diameter_mm": 4.0, "wavelength_nm": 550.0}
    return {
        "kind": "zernike_set",
        "measurements": [
            {
                **measured,
                "h_deg": k % 10 * 4.0,
                "v_deg": k // 10 * 4.0,
                "zernike_um": {f"{n},{m}": 0.01 / (1 + n + k) for n, m in terms},
            }
            for k in range(100)
        ],
    }


def _surfaces() -> dict:
    """Return the eye that takes longest to check: 20 surfaces in 8 states."""

    def surfaces(state: int) -> list[dict]:
        return [
            {
                "radius_mm": [8.0 + 0.01 * i, 8.1 + 0.01 * i],
                "z_mm": 0.35 * i,
                "medium_after": ("cornea", "aqueous", "lens")[i % 3],
                "decentration_mm": [0.01 * state, 0.0],
                "tilt_deg": [0.1, 0.0],
                "offset_mm": [0.0] * 6 + [1e-6 * (1 + state)] * 22,
                "offset_radius_mm": 4.0,
                "form": {"kind": "even_asphere", "coefficients": [0.0, 1e-9]},
            }
            for i in range(20)
        ]

    return {
        "kind": "surfaces",
        "stop_z_mm": 3.3,
        "retina": {"radius_mm": -12, "z_mm": 24.2},
        "surfaces": surfaces(0),
        "states": [
            {"accommodation_dpt": float(k), "surfaces": surfaces(k)}
            for k in range(1, 9)
        ],
    }


FLOODS = {
    "preset": {"kind": "preset", "name": "keratoconus"},
    "prescription": {"kind": "prescription", "sphere_dpt": -3, "age_years": 30},
    "zernike_set": _zernike_set(),
    "surfaces": _surfaces(),
    "published": {"kind": "published", "name": "arizona"},
    "pseudophakic": {
        "kind": "pseudophakic",
        "axial_length_mm": 23.6,
        "keratometry_dpt": [42.5, 43.75],
        "keratometry_axis_deg": 175,
        "acd_mm": 3.1,
        "lens_thickness_mm": 4.6,
        "implant": {"power_dpt": 21},
    },
    "text": {"kind": "preset", "name": "myopia", "pad": ["x" * 4000] * 230},
    "items": {"kind": "preset", "name": "myopia", "pad": [0.5] * 16_000},
}
"""Profiles of a flood: valid ones, and two to the size limits that are refused late."""

FLOOD_HZ = 60.0


def flood(endpoint: str, duration_s: float, kind: str) -> dict:
    """Profiles of one kind, 60 a second on each of three eyes."""
    context, client = dealer(endpoint)
    client.send_multipart(encode(Hello("flood")))
    camera = small_frame(1).views[0].camera
    body = json.dumps(FLOODS[kind]).encode()
    print("begun", flush=True)
    counts, start_s, n = Counter(), time.monotonic(), 0
    while (passed_s := time.monotonic() - start_s) < duration_s:
        while n < 3 * FLOOD_HZ * passed_s:
            eye = ("both", "left", "right")[n % 3]
            header = encode(ProfileRequest(n, views=(camera,), eye=eye))[0]
            with suppress(zmq.Again):
                client.send_multipart([header, body], zmq.NOBLOCK)
            n += 1
        _read(client, counts)
        time.sleep(0.002)
    counts["sent"] = n
    client.close(linger=0)
    context.term()
    return counts


def stream(endpoint: str, duration_s: float) -> dict:
    """A second session that streams frames, two in flight: no attack, but what any
    flood is compared with."""
    counts = Counter()
    context, client = dealer(endpoint, sndtimeo=10_000)
    frame = small_frame(1)
    request = ProfileRequest(1, FLOODS["prescription"], views=(frame.views[0].camera,))
    for message in (Hello("stream"), request):
        client.send_multipart(encode(message))
    while not counts["ready"] and client.poll(20_000):
        _read(client, counts)
    parts = [bytes(part) for part in encode(frame)]
    print("begun", flush=True)
    n_sent, end_s = 0, time.monotonic() + duration_s
    while time.monotonic() < end_s:
        n_answered = sum(counts[k] for k in ("result", "dropped"))
        if n_sent < 2 + n_answered:
            client.send_multipart(parts)
            n_sent += 1
        elif client.poll(10):
            _read(client, counts)
    client.close(linger=0)
    context.term()
    return counts


def _read(client, counts: Counter) -> None:
    while client.poll(0):
        reply = decode_reply(client.recv_multipart())
        counts[getattr(reply, "code", reply.type_name)] += 1


def pings(endpoint: str, duration_s: float) -> dict:
    """20,000 pings a second."""
    context, client = dealer(endpoint, sndhwm=0, rcvhwm=0)
    parts, counts = [bytes(p) for p in encode(Ping(1.0))], Counter()
    start_s = time.monotonic()
    while (passed_s := time.monotonic() - start_s) < duration_s:
        while counts["sent"] < passed_s * PINGS_HZ:
            try:
                client.send_multipart(parts, zmq.NOBLOCK)
                counts["sent"] += 1
            except zmq.Again:
                break
        _read(client, counts)
        time.sleep(0.001)
    client.close(linger=0)
    context.term()
    return counts


def unread(endpoint: str, duration_s: float) -> dict:
    """Frames as fast as they go, of a client that reads nothing after `ready`."""
    counts, end_s = Counter(), time.monotonic() + duration_s
    while time.monotonic() < end_s:
        context, client = dealer(endpoint, rcvhwm=1)
        frame = small_frame(1)
        camera = frame.views[0].camera
        client.send_multipart(encode(Hello("unread")))
        body = {"kind": "double", "mark": 9}
        client.send_multipart(encode(ProfileRequest(1, body, views=(camera,))))
        client.poll(500)
        parts = [bytes(part) for part in encode(frame)]
        stop_s = min(end_s, time.monotonic() + 3.0)
        while time.monotonic() < stop_s:
            try:
                client.send_multipart(parts, zmq.NOBLOCK)
                counts["sent"] += 1
            except zmq.Again:
                time.sleep(0.001)
        client.close(linger=0)
        context.term()
        counts["connections"] += 1
    return counts


def _send_parts(endpoint: str, duration_s: float, opening: bytes) -> dict:
    counts, end_s = Counter(), time.monotonic() + duration_s
    data = b"\x01\x01x" * (N_PARTS - 1) + b"\0\x01x"
    while time.monotonic() < end_s:
        try:
            with spoken_to(endpoint) as connection:
                connection.settimeout(2.0)
                connection.sendall(opening + data)
                counts["messages"] += 1
                time.sleep(0.3)
        except OSError:
            counts["cut off"] += 1
    return counts


def parts(endpoint: str, duration_s: float) -> dict:
    """Messages of six million one-byte parts."""
    return _send_parts(endpoint, duration_s, b"")


def parts_in_session(endpoint: str, duration_s: float) -> dict:
    """The same of clients that said hello."""
    (hello,) = encode(Hello("parts"))
    opening = b"\0" + bytes([len(hello)]) + bytes(hello)
    return _send_parts(endpoint, duration_s, opening)


def hoard(endpoint: str, duration_s: float) -> dict:
    """Sessions that ask for all the shared memory there is."""
    counts, end_s = Counter(), time.monotonic() + duration_s
    context, client = dealer(endpoint, rcvtimeo=1000)
    client.send_multipart(encode(Hello("hoard")))
    while time.monotonic() < end_s:
        for size_mb in (400, 125, 60, 10, 1):
            client.send_multipart(encode(Share(size_mb * 10**6)))
            try:
                reply = decode_reply(client.recv_multipart())
            except zmq.Again:
                counts["silent"] += 1
                continue
            if getattr(reply, "slot", None) is not None:
                counts["mb"] += size_mb
            else:
                counts["refused"] += 1
        time.sleep(0.2)
    client.close(linger=0)
    context.term()
    return counts


def garbage(endpoint: str, rng: random.Random) -> None:
    """Random bytes, before and after the greeting."""
    with socket.create_connection(as_address(endpoint), 5.0) as connection:
        start = rng.choice([b"", GREETING[: rng.randrange(65)], GREETING])
        connection.sendall(start + rng.randbytes(rng.randrange(1, 400)))


def claim(endpoint: str, rng: random.Random) -> socket.socket:
    """A part that says it is very long, and never comes."""
    connection = spoken_to(endpoint)
    size = rng.choice([2**62, 2**63 - 1, 2**40, 90_000_000])
    connection.sendall(b"\x03" + struct.pack(">Q", size) + b"x" * 10_000)
    return connection


def endless(endpoint: str, n_bytes: int) -> socket.socket:
    """A message of parts that never ends."""
    connection = spoken_to(endpoint)
    part = b"\x03" + struct.pack(">Q", 10**6) + bytes(10**6)
    try:
        for _ in range(n_bytes // 10**6):
            connection.sendall(part)
    except OSError:
        pass
    return connection


def raw_sockets(endpoint: str, duration_s: float) -> dict:
    """Garbage, idle connections, claims of 2^62 bytes, messages without an end."""
    raise_limit()
    rng, counts = random.Random(1), Counter()
    held: list[socket.socket] = []
    end_s = time.monotonic() + duration_s
    for _ in range(500):
        held.append(socket.create_connection(as_address(endpoint), 5.0))
    for _ in range(8):
        with suppress(OSError):
            held.append(endless(endpoint, 45_000_000))
    while time.monotonic() < end_s:
        with suppress(OSError):
            garbage(endpoint, rng)
            held.append(claim(endpoint, rng))
            counts["connections"] += 2
        time.sleep(0.002)
        if len(held) > 800:
            held.pop(300).close()
    for connection in held:
        connection.close()
    return counts


def mutated_messages(endpoint: str, duration_s: float) -> dict:
    """Messages with something wrong, as fast as they go; the answers by kind."""
    rng, kinds, counts = random.Random(1), examples(), Counter()
    context, client = dealer(endpoint)
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        with suppress(zmq.Again):
            client.send_multipart(mutated(rng, rng.choice(kinds)) or [b""])
            counts["sent"] += 1
        _read(client, counts)
    client.close(linger=0)
    context.term()
    return counts


ATTACKS = {
    function.__name__: function
    for function in (
        *(bare, one_byte, half_greeted, silent_dealers, chosen_ids),
        *(profiles, valid_profiles, pings, unread, parts, parts_in_session, hoard),
        *(raw_sockets, mutated_messages, stream),
    )
} | {f"flood_{kind}": partial(flood, kind=kind) for kind in FLOODS}


def main() -> None:
    """Run one attack; print what it counted."""
    name, endpoint, duration_s = sys.argv[1:]
    print(json.dumps(ATTACKS[name](endpoint, float(duration_s))))


if __name__ == "__main__":
    main()
