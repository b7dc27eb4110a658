"""The service's ROUTER socket: parts in, parts out, and who is gone."""

from __future__ import annotations

import enum
import time
from collections.abc import Sequence
from pathlib import Path
from socket import AF_UNIX, SOCK_STREAM
from socket import socket as unix_socket
from typing import Any

import zmq

from filter_service.keys import KeyRing
from filter_service.service.gate import Gate

COPY_BELOW_BYTES = 65536  # pyzmq copies smaller parts in any case
# With fewer than about 64, libzmq drops replies of a ROUTER although one is in flight.
SEND_HIGH_WATER_MARK = 128
# Counts messages, so it is what bounds memory: with the default of 1000 an overload of
# 720p frames took 1.5 GB.  More wait in the kernel, and the client is held back.
RECEIVE_HIGH_WATER_MARK = 4
RETRY_S = 0.001
KEEPALIVE_IDLE_S = 20

Tracker = zmq.MessageTracker


def _check_path_is_free(bind: str) -> None:
    """Refuse an ``ipc://`` path that holds a file or a live endpoint.

    Binding removes whatever is at the path; only a dead socket may go that way.
    """
    if not bind.startswith("ipc://"):
        return
    path = Path(bind.removeprefix("ipc://"))
    if not path.exists():
        return
    if not path.is_socket():
        raise FileExistsError(f"{path} is there already and is no socket")
    with unix_socket(AF_UNIX, SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return
    raise FileExistsError(f"another service listens on {path}")


class Outcome(enum.Enum):
    """What became of a reply."""

    SENT = "sent"
    GONE = "gone"  # the client is not connected any more
    STALLED = "stalled"  # the client does not read


class Refused(Exception):
    """A message of somebody who is not allowed in any more; the identity is its."""

    def __init__(self, identity: bytes) -> None:
        super().__init__("the key is not allowed any more")
        self.identity = identity


class Mailbox:
    """A bound ROUTER socket that never blocks and never drops silently.

    Parameters
    ----------
    bind : str
        Endpoint; ``tcp://127.0.0.1:*`` takes a free port.
    max_part_bytes : int
        A client that sends a larger part is cut off.
    max_parts : int
        Of one message, after the identity; more are thrown away unread.
    keys : KeyRing, optional
        Only its clients are let in, and what travels is encrypted.
    """

    def __init__(
        self,
        bind: str,
        max_part_bytes: int,
        max_parts: int,
        *,
        keys: KeyRing | None = None,
    ) -> None:
        self._max_parts = max_parts
        self._context = zmq.Context()
        self._gate = None if keys is None else Gate(self._context, keys)
        self._socket = self._context.socket(zmq.ROUTER)
        socket = self._socket
        socket.linger = 0
        socket.router_mandatory = 1
        socket.sndhwm = SEND_HIGH_WATER_MARK
        socket.rcvhwm = RECEIVE_HIGH_WATER_MARK
        socket.maxmsgsize = max_part_bytes
        # No heartbeats of our own: libzmq aborts the process (stream_engine_base.cpp)
        # where one is due on a connection that has ended while more messages of it
        # wait than the mark above.  `Alive` finds out who is gone, and answers to the
        # clients' heartbeats are sent all the same.
        socket.heartbeat_ivl = 0
        socket.tcp_keepalive = 1
        socket.tcp_keepalive_idle = KEEPALIVE_IDLE_S
        if bind.startswith("tcp://["):
            socket.ipv6 = 1
        try:
            if self._gate is not None:
                self._gate.guard(socket)
            _check_path_is_free(bind)
            socket.bind(bind)
        except (zmq.ZMQError, OSError, ValueError) as error:
            self.close()
            raise OSError(f"cannot listen on {bind}: {error}") from None
        self.endpoint = socket.get_string(zmq.LAST_ENDPOINT)
        if self.endpoint.startswith("ipc://"):
            Path(self.endpoint.removeprefix("ipc://")).chmod(0o600)
        self._poller = zmq.Poller()
        self._poller.register(socket, zmq.POLLIN)
        if self._gate is not None:
            self._poller.register(self._gate.socket, zmq.POLLIN)
        self._watched: set[int] = set()

    def watch(self, readable: set[int], writable: set[int]) -> None:
        """Let `wait` also return when one of these can be read, or written."""
        for gone in self._watched - readable - writable:
            self._poller.unregister(gone)
        for descriptor in readable | writable:
            reads = zmq.POLLIN if descriptor in readable else 0
            writes = zmq.POLLOUT if descriptor in writable else 0
            self._poller.register(descriptor, reads | writes)
        self._watched = readable | writable

    def wait(self, timeout_s: float) -> None:
        """Return when there is something to read, or in time."""
        self._poller.poll(max(0, round(1000 * timeout_s)))
        if self._gate is not None:
            self._gate.answer()

    def receive(self) -> tuple[bytes, list[memoryview], int] | None:
        """Return (identity, parts, number left out) of one message, or None.

        Nothing is copied.  The whole message is taken off the socket whatever its
        number of parts: what is left of it would be read as the next one.

        Raises
        ------
        Refused
            The sender's key is not allowed any more.
        """
        try:
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        identity, left_out = frame.bytes, 0
        is_allowed = self._gate is None
        parts: list[memoryview] = []
        while frame.more:
            if len(parts) < self._max_parts:
                frame = self._socket.recv(copy=False)
                parts.append(frame.buffer)
                is_allowed = is_allowed or self._is_allowed(frame)
                continue
            left_out += self._skip()
            break
        if not is_allowed:
            raise Refused(identity)
        return identity, parts, left_out

    def _is_allowed(self, frame: zmq.Frame) -> bool:
        """Return whether the key that a part came with is still allowed."""
        return self._gate is not None and self._gate.lets_in(str(frame["User-Id"]))

    def _skip(self) -> int:
        """Throw away the rest of a message; return how many parts it had."""
        receive, count = self._socket.recv, 1  # there may be millions of them
        while receive(copy=False).more:
            count += 1
        return count

    def send(
        self, identity: bytes, parts: Sequence[Any]
    ) -> tuple[Outcome, zmq.MessageTracker | None]:
        """Send a message; large parts are not copied and must not change.

        Returns
        -------
        outcome : Outcome
        tracker : MessageTracker or None
            Of the last large part: done once libzmq has let go of it.
        """
        tracker = None
        try:
            self._send_identity(identity)
            for i, part in enumerate(parts):
                more = zmq.SNDMORE if i < len(parts) - 1 else 0
                large = memoryview(part).nbytes >= COPY_BELOW_BYTES
                sent = self._socket.send(
                    part, zmq.NOBLOCK | more, copy=not large, track=large
                )
                tracker = sent if large else tracker
        except zmq.Again:
            return Outcome.STALLED, None
        except zmq.ZMQError as error:
            if error.errno == zmq.EHOSTUNREACH:
                return Outcome.GONE, None
            raise
        return Outcome.SENT, tracker

    def _send_identity(self, identity: bytes) -> None:
        """Name the receiver; whether it can take a message is decided here."""
        flags = zmq.NOBLOCK | zmq.SNDMORE
        try:
            self._socket.send(identity, flags)
        except zmq.Again:
            # Room that a client has made is noticed about once per millisecond.
            time.sleep(RETRY_S)
            self._socket.send(identity, flags)

    def close(self, *, linger_ms: int = 0) -> None:
        """Close; what is not sent then is lost."""
        endpoint = getattr(self, "endpoint", "")
        self._socket.close(linger=linger_ms)
        if self._gate is not None:
            self._gate.close()
        self._context.term()
        if endpoint.startswith("ipc://"):
            Path(endpoint.removeprefix("ipc://")).unlink(missing_ok=True)
