"""The ROUTER socket: receives messages, sends replies, tracks connections."""

from __future__ import annotations

import ctypes
import enum
import math
import os
import secrets
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zmq

from filter_service.keys import KeyRing
from filter_service.service.authenticator import Authenticator, parse_user_id
from filter_service.service.connections import Connection, Connections, Peer
from filter_service.service.dropped_parts import drop_parts
from filter_service.service.listening_socket import (
    BACKLOG,
    check_path_is_free,
    deferring_listener,
)

COPY_BELOW_BYTES = 65536  # pyzmq copies smaller parts in any case

SEND_HIGH_WATER_MARK = 128
"""With less than about 64, a ROUTER drops replies even if only one is in flight."""

RECEIVE_HIGH_WATER_MARK = 4
"""Limits memory: with libzmq's default of 1000 messages, an overload of 720p frames
took 1.5 GB.  Further messages stay in the kernel, which applies back-pressure."""

HANDSHAKE_LIMIT_MS = 10_000
RETRY_S = 0.001
KEEPALIVE_IDLE_S = 20
MAX_PARTS_DROPPED = 200_000
"""Number of surplus parts dropped per iteration of the event loop (20 ms)."""

MONITOR_PAUSE_S = 0.005
"""Minimum interval between wake-ups by connection events; thousands per second would
otherwise wake the front end one by one."""

MONITOR_ENDPOINT = "inproc://ocufilter.monitor"
EVENT = struct.Struct("=HI")  # event and descriptor
MONITORED = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
SEED_VARIABLE = "OCUFILTER_TEST_RANDOM_SEED"

Tracker = zmq.MessageTracker


class Outcome(enum.Enum):
    """Outcome of sending a reply."""

    SENT = "sent"
    GONE = "gone"  # the client is no longer connected
    STALLED = "stalled"  # the client does not read


class KeyRemoved(Exception):
    """A message was received from a client whose key has been removed."""

    def __init__(self, peer: Peer) -> None:
        super().__init__("the key was removed")
        self.peer = peer


@dataclass(frozen=True)
class Received:
    """A received message.

    Attributes
    ----------
    peer : Peer
    connection : Connection, optional
        None if it has been closed since.
    parts : list of memoryview
        Message parts, not copied.
    n_dropped_parts : int
        Number of surplus parts that were dropped unread.
    """

    peer: Peer
    connection: Connection | None
    parts: list[memoryview]
    n_dropped_parts: int = 0


class Router:
    """A bound ROUTER socket that never blocks and reports replies that it cannot send.

    Parameters
    ----------
    bind : str
        Endpoint; ``tcp://127.0.0.1:*`` selects a free port.
    max_part_bytes : int
        Size beyond which a part disconnects its client.
    max_parts : int
        Maximum number of parts after the routing id; further ones are dropped unread.
    connections : Connections
        Updated from the socket's monitor.
    keys : KeyRing, optional
        If given, only its clients are admitted, and traffic is encrypted.

    Attributes
    ----------
    is_dropping : bool
        Whether surplus parts of a message are being dropped; until the end of that
        message, nothing else is received.
    """

    def __init__(
        self,
        bind: str,
        max_part_bytes: int,
        max_parts: int,
        *,
        connections: Connections,
        keys: KeyRing | None = None,
    ) -> None:
        self._max_parts = max_parts
        self._connections = connections
        self._oversized: Received | None = None
        self._ended: list[int] = []
        _seed_random()
        self._context = zmq.Context()
        self._authenticator = Authenticator(self._context, keys, self._read_monitor)
        self._socket = self._context.socket(zmq.ROUTER)
        socket = self._socket
        socket.linger = 0
        socket.router_mandatory = 1
        socket.sndhwm = SEND_HIGH_WATER_MARK
        socket.rcvhwm = RECEIVE_HIGH_WATER_MARK
        socket.maxmsgsize = max_part_bytes
        socket.backlog = BACKLOG
        socket.handshake_ivl = HANDSHAKE_LIMIT_MS
        # The service sends no heartbeats: libzmq aborts the process
        # (stream_engine_base.cpp) when one is due on a connection that has ended while
        # more of its messages are queued than the high-water mark.  `Alive` and the
        # monitor detect vanished clients; libzmq still answers heartbeats of clients.
        socket.heartbeat_ivl = 0
        socket.tcp_keepalive = 1
        socket.tcp_keepalive_idle = KEEPALIVE_IDLE_S
        if bind.startswith("tcp://["):
            socket.ipv6 = 1
        self._monitor = self._context.socket(zmq.PAIR)
        self._monitor.linger = 0
        # Unlimited: libzmq's I/O thread would block on a full queue.
        self._monitor.rcvhwm = 0
        try:
            socket.monitor(MONITOR_ENDPOINT, MONITORED)
            self._monitor.connect(MONITOR_ENDPOINT)
            self._authenticator.secure(socket)
            check_path_is_free(bind)
            listener = deferring_listener(bind)
            if listener is not None:
                socket.use_fd = listener.fileno()
            socket.bind(bind)
            if listener is not None:
                listener.detach()  # libzmq owns the descriptor now
        except (zmq.ZMQError, OSError, ValueError) as error:
            self.close()
            raise OSError(f"cannot listen on {bind}: {error}") from None
        self.endpoint = socket.get_string(zmq.LAST_ENDPOINT)
        if self.endpoint.startswith("ipc://"):
            Path(self.endpoint.removeprefix("ipc://")).chmod(0o600)
        self._poller = zmq.Poller()
        for watched in (socket, self._authenticator.socket, self._monitor):
            self._poller.register(watched, zmq.POLLIN)
        self._watched: set[int] = set()
        self._next_monitored_s = 0.0

    @property
    def is_dropping(self) -> bool:
        """Return whether surplus parts of a message are being dropped."""
        return self._oversized is not None

    def watch(self, readable: set[int], writable: set[int]) -> None:
        """Set the other descriptors for which `wait` returns."""
        for gone in self._watched - readable - writable:
            self._poller.unregister(gone)
        for descriptor in readable | writable:
            reads = zmq.POLLIN if descriptor in readable else 0
            writes = zmq.POLLOUT if descriptor in writable else 0
            self._poller.register(descriptor, reads | writes)
        self._watched = readable | writable

    def wait(self, timeout_s: float) -> None:
        """Wait for messages, connection events or watched descriptors, or a timeout."""
        pause_s = self._next_monitored_s - time.monotonic()
        if pause_s > 0.0:
            self._poller.modify(self._monitor, 0)
            timeout_s = min(timeout_s, pause_s)
        self._poller.poll(max(0, math.ceil(1000 * timeout_s)))
        if pause_s > 0.0:
            self._poller.modify(self._monitor, zmq.POLLIN)
        self._read_monitor()
        self._authenticator.handle_requests()

    def pop_ended(self) -> list[int]:
        """Return the numbers of the connections that have ended since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def _read_monitor(self) -> None:
        """Process connection events of the monitor."""
        receive, count = self._monitor.recv, 0
        try:
            while True:
                event, descriptor = EVENT.unpack(receive(zmq.NOBLOCK))
                receive()  # the endpoint
                count += 1
                if event == zmq.EVENT_ACCEPTED:
                    number = self._authenticator.next_number
                    self._connections.add(descriptor, number)
                elif (ended := self._connections.remove(descriptor)) is not None:
                    self._ended.append(ended)
        except zmq.Again:
            pass
        if count:
            self._next_monitored_s = time.monotonic() + MONITOR_PAUSE_S
            self._connections.evict()

    def receive(self) -> Received | None:
        """Return the next complete message, or None.

        All parts of a message are read from the socket, however many there are: the
        remaining ones would be read as the next message.

        Raises
        ------
        KeyRemoved
            If the sender's key is no longer allowed.
        """
        if self._oversized is not None:
            return self._drop_surplus(self._oversized)
        try:
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        routing_id, (number, key) = frame.bytes, parse_user_id(str(frame["User-Id"]))
        descriptor = int(frame.get(zmq.SRCFD))
        connection = self._connections.find(number, descriptor)
        received = Received(Peer(routing_id, number, key), connection, [])
        parts = received.parts
        while frame.more and len(parts) < self._max_parts:
            frame = self._socket.recv(copy=False)
            parts.append(frame.buffer)
        if frame.more:
            return self._drop_surplus(received)
        if not self._authenticator.accepts(key):
            raise KeyRemoved(received.peer)
        return received

    def _drop_surplus(self, received: Received) -> Received | None:
        """Drop some surplus parts of a message, which may have millions.

        Return the message, with its allowed parts, once all are dropped.
        """
        count, has_more = drop_parts(self._socket, MAX_PARTS_DROPPED)
        received = replace(received, n_dropped_parts=received.n_dropped_parts + count)
        self._oversized = received if has_more else None
        return None if has_more else received

    def send(
        self, peer: Peer, parts: Sequence[Any]
    ) -> tuple[Outcome, zmq.MessageTracker | None]:
        """Send a message; large parts are not copied and must not change.

        A new client may have the routing id of one that has just disconnected.  libzmq
        selects the connection when it gets the routing id.  By then its monitor has
        reported the end of the previous connection, so this reads the monitor afterward
        and sends only an empty part if the connection has changed.

        Returns
        -------
        outcome : Outcome
        tracker : MessageTracker or None
            Tracker of the last large part, done once libzmq has released it.
        """
        tracker = None
        if not self._connections.is_open(peer.connection):
            return Outcome.GONE, None
        try:
            self._send_routing_id(peer.routing_id)
            self._read_monitor()
            if not self._connections.is_open(peer.connection):
                self._socket.send(b"", zmq.NOBLOCK)
                return Outcome.GONE, None
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

    def _send_routing_id(self, routing_id: bytes) -> None:
        """Send the routing id.

        Raises
        ------
        zmq.Again
            If the send queue of the client is full.
        zmq.ZMQError
            If the client is not connected.
        """
        flags = zmq.NOBLOCK | zmq.SNDMORE
        try:
            self._socket.send(routing_id, flags)
        except zmq.Again:
            # libzmq notices free space in a queue about once per millisecond.
            time.sleep(RETRY_S)
            self._socket.send(routing_id, flags)

    def close(self, *, linger_ms: int = 0) -> None:
        """Close the socket; replies unsent after the linger time are lost."""
        endpoint = getattr(self, "endpoint", "")
        self._socket.close(linger=linger_ms)
        self._authenticator.close()
        self._monitor.close(linger=0)
        self._context.term()
        if endpoint.startswith("ipc://"):
            Path(endpoint.removeprefix("ipc://")).unlink(missing_ok=True)


def _seed_random() -> None:
    """Seed the generator of libzmq's routing ids with an unpredictable number.

    libzmq uses the C library's generator and never seeds it, so the first routing id
    would be the same in every process.
    """
    seed = os.environ.get(SEED_VARIABLE)
    ctypes.CDLL(None).srand(int(seed) if seed else secrets.randbits(32))
