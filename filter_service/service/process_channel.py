"""Messages, with file descriptors, between two processes of the service.

Sending never blocks: bytes that the socket does not accept stay in a queue.
Messages are pickled, which is safe because both processes belong to the service.
"""

from __future__ import annotations

import array
import ctypes
import os
import pickle
import select
import signal
import socket
import struct
import sys
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

from filter_service.log_lines import configure_logging
from filter_service.service.config import ServiceConfig


class WorkerMemory(NamedTuple):
    """Memory of a render worker, 10^6 bytes.

    Attributes
    ----------
    resident_mb : float
        Resident memory of the process.
    stores_mb, tables_mb : float
        Kernels of all PSFs at all resolutions, and the tables and nodes of them.
    buffers_mb : float
        Buffers that frames reuse.
    """

    resident_mb: float = 0.0
    stores_mb: float = 0.0
    tables_mb: float = 0.0
    buffers_mb: float = 0.0


HEAD = struct.Struct("<QB")  # length of the message, number of descriptors
MAX_DESCRIPTORS = 8
CONTROL_BYTES = socket.CMSG_LEN(MAX_DESCRIPTORS * array.array("i").itemsize)
READ_BYTES = 1 << 16


class LinkClosed(Exception):
    """The other process has closed its end, usually because it exited."""


class Link:
    """One end of a link between two processes.

    Parameters
    ----------
    end : socket
        One end of a `socket.socketpair`; the link owns it.
    """

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self._unsent: deque[tuple[memoryview, list[int]]] = deque()
        self._buffer = memoryview(bytearray(READ_BYTES))
        self._received = bytearray()
        self._descriptors: deque[int] = deque()

    @classmethod
    def pair(cls) -> tuple[Self, socket.socket]:
        """Return one end as a link, and the other as a socket for a new process."""
        ours, theirs = socket.socketpair()
        return cls(ours), theirs

    @classmethod
    def from_descriptor(cls, descriptor: int) -> Self:
        """Return a link that takes ownership of a descriptor."""
        return cls(socket.socket(fileno=descriptor))

    def wait(self) -> list[tuple[Any, list[int]]]:
        """Block until messages arrive and return them."""
        while not (messages := self.receive()):
            select.select([self._socket], [], [])
        return messages

    def fileno(self) -> int:
        """Return the descriptor to poll."""
        return self._socket.fileno()

    @property
    def has_unsent(self) -> bool:
        """Return whether messages are waiting for `flush`."""
        return bool(self._unsent)

    def send(self, message: object, descriptors: Sequence[int] = ()) -> None:
        """Send a message; the caller keeps its descriptors.

        Raises
        ------
        LinkClosed
            If the other end is closed.
        """
        body = pickle.dumps(message, protocol=5)
        data = memoryview(HEAD.pack(len(body), len(descriptors)) + body)
        if not self._unsent:
            # Most messages are sent at once, and duplicating a descriptor may fail.
            count = self._send_some(data, descriptors)
            if count == len(data):
                return
            data, descriptors = data[count:], () if count else descriptors
        self._unsent.append((data, [os.dup(number) for number in descriptors]))

    def flush(self) -> None:
        """Send as much as the socket accepts now.

        Raises
        ------
        LinkClosed
            If the other end is closed.
        """
        while self._unsent:
            data, descriptors = self._unsent[0]
            count = self._send_some(data, descriptors)
            if count == 0:
                return
            for descriptor in descriptors:
                os.close(descriptor)
            if count < len(data):
                self._unsent[0] = (data[count:], [])
            else:
                self._unsent.popleft()

    def _send_some(self, data: memoryview, descriptors: Sequence[int]) -> int:
        """Send the bytes of a message that the socket accepts; return their number."""
        try:
            if descriptors:
                return socket.send_fds(self._socket, [data], descriptors)
            return self._socket.send(data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LinkClosed(str(error)) from None

    def receive(self) -> list[tuple[Any, list[int]]]:
        """Return received messages with their descriptors, which the caller then owns.

        Raises
        ------
        LinkClosed
            If the other end closed the connection and all its messages were returned.
        """
        is_closed = self._read()
        messages = self._pop_messages()
        if is_closed and not messages:
            raise LinkClosed("the other end closed the connection")
        return messages

    def _read(self) -> bool:
        """Read available data; return whether the other end closed the connection."""
        while True:
            try:
                count, control, _, _ = self._socket.recvmsg_into(
                    [self._buffer], CONTROL_BYTES
                )
            except BlockingIOError:
                return False
            except OSError:
                return True
            for *_, data in control:
                self._descriptors.extend(array.array("i", data))
            if not count:
                return True
            self._received += self._buffer[:count]
            # A read also ends after descriptors; otherwise there was no more data.
            if count < READ_BYTES and not control:
                return False

    def _pop_messages(self) -> list[tuple[Any, list[int]]]:
        messages = []
        start, view = 0, memoryview(self._received)
        while len(view) - start >= HEAD.size:
            length, count = HEAD.unpack_from(view, start)
            end = start + HEAD.size + length
            if len(view) < end:
                break
            if len(self._descriptors) < count:  # this process had none free
                raise LinkClosed("descriptors of a message were lost")
            message = pickle.loads(view[start + HEAD.size : end])
            descriptors = [self._descriptors.popleft() for _ in range(count)]
            messages.append((message, descriptors))
            start = end
        view.release()
        del self._received[:start]
        return messages

    def close(self) -> None:
        """Close the link; unsent messages are lost."""
        for _, descriptors in self._unsent:
            for descriptor in descriptors:
                os.close(descriptor)
        for descriptor in self._descriptors:
            os.close(descriptor)
        self._unsent.clear()
        self._descriptors.clear()
        self._socket.close()


PR_SET_PDEATHSIG = 1


def start_process(name: str) -> tuple[Link, ServiceConfig, list[tuple[Any, list[int]]]]:
    """Set up signals and the log, and wait for the settings.

    The first argument of the program is the descriptor of the link to the supervisor.

    Parameters
    ----------
    name : str
        Name of the process in the log.

    Returns
    -------
    supervisor : Link
    config : ServiceConfig
    others : list of (message, descriptors)
        Messages that arrived after the settings.
    """
    _end_with_parent()
    # Ctrl-C signals the whole process group; the supervisor stops its processes itself.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    configure_logging(name)
    supervisor = Link.from_descriptor(int(sys.argv[1]))
    (first, _), *others = supervisor.wait()
    kind, config = first
    assert kind == "config"
    return supervisor, config, others


def _end_with_parent() -> None:
    """Make the kernel kill this process when its parent dies (Linux)."""
    parent = os.getppid()
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    except (OSError, AttributeError):
        return  # then the closed link ends this process
    if os.getppid() != parent:
        sys.exit(1)
