"""The connections of the ROUTER socket, tracked by its monitor and its messages.

libzmq neither limits connections nor reports which connection has which routing id.
The authenticator therefore assigns each connection a unique number, which libzmq
attaches to every message (`User-Id`).  Sessions belong to that number, not to a routing
id, which a client chooses itself.
"""

from __future__ import annotations

import enum
import logging
import math
import os
import resource
import socket
import struct
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from filter_service.log_lines import ONCE_A_SECOND

WINDOW_S = 1.0
MAX_REFUSALS = 100
"""Refused messages per window, beyond which the rest of the window is ignored."""

MAX_REQUESTS = 200
"""The same for messages other than frames; each takes the front end about 0.1 ms."""

MAX_IGNORED = 400
"""Ignored messages per window, beyond which the connection is closed.  Reading and
discarding one takes about 0.01 ms."""


class Verdict(enum.Enum):
    """Decision about the next message of a connection."""

    HANDLE = "handle"
    IGNORE = "ignore"
    CLOSE = "close"


class RateLimit:
    """Counts the messages of one connection in windows of a second."""

    def __init__(self) -> None:
        self._ends_s = 0.0
        self._n_refusals = self._n_requests = self._n_ignored = 0

    def verdict(self, now_s: float) -> Verdict:
        """Return the decision about the next message."""
        if now_s >= self._ends_s:
            self._ends_s = now_s + WINDOW_S
            self._n_refusals = self._n_requests = self._n_ignored = 0
        if self._n_refusals < MAX_REFUSALS and self._n_requests < MAX_REQUESTS:
            return Verdict.HANDLE
        self._n_ignored += 1
        return Verdict.IGNORE if self._n_ignored <= MAX_IGNORED else Verdict.CLOSE

    def exhaust(self) -> None:
        """Exhaust the limit: the next message in the window closes the connection."""
        self._n_refusals, self._n_ignored = MAX_REFUSALS, MAX_IGNORED

    def count_refusal(self) -> None:
        """Count a refused message."""
        self._n_refusals += 1

    def count_request(self) -> None:
        """Count a message other than a frame."""
        self._n_requests += 1


TARGET_COUNT = 4096
"""Soft limit to request, up to the hard limit."""

RESERVE = 32
"""Descriptors that only the front end itself may open."""

BASE_COUNT = 96
"""The reserve, plus the descriptors that are open without clients (30), rounded up."""


class DescriptorLimit:
    """Limit of the descriptors of this process.

    Parameters
    ----------
    max_sessions : int
        Number of sessions that must fit.

    Attributes
    ----------
    max_connections : int
        Maximum number of simultaneous connections, with or without a session.
    max_slots : int
        Maximum number of open shared-memory slots.

    Raises
    ------
    OSError
        If the hard limit is too low for that many sessions.
    """

    def __init__(self, max_sessions: int) -> None:
        soft, self._hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        most = max(soft, TARGET_COUNT) if soft >= 0 else TARGET_COUNT
        self._most = most if self._hard < 0 else min(most, self._hard)
        least = BASE_COUNT + 3 * max_sessions
        if self._most < least:
            raise OSError(
                f"this process may open {self._most} files; expected at least {least} "
                f"for {max_sessions} sessions: raise the limit (ulimit -n {least}, or "
                f"LimitNOFILE={least} of a systemd unit), or lower max_sessions"
            )
        free = self._most - BASE_COUNT
        self.max_slots = max(max_sessions, free // 4)
        self.max_connections = free - self.max_slots
        self._set(self._most - RESERVE)

    def _set(self, soft: int) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, self._hard))

    @contextmanager
    def reserve(self) -> Iterator[None]:
        """Return a context in which the reserve may be used."""
        self._set(self._most)
        try:
            yield
        finally:
            self._set(self._most - RESERVE)


BACKLOG = 4096
"""Larger than libzmq's 100: when many clients connect at once, a full backlog loses
their first packets, which the system resends only after a second."""

DEFER_ACCEPT_S = 5
"""Minimum time for which the kernel holds back TCP connections that have sent no data;
a ZeroMQ client sends first.  1,500 silent clients that keep reconnecting then cause at
most 200 accepted connections per second instead of 5,000."""

TCP_DEFER_ACCEPT: int | None = getattr(socket, "TCP_DEFER_ACCEPT", None)


def check_path_is_free(bind: str) -> None:
    """Check that an ``ipc://`` path is free or a stale socket, which binding replaces.

    Raises
    ------
    FileExistsError
        If it is another file, or a service listens on it.
    """
    if not bind.startswith("ipc://"):
        return
    path = Path(bind.removeprefix("ipc://"))
    if not path.exists():
        return
    if not path.is_socket():
        raise FileExistsError(f"{path} exists and is not a socket")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return
    raise FileExistsError(f"another service listens on {path}")


def socket_family(bind: str) -> socket.AddressFamily:
    """Return the address family of an endpoint's connections."""
    if bind.startswith("ipc://"):
        return socket.AF_UNIX
    return socket.AF_INET6 if bind.startswith("tcp://[") else socket.AF_INET


def deferring_listener(bind: str) -> socket.socket | None:
    """Return a TCP socket that accepts connections once their clients have sent data.

    Return None for other transports, and for interface names, which libzmq resolves.

    Raises
    ------
    OSError
        If the address is in use, or is not one of this machine.
    """
    if not bind.startswith("tcp://") or TCP_DEFER_ACCEPT is None:
        return None
    host, _, port = bind.removeprefix("tcp://").rpartition(":")
    family = socket_family(bind)
    wildcard = "::" if family == socket.AF_INET6 else "0.0.0.0"
    name = wildcard if host == "*" else host.strip("[]")
    number = 0 if port == "*" else int(port)
    try:
        found = socket.getaddrinfo(name, number, family, socket.SOCK_STREAM)
    except socket.gaierror:
        return None
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.IPPROTO_TCP, TCP_DEFER_ACCEPT, DEFER_ACCEPT_S)
        listener.bind(found[0][4])
        listener.listen(BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener


MAX_UNREAD_BYTES = 262_144
"""Bytes of an incomplete message that a connection without a session may send in any
time.  libzmq buffers incomplete messages without exposing them."""

MAX_INCOMPLETE_S = 10.0
"""Time for which such a connection may have sent more than that.  After a restart of
the service, a client that has not noticed sends a frame, to be told `no_session`."""

DISTRUST_S, MAX_DISTRUSTED = 60.0, 1000
"""Time for which connections from the address of a flood of message parts may not have
sent more than `MAX_UNREAD_BYTES`, and the largest number of such addresses.  Parts can
be counted only in complete messages, and until six million are read, for 0.6 s, no
other message is."""

CHECK_INTERVAL_S = 0.01
MAX_CHECKED = 64
"""Connections checked per interval, 0.006 ms each."""

GREETING_BYTES = 64
"""Size of the ZMTP greeting, which a ZeroMQ client sends first."""

TCP_INFO_BYTES = 136
BYTES_RECEIVED = struct.Struct("=Q")
BYTES_RECEIVED_AT = 128
"""Offset of `tcpi_bytes_received` in Linux's ``struct tcp_info``."""

log = logging.getLogger("ocufilter")


@dataclass(frozen=True)
class Peer:
    """The sender of a message, to which its reply goes.

    Attributes
    ----------
    routing_id : bytes
        Address of replies.  Successive connections may use the same one.
    connection : int
        Number of the connection, unique in this process.
    key : str
        The client's public CURVE key; empty if the service has no keys.
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
        The inode shows whether the descriptor is still this connection's.
    address : str
        Address of the client; for a Unix socket, its process.
    first_number : int
        Lower bound of the connection's number.
    number : int, optional
        Number of the connection, known from its first message on.
    """

    descriptor: int
    inode: int
    address: str
    first_number: int
    number: int | None = None
    is_shut_down: bool = False
    has_had_session: bool = False
    counted_bytes: int | None = None  # received when its last message was complete
    unread_bytes: int = 0  # received since then, if more than `MAX_UNREAD_BYTES`
    unread_since_s: float = 0.0
    rates: RateLimit = field(default_factory=RateLimit)


class Connections:
    """All connections, limited in number.

    When too many are open, the oldest ones without a session are closed: first those
    that have not sent a greeting, from the address that has most of them.  A client
    sends hello within milliseconds of connecting, so it is rarely evicted.

    Parameters
    ----------
    max_count : int
    with_session : collection of int
        Numbers of the connections that have a session now (a live view).
    family : socket.AddressFamily
        Address family of all connections.  Querying it for each connection took a third
        of the connection's total cost.
    max_unread_bytes : int
        Maximum total size of the large incomplete messages of connections without a
        session.

    Attributes
    ----------
    n_evicted : int
    """

    def __init__(
        self,
        max_count: int,
        with_session: Collection[int],
        family: socket.AddressFamily = socket.AF_INET,
        *,
        max_unread_bytes: int = 250_000_000,
    ) -> None:
        self._family = family
        self._max_unread_bytes = max_unread_bytes
        self.max_count = max_count
        self.n_evicted = 0
        self._with_session = with_session
        self._open: dict[int, Connection] = {}  # by descriptor, oldest first
        self._numbered: dict[int, Connection] = {}
        # Connections by address and descriptor, oldest first: those whose greeting has
        # not been seen, and the others.
        self._without_greeting: dict[str, dict[int, Connection]] = {}
        self._with_greeting: dict[str, dict[int, Connection]] = {}
        self._next_check_s = 0.0
        self._to_check: list[Connection] = []
        self._unread: set[Connection] = set()  # with a large incomplete message
        self._distrusted_until_s: dict[str, float] = {}  # by address, oldest first
        self._n_ending = 0  # shut down, not yet reported as ended

    def __len__(self) -> int:
        """Return the number of open connections."""
        return len(self._open)

    def add(self, descriptor: int, next_number: int) -> None:
        """Record a connection that libzmq has accepted.

        Parameters
        ----------
        next_number : int
            Next number of the authenticator; the connection's number is not lower.
        """
        try:
            inode = os.fstat(descriptor).st_ino
            address = self._address(descriptor)
        except OSError:  # already closed; the monitor reports its end next
            return
        self.remove(descriptor)
        connection = Connection(descriptor, inode, address, next_number)
        self._open[descriptor] = connection
        self._without_greeting.setdefault(address, {})[descriptor] = connection

    def remove(self, descriptor: int) -> int | None:
        """Remove a connection that has ended; return its number if it has one."""
        connection = self._open.pop(descriptor, None)
        if connection is None:
            return None
        self._n_ending -= connection.is_shut_down
        self._unread.discard(connection)
        self._remove_candidate(connection)
        if connection.number is not None:
            self._numbered.pop(connection.number, None)
        return connection.number

    def _remove_candidate(self, connection: Connection) -> None:
        for groups in (self._without_greeting, self._with_greeting):
            group = groups.get(connection.address, {})
            group.pop(connection.descriptor, None)
            if not group:
                groups.pop(connection.address, None)

    def find(self, number: int, descriptor: int) -> Connection | None:
        """Return the connection that sent a message; None if it has ended since.

        Parameters
        ----------
        number, descriptor : int
            As attached to the message by libzmq.  A connection with a higher number may
            have reused the descriptor.
        """
        found = self._numbered.get(number)
        if found is None:
            found = self._open.get(descriptor)
            if found is None or found.number is not None or found.first_number > number:
                return None
            found.number = number
            self._numbered[number] = found
        found.counted_bytes = None
        self._unread.discard(found)
        return None if found.is_shut_down else found

    def is_open(self, number: int) -> bool:
        """Return whether a connection that has sent a message is still open."""
        found = self._numbered.get(number)
        return found is not None and not found.is_shut_down

    def count_refusal(self, number: int) -> None:
        """Count a message that a render worker refused."""
        found = self._numbered.get(number)
        if found is not None:
            found.rates.count_refusal()

    def close(self, number: int, reason: str) -> None:
        """Close a connection that violates the protocol."""
        found = self._numbered.get(number)
        if found is not None and not found.is_shut_down:
            self._shut_down(found)
            log.warning("closed a connection from %s: %s", found.address, reason)

    def evict(self) -> None:
        """Close surplus connections that have no session."""
        n_surplus = len(self._open) - self._n_ending - self.max_count
        if n_surplus <= 0:
            return
        for _ in range(n_surplus):
            if not (self._evict_without_greeting() or self._evict_with_greeting()):
                break
            self.n_evicted += 1
        log.warning(
            "%d connections are open (limit %d); closed the oldest without a session",
            *(len(self._open), self.max_count),
            extra=ONCE_A_SECOND,
        )

    def _evict_without_greeting(self) -> bool:
        """Close the oldest connection without a greeting; return whether one exists."""
        while self._without_greeting:
            address = max(
                self._without_greeting, key=lambda a: len(self._without_greeting[a])
            )
            connection = next(iter(self._without_greeting[address].values()))
            has_session = connection.number in self._with_session
            if not has_session and self._bytes_received(connection) < GREETING_BYTES:
                self._shut_down(connection)
                return True
            self._remove_candidate(connection)
            self._with_greeting.setdefault(address, {})[connection.descriptor] = (
                connection
            )
        return False

    def _evict_with_greeting(self) -> bool:
        """Close the oldest connection that has sent a greeting but has no session."""
        by_size = sorted(self._with_greeting.values(), key=len, reverse=True)
        for connection in chain.from_iterable(group.values() for group in by_size):
            if connection.number not in self._with_session:
                self._shut_down(connection)
                return True
        return False

    @property
    def due_s(self) -> float:
        """Return the `time.monotonic` at which `check_unread` is next due."""
        return self._next_check_s if self._to_check or self._unread else math.inf

    def distrust(self, connection: Connection, now_s: float) -> None:
        """Allow no large incomplete messages from the address of a connection."""
        self._distrusted_until_s.pop(connection.address, None)
        self._distrusted_until_s[connection.address] = now_s + DISTRUST_S
        if len(self._distrusted_until_s) > MAX_DISTRUSTED:
            self._distrusted_until_s.pop(next(iter(self._distrusted_until_s)))

    def check_unread(self, now_s: float) -> None:
        """Close connections without a session that hold too much of a message.

        Call this after the complete messages have been received: they are answered
        whatever their size.
        """
        if now_s < self._next_check_s:
            return
        self._next_check_s = now_s + CHECK_INTERVAL_S
        if not self._to_check:
            self._to_check = list(self._open.values())
        checked = self._to_check[-MAX_CHECKED:]
        del self._to_check[-MAX_CHECKED:]
        for connection in checked:
            self._count_unread(connection, now_s)
        excess_bytes = sum(c.unread_bytes for c in self._unread)
        excess_bytes -= self._max_unread_bytes
        for connection in sorted(self._unread, key=lambda c: -c.unread_bytes):
            trusted_s = self._distrusted_until_s.get(connection.address, 0.0)
            is_late = (
                now_s - connection.unread_since_s > MAX_INCOMPLETE_S
                or now_s < trusted_s
            )
            if is_late or excess_bytes > 0:
                excess_bytes -= connection.unread_bytes
                self._shut_down(connection)
                log.warning(
                    "closed a connection from %s: it sent %d bytes and no message",
                    *(connection.address, connection.unread_bytes),
                )

    def _count_unread(self, connection: Connection, now_s: float) -> None:
        """Measure the incomplete message of a connection without a session."""
        connection.has_had_session |= connection.number in self._with_session
        if connection.has_had_session or connection.is_shut_down:
            self._unread.discard(connection)
            return
        n_bytes = self._bytes_received(connection)
        if connection.counted_bytes is None:
            connection.counted_bytes = n_bytes
        connection.unread_bytes = n_bytes - connection.counted_bytes
        if connection.unread_bytes > MAX_UNREAD_BYTES:
            if connection not in self._unread:
                self._unread.add(connection)
                connection.unread_since_s = now_s

    def _shut_down(self, connection: Connection) -> None:
        """Shut a connection down; libzmq then closes the descriptor itself."""
        connection.is_shut_down = True
        self._unread.discard(connection)
        self._n_ending += 1
        self._remove_candidate(connection)
        end = self._borrow_socket(connection)
        if end is not None:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.detach()

    def _bytes_received(self, connection: Connection) -> int:
        """Return the bytes received on a TCP connection; 0 for other kinds."""
        end = self._borrow_socket(connection)
        if end is None:
            return 0
        try:
            info = end.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_BYTES)
            return int(BYTES_RECEIVED.unpack_from(info, BYTES_RECEIVED_AT)[0])
        except (OSError, struct.error):  # a Unix socket, or an old kernel
            return 0
        finally:
            end.detach()

    def _borrow_socket(self, connection: Connection) -> socket.socket | None:
        """Return a socket object for libzmq's descriptor; None if that was reused.

        The caller must detach it.
        """
        try:
            if os.fstat(connection.descriptor).st_ino != connection.inode:
                return None
            return self._socket_at(connection.descriptor)
        except OSError:  # libzmq may close it at any time
            return None

    def _socket_at(self, descriptor: int) -> socket.socket:
        return socket.socket(self._family, socket.SOCK_STREAM, 0, fileno=descriptor)

    def _address(self, descriptor: int) -> str:
        """Return the address or process of the peer."""
        end = self._socket_at(descriptor)
        try:
            if self._family != socket.AF_UNIX:
                return str(end.getpeername()[0])
            credentials = end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
            return f"process {int.from_bytes(credentials[:4], sys.byteorder)}"
        finally:
            end.detach()
