"""A DEALER socket to the service, with connection state and zero-copy sends.

`filter_client` speaks the protocol over it; this module handles message parts only.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray
from zmq.utils.monitor import recv_monitor_message

from filter_service.errors import ServiceTimeout
from filter_service.keys import ClientKey

COPY_BELOW_BYTES = 65536  # pyzmq copies smaller parts in any case
MAX_BUFFERS_PER_SIZE = 8
HEARTBEAT_INTERVAL_MS = 500
HEARTBEAT_TIMEOUT_MS = 2000
RECONNECT_INTERVAL_MS = 50
RECONNECT_MAX_MS = 1000
CLOSE_LINGER_MS = 200
MAX_BROKEN_HANDSHAKES = 5
SEND_HIGH_WATER_MARK = 64
# The credit bounds results.  Only heartbeats, one every 5 s, add up while a program
# does not read; beyond the mark the connection counts as dead.
RECEIVE_HIGH_WATER_MARK = 100_000

_UP = zmq.EVENT_HANDSHAKE_SUCCEEDED
_DOWN = zmq.EVENT_DISCONNECTED
_HANDSHAKE_FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)


class SendBuffer:
    """A buffer that one image is copied into and sent from.

    Reusing an array right after a zero-copy send tears frames at the receiver
    (2 of 100 measured), so a buffer is free again only when its tracker is done.
    """

    def __init__(self, size_bytes: int) -> None:
        self.memory = np.empty(size_bytes, dtype=np.uint8)
        self.tracker: zmq.MessageTracker | None = None
        self.is_held = False

    @property
    def is_free(self) -> bool:
        """Return whether the buffer is no longer read and can be reused."""
        if self.is_held:
            return False
        return self.tracker is None or self.tracker.done


class SendBufferPool:
    """A pool of send buffers by size; sizes that are no longer used are released."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._buffers: dict[int, list[SendBuffer]] = {}

    def copy_in(self, image: NDArray[Any]) -> tuple[SendBuffer, NDArray[Any]]:
        """Return a held buffer and the image as an array inside it."""
        buffer = self._take(image.nbytes)
        copy = buffer.memory.view(image.dtype).reshape(image.shape)
        np.copyto(copy, image)
        return buffer, copy

    def _take(self, size_bytes: int) -> SendBuffer:
        buffers = self._buffers.setdefault(size_bytes, [])
        buffer = next((item for item in buffers if item.is_free), None)
        if buffer is None and len(buffers) >= MAX_BUFFERS_PER_SIZE:
            buffer = self._wait_for_one(buffers)
        if buffer is None:
            self._forget_other_sizes(size_bytes)
            buffer = SendBuffer(size_bytes)
            buffers.append(buffer)
        buffer.is_held = True
        buffer.tracker = None
        return buffer

    def _wait_for_one(self, buffers: list[SendBuffer]) -> SendBuffer | None:
        """Wait until the oldest sent buffer is free; return None if all are held."""
        for buffer in buffers:
            if not buffer.is_held and buffer.tracker is not None:
                try:
                    buffer.tracker.wait(self._timeout_s)
                except zmq.NotDone:
                    raise ServiceTimeout(
                        f"{len(buffers)} images of {buffer.memory.nbytes} bytes were "
                        f"not accepted by the service within {self._timeout_s:g} s"
                    ) from None
                return buffer
        return None

    def _forget_other_sizes(self, size_bytes: int) -> None:
        """Release unused sizes once there are many: the camera has changed."""
        for other in [size for size in self._buffers if size != size_bytes]:
            if len(self._buffers) > 8 and all(b.is_free for b in self._buffers[other]):
                del self._buffers[other]


class Connection:
    """A DEALER socket that tracks whether the service is connected.

    Parameters
    ----------
    endpoint : str
        Address such as ``tcp://127.0.0.1:5577`` or ``ipc:///run/user/1000/ocufilter``.
    key : ClientKey, optional
        Client key, for a service that requires one.
    """

    def __init__(self, endpoint: str, key: ClientKey | None = None) -> None:
        self.endpoint = endpoint
        self.has_failed_handshake = False
        self._n_broken_handshakes = 0
        self.is_up = False
        self.state = "not connected yet"
        self.n_connections = 0
        self.last_message_s: float | None = None
        self.n_bytes_sent = self.n_bytes_received = 0  # of messages
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._set_options()
        if key is not None:
            key.use_on(self._socket)
        self._monitor = self._socket.get_monitor_socket(_UP | _DOWN | _HANDSHAKE_FAILED)
        self._monitor.linger = 0
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._monitor, zmq.POLLIN)
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise ValueError(
                f"endpoint is {endpoint!r} ({error}); a form that works is "
                "tcp://127.0.0.1:5577"
            ) from None

    def _set_options(self) -> None:
        socket = self._socket
        socket.linger = 0
        # Queue nothing for an absent service: frames would be stale.
        socket.immediate = True
        socket.sndhwm = SEND_HIGH_WATER_MARK
        socket.rcvhwm = RECEIVE_HIGH_WATER_MARK
        socket.reconnect_ivl = RECONNECT_INTERVAL_MS
        socket.reconnect_ivl_max = RECONNECT_MAX_MS
        # Heartbeats detect a stopped service, but not a hung render loop (see ping).
        socket.heartbeat_ivl = HEARTBEAT_INTERVAL_MS
        socket.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS

    def wait(self, timeout_s: float) -> None:
        """Wait for a message or a connection change, or until the timeout."""
        self._poller.poll(max(0, round(timeout_s * 1000)))

    def changes(self) -> list[bool]:
        """Return connection changes since the last call: True is up, False down."""
        changes = []
        while self._monitor.poll(0):
            event = recv_monitor_message(self._monitor)
            kind = event["event"]
            if kind & _UP:
                self.is_up, self.state = True, "connected"
                self.has_failed_handshake = False
                self._n_broken_handshakes = 0
                self.n_connections += 1
                changes.append(True)
            elif kind & _DOWN:
                self.is_up, self.state = False, "connection lost, reconnecting"
                changes.append(False)
            else:
                # A failure without a reason means a wrong key, or a service under
                # attack that had to close connections.
                self._n_broken_handshakes += (
                    kind == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
                )
                self.has_failed_handshake = (
                    kind != zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
                    or self._n_broken_handshakes >= MAX_BROKEN_HANDSHAKES
                )
                self.state = f"the service refused the handshake ({event['value']})"
        return changes

    def receive(self) -> list[zmq.Frame] | None:
        """Return the parts of one received message, or None."""
        try:
            parts = self._socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        self.last_message_s = time.monotonic()
        self.n_bytes_received += sum(len(part) for part in parts)
        return parts

    def send(self, parts: Sequence[Any], buffers: Sequence[SendBuffer] = ()) -> bool:
        """Send parts; return False if the connection cannot accept them now.

        ``buffers`` hold the memory of ``parts[1:]``, in order, and receive the
        trackers.
        """
        last = len(parts) - 1
        for i, part in enumerate(parts):
            flags = zmq.NOBLOCK | (zmq.SNDMORE if i < last else 0)
            n_bytes = memoryview(part).nbytes
            is_large = n_bytes >= COPY_BELOW_BYTES
            try:
                tracker = self._socket.send(
                    part, flags, copy=not is_large, track=is_large
                )
            except zmq.Again:
                if i == 0:
                    return False
                # The connection broke inside the message.  libzmq discards everything
                # up to the last part, so the remaining parts must still be sent; the
                # message counts as sent and is lost with the connection.
                continue
            self.n_bytes_sent += n_bytes
            if is_large and i > 0 and i - 1 < len(buffers):
                buffers[i - 1].tracker = tracker
        return True

    def describe(self) -> str:
        """Return a phrase about the connection, for error messages."""
        if self.last_message_s is None:
            return f"{self.state}; nothing was ever received"
        silent_s = time.monotonic() - self.last_message_s
        return f"{self.state}; the last message came {silent_s:.1f} s ago"

    def close(self) -> None:
        """Close both sockets, with a linger of 0.2 s for a final bye."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)
        self._socket.close(linger=CLOSE_LINGER_MS if self.is_up else 0)
        self._context.term()
