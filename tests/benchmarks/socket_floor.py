"""Round trip of a frame's bytes over a bare socket: a lower bound for any protocol."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

N_EXCHANGES = 40
PAUSE_S = 0.03
"""Pause between exchanges, about that of a stream, during which processes sleep."""

ANSWER_WITH = """
import socket, sys
family, address, n_up, n_down = sys.argv[1:]
end = socket.socket(getattr(socket, family))
where = ("127.0.0.1", int(address)) if family == "AF_INET" else address
end.connect(where)
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


def socket_floor_ms(transport: str, n_up: int, n_down: int) -> float:
    """Return the median round trip of a request and a reply of given sizes.

    Parameters
    ----------
    transport : "tcp" or another
        "tcp"; any other value stands for a Unix socket.
    n_up, n_down : int
        Bytes sent to another process, and bytes returned.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(
            socket.AF_INET if transport == "tcp" else socket.AF_UNIX
        ) as listener,
    ):
        if transport == "tcp":
            listener.bind(("127.0.0.1", 0))
            where = ("AF_INET", str(listener.getsockname()[1]))
        else:
            path = str(Path(folder) / "floor")
            listener.bind(path)
            where = ("AF_UNIX", path)
        listener.listen(1)
        peer = subprocess.Popen(
            [sys.executable, "-c", ANSWER_WITH, *where, str(n_up), str(n_down)],
            env=os.environ,
        )
        try:
            with listener.accept()[0] as end:
                times_ms = _exchanges_ms(end, n_up, n_down)
        finally:
            peer.wait(10.0)
    return float(np.median(times_ms))


def _exchanges_ms(end: socket.socket, n_up: int, n_down: int) -> list[float]:
    question, room = bytes(n_up), memoryview(bytearray(n_down))
    times_ms = []
    for _ in range(N_EXCHANGES):
        start_s = time.perf_counter()
        end.sendall(question)
        count = 0
        while count < n_down:
            count += end.recv_into(room[count:])
        times_ms.append(1e3 * (time.perf_counter() - start_s))
        time.sleep(PAUSE_S)
    return times_ms
