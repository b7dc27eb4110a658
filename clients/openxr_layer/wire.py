"""Messages between the OpenXR layer and its helper; see source/wire.h."""

from __future__ import annotations

import ctypes
import json
import math
import os
import socket
import struct
from collections.abc import Mapping
from ctypes import c_char, c_float, c_int64, c_uint32, c_uint64
from pathlib import Path
from typing import Any

from estimator.bounded_files import loads_bounded

MAGIC, VERSION = 0x4F435558, 2
HELLO, WELCOME, MEMORY, FRAME, RESULT = 1, 2, 3, 4, 5
CONTROL = 100
"""A request of `ocufilter layer set` or `status`: JSON after the kind."""

SRGB8, LINEAR8, LINEAR16F, LINEAR10 = 1, 2, 3, 4
HAS_HEAD, HAS_GAZE, IS_BLENDED, TOP_FIRST, IS_BGR = 1, 2, 4, 8, 16
IS_UNPREMULTIPLIED = 32
N_QUADS, MAX_QUAD_PIXELS = 4, 1 << 24

MAX_SIDE_PX = 16384
MAX_SHARED_BYTES = 1 << 30
MAX_CONTROL_BYTES = 100_000


class Hello(ctypes.Structure):
    """First message of the layer."""

    _fields_ = (
        *((name, c_uint32) for name in ("kind", "magic", "version", "process_id")),
        ("application", c_char * 128),
        ("engine", c_char * 128),
        ("graphics", c_char * 16),
    )


class Welcome(ctypes.Structure):
    """Answer of the helper."""

    _fields_ = tuple(
        (name, c_uint32)
        for name in (
            *("kind", "magic", "version", "wait_ms", "max_age_ms"),
            "leaves_quads",
        )
    )


class Memory(ctypes.Structure):
    """Shared memory, whose descriptor goes with the message."""

    _fields_ = (("kind", c_uint32), ("padding", c_uint32), ("size_bytes", c_uint64))


class Image(ctypes.Structure):
    """An image in the memory."""

    _fields_ = (("start", c_uint64), ("width_px", c_uint32), ("height_px", c_uint32))


class View(ctypes.Structure):
    """One eye's view."""

    _fields_ = (
        ("position_m", c_float * 3),
        ("orientation", c_float * 4),
        ("fov_rad", c_float * 4),
        *((name, c_float) for name in ("min_depth", "max_depth", "near_m", "far_m")),
        ("color", Image),
        ("depth", Image),
    )

    @property
    def pose(self) -> tuple[float, ...]:
        """Return position and orientation."""
        return (*self.position_m, *self.orientation)

    @property
    def tangents(self) -> tuple[float, float, float, float]:
        """Return the tangents of the angles to the edges: left, right, up, down."""
        left, right, up, down = map(math.tan, self.fov_rad)
        return left, right, up, down


class QuadLayer(ctypes.Structure):
    """A quad layer above the projection; of width 0 if there is none."""

    _fields_ = (
        ("position_m", c_float * 3),
        ("orientation", c_float * 4),
        ("size_m", c_float * 2),
        *((name, c_uint32) for name in ("color_format", "flags", "eyes")),
        ("color", Image),
    )

    @property
    def pose(self) -> tuple[float, ...]:
        """Return position and orientation."""
        return (*self.position_m, *self.orientation)


class Frame(ctypes.Structure):
    """A frame to filter, and what the layer did since the previous one."""

    _fields_ = (
        ("kind", c_uint32),
        ("flags", c_uint32),
        ("frame_id", c_uint64),
        ("display_time_ns", c_int64),
        ("color_format", c_uint32),
        ("head", c_float * 7),
        ("gaze", c_float * 4),
        ("gaze_time_ns", c_int64),
        ("views", View * 2),
        ("quads", QuadLayer * N_QUADS),
        *(
            (name, c_uint32)
            for name in (
                *("frames", "frames_filtered", "frames_fallback"),
                *("copy_us", "read_us", "upload_us", "other_us"),
            )
        ),
    )


class Result(ctypes.Structure):
    """Result of a frame, whose colors are now filtered."""

    _fields_ = (
        ("kind", c_uint32),
        ("is_filtered", c_uint32),
        ("frame_id", c_uint64),
    )


_KINDS: dict[int, type[ctypes.Structure]] = {HELLO: Hello, MEMORY: Memory, FRAME: Frame}


def kind_of(data: bytes) -> int:
    """Return the kind of a message; 0 without one."""
    return int.from_bytes(data[:4], "little") if len(data) >= 4 else 0


def parsed(data: bytes) -> Hello | Memory | Frame:
    """Return a message of the layer.

    Raises
    ------
    ValueError
        If its kind is unknown or its size is wrong.
    """
    structure = _KINDS.get(kind_of(data))
    if structure is None or len(data) != ctypes.sizeof(structure):
        raise ValueError(f"an unknown message of {len(data)} bytes")
    return structure.from_buffer_copy(data)  # type: ignore[return-value]


# Socket of the helper

SOCKET_VARIABLE = "OCUFILTER_LAYER_SOCKET"
SOCKET_NAME = "ocufilter-layer.sock"
MAX_ANSWER_BYTES = 1 << 20


def socket_path() -> Path:
    """Return where the layer looks for its helper, as source/link.c does."""
    folder = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}"
    return Path(os.environ.get(SOCKET_VARIABLE) or Path(folder) / SOCKET_NAME)


def ask(
    path: Path, request: Mapping[str, Any], timeout_s: float = 10.0
) -> dict[str, Any]:
    """Send a request to a running helper; return its answer.

    Raises
    ------
    OSError
        If no helper of this user listens there, or it does not answer.
    ValueError
        If it refuses the request.
    """
    data = struct.pack("<I", CONTROL) + json.dumps(request).encode()
    if len(data) > MAX_CONTROL_BYTES:
        raise ValueError(
            f"the profiles have {len(data)} bytes; allowed: {MAX_CONTROL_BYTES}"
        )
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(timeout_s)
        connection.connect(str(path))
        if not is_trusted(connection):
            raise PermissionError(f"another user's process listens at {path}")
        connection.send(data)
        received = connection.recv(MAX_ANSWER_BYTES)
    if not received:
        raise ConnectionResetError(f"the helper at {path} closed the connection")
    answer: dict[str, Any] = loads_bounded(received, max_bytes=MAX_ANSWER_BYTES)
    if "error" in answer:
        raise ValueError(answer["error"])
    return answer


def listening(path: Path) -> socket.socket:
    """Return a socket that listens; replace one that a helper left behind."""
    found = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
    try:
        if path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
                try:
                    probe.connect(str(path))
                except ConnectionRefusedError:
                    path.unlink()
                else:
                    raise OSError(f"another helper listens at {path}")
        found.bind(str(path))
        path.chmod(0o600)
        found.listen()
    except BaseException:
        found.close()
        raise
    return found


def is_trusted(connection: socket.socket) -> bool:
    """Whether the peer is a process of this user, or of root."""
    size = struct.calcsize("3i")
    peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size)
    return struct.unpack("3i", peer)[1] in (0, os.getuid())
