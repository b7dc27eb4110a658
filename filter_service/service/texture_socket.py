"""Datagram socket on which clients of this machine and user send descriptors.

Its name is in Linux's abstract namespace, so no file is left behind by a killed
process.  The kernel reports the user of every sender.
"""

from __future__ import annotations

import array
import os
import secrets
import socket
import struct
from collections.abc import Callable
from contextlib import AbstractContextManager

from filter_service.messages import MAX_HEADER_BYTES

NAME_BYTES = 16
MAX_DESCRIPTORS = 1
"""Further descriptors of a datagram are closed by the kernel."""

MAX_DATAGRAMS = 16
"""Datagrams per turn of the event loop: a flooding client must not delay the others."""

_CREDENTIALS = struct.Struct("3i")  # process, user, group
_ANCILLARY_BYTES = socket.CMSG_SPACE(_CREDENTIALS.size) + socket.CMSG_SPACE(
    MAX_DESCRIPTORS * array.array("i").itemsize
)


class TextureSocket:
    """Bound socket that receives descriptors.

    Parameters
    ----------
    reserve : callable
        Returns a context in which this process may open descriptors.

    Attributes
    ----------
    name : str
        Name of the socket, without the null byte that starts an abstract address.
    """

    def __init__(self, reserve: Callable[[], AbstractContextManager[None]]) -> None:
        self._reserve = reserve
        self.name = f"ocufilter-{secrets.token_hex(NAME_BYTES)}"
        self._socket = socket.socket(
            socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK
        )
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind(f"\0{self.name}")

    def fileno(self) -> int:
        """Return the descriptor to poll."""
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, list[int]]]:
        """Return datagrams of this user, with descriptors that the caller then owns."""
        found: list[tuple[bytes, list[int]]] = []
        with self._reserve():
            for _ in range(MAX_DATAGRAMS):
                try:
                    data, ancillary, flags, _ = self._socket.recvmsg(
                        MAX_HEADER_BYTES + 1, _ANCILLARY_BYTES, socket.MSG_CMSG_CLOEXEC
                    )
                except BlockingIOError:
                    break
                user, descriptors = None, array.array("i")
                for level, kind, content in ancillary:
                    if level != socket.SOL_SOCKET:
                        continue
                    if kind == socket.SCM_CREDENTIALS:
                        user = _CREDENTIALS.unpack(content)[1]
                    elif kind == socket.SCM_RIGHTS:
                        descriptors.frombytes(content)
                is_whole = not flags & (socket.MSG_CTRUNC | socket.MSG_TRUNC)
                if user == os.geteuid() and is_whole:
                    found.append((data, descriptors.tolist()))
                else:
                    close_all(descriptors.tolist())
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def close_all(descriptors: list[int]) -> None:
    """Close descriptors."""
    for descriptor in descriptors:
        os.close(descriptor)
