"""The ROUTER socket: receives messages, sends replies, tracks connections."""

from __future__ import annotations

import ctypes
import enum
import logging
import math
import os
import secrets
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import zmq
from zmq.utils import z85

from filter_service.keys import KeyRing
from filter_service.service.connections import (
    BACKLOG,
    Connection,
    Connections,
    Peer,
    check_path_is_free,
    deferring_listener,
)

ZAP_ENDPOINT = "inproc://zeromq.zap.01"
ZAP_VERSION = b"1.0"
ZAP_DOMAIN = b"ocufilter"
MAX_REQUESTS_PER_TURN = 64
READABLE = int(zmq.POLLIN)
SOURCE_DESCRIPTOR = int(zmq.SRCFD)
NO_WAIT, NO_WAIT_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)
"""Flags as integers: operations on pyzmq's enumerations take 1 to 5 us each."""

log = logging.getLogger("ocufilter")


class Authenticator:
    """ZAP handler that numbers connections and admits only those with an allowed key.

    Parameters
    ----------
    context : zmq.Context
        Context of the secured socket, which must be bound after this handler exists.
    keys : KeyRing, optional
        Allowed keys; if None, every connection is admitted.
    on_request : callable
        Called when a connection requests admission, before it is numbered; by then the
        socket's monitor has reported that the connection was accepted.

    Attributes
    ----------
    next_number : int
        Number of the next connection that is admitted.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        keys: KeyRing | None,
        on_request: Callable[[], None],
    ) -> None:
        self._keys, self._on_request = keys, on_request
        self.next_number = 1
        self.socket = context.socket(zmq.REP)
        self.socket.linger = 0
        self.socket.bind(ZAP_ENDPOINT)

    def secure(self, socket: zmq.Socket[bytes]) -> None:
        """Enable authentication on a socket that is not bound yet."""
        socket.zap_domain = ZAP_DOMAIN
        if self._keys is not None:
            pair = self._keys.server
            socket.curve_server = True
            socket.curve_secretkey = pair.secret.encode()
            socket.curve_publickey = pair.public.encode()

    def handle_requests(self) -> None:
        """Reply to pending ZAP requests."""
        for _ in range(MAX_REQUESTS_PER_TURN):
            if not has_message(self.socket):
                return
            request = self.socket.recv_multipart(zmq.NOBLOCK)
            self._on_request()
            self.socket.send_multipart(self._reply(request))

    def accepts(self, key: str) -> bool:
        """Return whether a client's public key is currently allowed."""
        return self._keys is None or key in self._keys.allowed()

    def _reply(self, request: list[bytes]) -> list[bytes]:
        _, request_id, _, address, _, mechanism, *credentials = request
        key = ""
        if self._keys is not None:
            key = z85.encode(credentials[0]).decode() if credentials else ""
            if mechanism != b"CURVE" or not self.accepts(key):
                log.warning(
                    "rejected a client at %s: its key is not allowed", address.decode()
                )
                return [
                    *(ZAP_VERSION, request_id, b"400", b"key is not allowed", b"", b"")
                ]
        user_id = f"{self.next_number} {key}".strip()
        self.next_number += 1
        return [ZAP_VERSION, request_id, b"200", b"OK", user_id.encode(), b""]

    def close(self) -> None:
        """Close the socket."""
        self.socket.close(linger=0)


def has_message(socket: zmq.Socket[bytes]) -> bool:
    """Return whether a message can be received.

    This takes a fraction of the time of the exception that `recv` raises otherwise.
    """
    return bool(int(socket.get(zmq.EVENTS)) & READABLE)


def parse_user_id(user_id: str) -> tuple[int, str]:
    """Return a connection's number and key, parsed from its ``User-Id``."""
    number, _, key = user_id.partition(" ")
    return int(number), key


@lru_cache(maxsize=256)
def _peer_of(routing_id: bytes, user_id: str) -> Peer:
    """Return the sender of messages; a stream's messages have the same one."""
    return Peer(routing_id, *parse_user_id(user_id))


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
        self._watched: dict[int, bool] = {}
        self._next_monitored_s = 0.0

    @property
    def is_dropping(self) -> bool:
        """Return whether surplus parts of a message are being dropped."""
        return self._oversized is not None

    def watch(self, descriptors: dict[int, bool]) -> None:
        """Set the other descriptors for which `wait` returns.

        Parameters
        ----------
        descriptors : dict
            Whether each is awaited to be writable, too, not only readable.
        """
        if descriptors == self._watched:
            return
        for gone in self._watched.keys() - descriptors.keys():
            self._poller.unregister(gone)
        for descriptor, has_unsent in descriptors.items():
            events = zmq.POLLIN | zmq.POLLOUT if has_unsent else zmq.POLLIN
            self._poller.register(descriptor, events)
        self._watched = descriptors

    def wait(self, timeout_s: float) -> set[int]:
        """Wait for messages, connection events or watched descriptors, or a timeout.

        Returns
        -------
        set of int
            Watched descriptors that are readable or writable, or whose other end is
            closed.
        """
        pause_s = self._next_monitored_s - time.monotonic()
        if pause_s > 0.0:
            self._poller.modify(self._monitor, 0)
            timeout_s = min(timeout_s, pause_s)
        events = dict(self._poller.poll(max(0, math.ceil(1000 * timeout_s))))
        if pause_s > 0.0:
            self._poller.modify(self._monitor, zmq.POLLIN)
        if self._monitor in events:
            self._read_monitor()
        if self._authenticator.socket in events:
            self._authenticator.handle_requests()
        return {watched for watched in events if isinstance(watched, int)}

    def pop_ended(self) -> list[int]:
        """Return the numbers of the connections that have ended since the last call."""
        ended, self._ended = self._ended, []
        return ended

    def _read_monitor(self) -> None:
        """Process connection events of the monitor."""
        receive, count = self._monitor.recv, 0
        while has_message(self._monitor):
            event, descriptor = EVENT.unpack(receive(zmq.NOBLOCK))
            receive()  # the endpoint
            count += 1
            if event == zmq.EVENT_ACCEPTED:
                number = self._authenticator.next_number
                self._connections.add(descriptor, number)
            elif (ended := self._connections.remove(descriptor)) is not None:
                self._ended.append(ended)
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
        if not has_message(self._socket):
            return None
        frame = self._socket.recv(zmq.NOBLOCK, copy=False)
        peer = _peer_of(frame.bytes, str(frame["User-Id"]))
        descriptor = int(frame.get(SOURCE_DESCRIPTOR))
        connection = self._connections.find(peer.connection, descriptor)
        received = Received(peer, connection, [])
        parts = received.parts
        while frame.more and len(parts) < self._max_parts:
            frame = self._socket.recv(copy=False)
            parts.append(frame.buffer)
        if frame.more:
            return self._drop_surplus(received)
        if not self._authenticator.accepts(peer.key):
            raise KeyRemoved(peer)
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
                self._socket.send(b"", NO_WAIT)
                return Outcome.GONE, None
            for i, part in enumerate(parts):
                flags = NO_WAIT_MORE if i < len(parts) - 1 else NO_WAIT
                large = memoryview(part).nbytes >= COPY_BELOW_BYTES
                sent = self._socket.send(part, flags, copy=not large, track=large)
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
        try:
            self._socket.send(routing_id, NO_WAIT_MORE)
        except zmq.Again:
            # libzmq notices free space in a queue about once per millisecond.
            time.sleep(RETRY_S)
            self._socket.send(routing_id, NO_WAIT_MORE)

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
