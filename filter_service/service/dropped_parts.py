"""Removal of the surplus parts of a message that has too many.

A message of six million one-byte parts fits into 18 MB.  Reading them from the socket
one by one takes 5.9 s in Python, during which no other message is received, and 0.3 s
in the compiled loop (`drop_parts.c`).
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import zmq

FILE = "_drop_parts.so"
CALLS = ("init", "recv", "more", "close")


class _ZmqCalls(ctypes.Structure):
    """Addresses of the libzmq functions that `drop_parts.c` calls."""

    _fields_ = tuple((name, ctypes.c_void_p) for name in CALLS)


def drop_parts(socket: zmq.Socket[Any], max_count: int) -> tuple[int, bool]:
    """Drop the next parts of the message that is being received.

    Parameters
    ----------
    socket : zmq.Socket
        Socket of which a message was read in part: its last part had `more` set.
    max_count : int
        Maximum number of parts to drop.

    Returns
    -------
    count : int
        Number of dropped parts.
    has_more : bool
        Whether the message has further parts.
    """
    loop = _compiled()
    if loop is None:
        return drop_parts_in_python(socket, max_count)
    library, calls = loop
    has_more = ctypes.c_int32(1)
    count = library.ocu_drop_parts(
        *(ctypes.c_void_p(socket.underlying), ctypes.byref(calls)),
        *(ctypes.c_int64(max_count), ctypes.byref(has_more)),
    )
    return int(count), bool(has_more.value)


def drop_parts_in_python(socket: zmq.Socket[Any], max_count: int) -> tuple[int, bool]:
    """Implement `drop_parts` without the compiled loop."""
    receive = socket.recv
    for count in range(1, max_count + 1):
        if not receive(copy=False).more:
            return count, False
    return max_count, True


@cache
def _compiled() -> tuple[ctypes.CDLL, _ZmqCalls] | None:
    """Return the compiled loop and libzmq's functions; None if either is missing."""
    path = Path(__file__).with_name(FILE)
    try:
        from zmq.backend.cython import _zmq

        # The libzmq that pyzmq's extension is linked with.
        libzmq = ctypes.CDLL(_zmq.__file__)
        calls = _ZmqCalls(
            *(
                ctypes.cast(getattr(libzmq, f"zmq_msg_{name}"), ctypes.c_void_p)
                for name in CALLS
            )
        )
        library = ctypes.CDLL(str(path)) if path.is_file() else None
    except (ImportError, OSError, AttributeError):
        return None
    if library is None:
        return None
    library.ocu_drop_parts.restype = ctypes.c_int64
    return library, calls
