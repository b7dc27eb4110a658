"""The socket of the helper, at which layers and commands connect."""

from __future__ import annotations

import json
import os
import socket
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clients.openxr_layer import wire
from estimator.bounded_files import loads_bounded

SOCKET_VARIABLE = "OCUFILTER_LAYER_SOCKET"
SOCKET_NAME = "ocufilter-layer.sock"
MAX_ANSWER_BYTES = 1 << 20


def socket_path() -> Path:
    """Return where the layer looks for its helper, as source/link.c does."""
    given = os.environ.get(SOCKET_VARIABLE)
    if given:
        return Path(given)
    folder = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.getuid()}"
    return Path(folder) / SOCKET_NAME


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
    data = struct.pack("<I", wire.CONTROL) + json.dumps(request).encode()
    if len(data) > wire.MAX_CONTROL_BYTES:
        raise ValueError(
            f"the profiles have {len(data)} bytes; allowed: {wire.MAX_CONTROL_BYTES}"
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
    _, user, _ = struct.unpack("3i", peer)
    return user in (0, os.getuid())
