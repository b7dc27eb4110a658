"""Messages of all kinds with something wrong, or right by chance."""

import random

import msgpack
import numpy as np

from clients.filter_client import RgbdView
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
    encode,
)


def view_of(size_px) -> RgbdView:
    """Return a picture of noise."""
    width, height = size_px
    color = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    depth_m = np.full((height, width), 2.0, np.float32)
    return RgbdView(color, depth_m, tangents_from_fov(60.0, width, height))


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
