"""The connections of the ROUTER socket, as its monitor and its messages show them.

libzmq neither limits connections nor says which routing id is behind which of them.
Here each has a number that no other ever has: the authenticator hands it out, and
libzmq attaches it to every message (`User-Id`).  Sessions belong to that number, not to
a routing id, which a client chooses itself.
"""

from __future__ import annotations

import logging
import os
import socket
import struct
import sys
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain

from filter_service.log_lines import ONCE_A_SECOND
from filter_service.service.rate_limit import RateLimit

MAX_UNREAD_BYTES = 262_144
"""What a connection without a session may send without a whole message: it has nothing
large to say.  libzmq keeps what is incomplete, and shows it to nobody."""

CHECK_INTERVAL_S = 0.01
MAX_CHECKED = 64
"""Connections looked at in one interval, 0.006 ms each."""

GREETING_BYTES = 64
"""Of ZMTP: what a client of ZeroMQ sends before anything else."""

TCP_INFO_BYTES = 136
BYTES_RECEIVED = struct.Struct("=Q")
BYTES_RECEIVED_AT = 128
"""Place of `tcpi_bytes_received` in Linux's ``struct tcp_info``."""

log = logging.getLogger("ocufilter")


@dataclass(frozen=True)
class Peer:
    """Where a message came from, and where its answer goes.

    Attributes
    ----------
    routing_id : bytes
        The address of answers.  Two connections may have the same one in turn.
    connection : int
        Number of the connection, unique while the process lives.
    key : str
        The client's public CURVE key; empty where the service has no keys.
    """

    routing_id: bytes
    connection: int
    key: str = ""


@dataclass(eq=False)
class Connection:
    """A TCP or Unix connection that libzmq has accepted.

    Attributes
    ----------
    descriptor, inode : int
        The inode tells whether the descriptor is still this connection's.
    address : str
        Of the other side; clients of a Unix socket are told apart by process.
    first_number : int
        The connection's number is this one or a later one.
    number : int, optional
        Known from its first message on.
    """

    descriptor: int
    inode: int
    address: str
    first_number: int
    number: int | None = None
    is_ended: bool = False
    has_had_session: bool = False
    counted_bytes: int | None = None  # received, when its last message was complete
    rates: RateLimit = field(default_factory=RateLimit)


class Connections:
    """All connections, with a limit to their number.

    Where too many are open, the oldest ones without a session are closed, those first
    that have not sent a greeting, and of the address that has most of them.  A client
    says hello within milliseconds of connecting, so others keep it out seldom.

    Parameters
    ----------
    max_count : int
    with_session : collection of int
        Numbers of the connections that have a session now.
    family : socket.AddressFamily
        Of all of them.  To ask the system each time took a third of the whole cost of a
        connection.

    Attributes
    ----------
    n_evicted : int
    """

    def __init__(
        self,
        max_count: int,
        with_session: Collection[int],
        family: socket.AddressFamily = socket.AF_INET,
    ) -> None:
        self._family = family
        self.max_count = max_count
        self.n_evicted = 0
        self._with_session = with_session
        self._open: dict[int, Connection] = {}  # by descriptor, oldest first
        self._numbered: dict[int, Connection] = {}
        # By address and descriptor, oldest first: those that have not been seen to have
        # sent a greeting, and the others.
        self._silent: dict[str, dict[int, Connection]] = {}
        self._greeted: dict[str, dict[int, Connection]] = {}
        self._next_check_s = 0.0
        self._to_check: list[Connection] = []
        self._n_ending = 0  # shut down, and not reported as ended yet

    def __len__(self) -> int:
        """Return the number of open connections."""
        return len(self._open)

    def add(self, descriptor: int, next_number: int) -> None:
        """Note that libzmq has accepted a connection.

        Parameters
        ----------
        next_number : int
            What the authenticator hands out next; this connection's comes from there.
        """
        try:
            inode = os.fstat(descriptor).st_ino
            address = self._address(descriptor)
        except OSError:  # closed already; its end is reported next
            return
        self.remove(descriptor)
        connection = Connection(descriptor, inode, address, next_number)
        self._open[descriptor] = connection
        self._silent.setdefault(address, {})[descriptor] = connection

    def remove(self, descriptor: int) -> int | None:
        """Note that a connection has ended; return its number if it has one."""
        connection = self._open.pop(descriptor, None)
        if connection is None:
            return None
        self._n_ending -= connection.is_ended
        self._forget_candidate(connection)
        if connection.number is not None:
            self._numbered.pop(connection.number, None)
        return connection.number

    def _forget_candidate(self, connection: Connection) -> None:
        for groups in (self._silent, self._greeted):
            group = groups.get(connection.address, {})
            group.pop(connection.descriptor, None)
            if not group:
                groups.pop(connection.address, None)

    def of_message(self, number: int, descriptor: int) -> Connection | None:
        """Return the connection of a message; None where it has ended meanwhile.

        Parameters
        ----------
        number, descriptor : int
            As libzmq attached them to the message.  By now another connection may
            have the descriptor: its number is a later one.
        """
        found = self._numbered.get(number)
        if found is None:
            found = self._open.get(descriptor)
            if found is None or found.number is not None or found.first_number > number:
                return None
            found.number = number
            self._numbered[number] = found
        found.counted_bytes = None
        return None if found.is_ended else found

    def is_open(self, number: int) -> bool:
        """Return whether a connection that has sent a message is still there."""
        found = self._numbered.get(number)
        return found is not None and not found.is_ended

    def note_refusal(self, number: int) -> None:
        """Count a message that another process found wrong."""
        found = self._numbered.get(number)
        if found is not None:
            found.rates.note_refusal()

    def close(self, number: int, why: str) -> None:
        """End a connection that misbehaves."""
        found = self._numbered.get(number)
        if found is not None and not found.is_ended:
            self._shut_down(found)
            log.warning("a connection from %s is closed: %s", found.address, why)

    def evict(self) -> None:
        """Close connections without a session where there are too many."""
        n_surplus = len(self._open) - self._n_ending - self.max_count
        if n_surplus <= 0:
            return
        for _ in range(n_surplus):
            if not (self._evict_silent() or self._evict_greeted()):
                break
            self.n_evicted += 1
        log.warning(
            "%d connections are open, of %d; the oldest without a session are closed",
            *(len(self._open), self.max_count),
            extra=ONCE_A_SECOND,
        )

    def _evict_silent(self) -> bool:
        """Close the oldest one without a greeting; return whether there was one."""
        while self._silent:
            address = max(self._silent, key=lambda a: len(self._silent[a]))
            connection = next(iter(self._silent[address].values()))
            has_session = connection.number in self._with_session
            if not has_session and self._bytes_received(connection) < GREETING_BYTES:
                self._shut_down(connection)
                return True
            self._forget_candidate(connection)
            self._greeted.setdefault(address, {})[connection.descriptor] = connection
        return False

    def _evict_greeted(self) -> bool:
        """Close the oldest one with a greeting, and without a session; likewise."""
        by_size = sorted(self._greeted.values(), key=len, reverse=True)
        for connection in chain.from_iterable(group.values() for group in by_size):
            if connection.number not in self._with_session:
                self._shut_down(connection)
                return True
        return False

    def check_unread(self, now_s: float) -> None:
        """Close connections that fill libzmq's memory before they say hello."""
        if now_s < self._next_check_s:
            return
        self._next_check_s = now_s + CHECK_INTERVAL_S
        if not self._to_check:
            self._to_check = list(self._open.values())
        checked = self._to_check[-MAX_CHECKED:]
        del self._to_check[-MAX_CHECKED:]
        for connection in checked:
            connection.has_had_session |= connection.number in self._with_session
            if connection.has_had_session or connection.is_ended:
                continue
            n_bytes = self._bytes_received(connection)
            if connection.counted_bytes is None:
                connection.counted_bytes = n_bytes
            elif n_bytes - connection.counted_bytes > MAX_UNREAD_BYTES:
                self._shut_down(connection)
                log.warning(
                    "a connection from %s is closed: it sent %d bytes and no message",
                    *(connection.address, n_bytes),
                )

    def _shut_down(self, connection: Connection) -> None:
        """Have libzmq find the connection ended; it closes the descriptor itself."""
        connection.is_ended = True
        self._n_ending += 1
        self._forget_candidate(connection)
        end = self._borrowed(connection)
        if end is not None:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.detach()

    def _bytes_received(self, connection: Connection) -> int:
        """Return what the system has received on a TCP connection; 0 for others."""
        end = self._borrowed(connection)
        if end is None:
            return 0
        try:
            info = end.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_BYTES)
            return int(BYTES_RECEIVED.unpack_from(info, BYTES_RECEIVED_AT)[0])
        except (OSError, struct.error):  # a Unix socket, or an old kernel
            return 0
        finally:
            end.detach()

    def _borrowed(self, connection: Connection) -> socket.socket | None:
        """Return libzmq's socket, to be detached; None where it is another's by now."""
        try:
            if os.fstat(connection.descriptor).st_ino != connection.inode:
                return None
            return self._socket_at(connection.descriptor)
        except OSError:  # libzmq closes it at any time
            return None

    def _socket_at(self, descriptor: int) -> socket.socket:
        return socket.socket(self._family, socket.SOCK_STREAM, 0, fileno=descriptor)

    def _address(self, descriptor: int) -> str:
        """Return who is at the other end of a connection."""
        end = self._socket_at(descriptor)
        try:
            if self._family != socket.AF_UNIX:
                return str(end.getpeername()[0])
            credentials = end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
            return f"process {int.from_bytes(credentials[:4], sys.byteorder)}"
        finally:
            end.detach()
