"""One DEALER socket to the service: connection state, sends without copying.

`filter_client` speaks the protocol over it; this file knows only parts.
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
# Results are bounded by the credit.  What adds up are signs of life, one every 5 s,
# while a program does not read: beyond the mark the connection is taken for dead.
RECEIVE_HIGH_WATER_MARK = 100_000

_UP = zmq.EVENT_HANDSHAKE_SUCCEEDED
_DOWN = zmq.EVENT_DISCONNECTED
_HANDSHAKE_FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)


class SendBuffer:
    """Memory that one image is copied into and sent from.

    Reusing an array right after a send without copying tears frames at the receiver
    (2 of 100 measured): a buffer is free again only when its tracker says so.
    """

    def __init__(self, size_bytes: int) -> None:
        self.memory = np.empty(size_bytes, dtype=np.uint8)
        self.tracker: zmq.MessageTracker | None = None
        self.is_held = False

    @property
    def is_free(self) -> bool:
        """Return whether nobody reads this memory any more."""
        if self.is_held:
            return False
        return self.tracker is None or self.tracker.done


class SendBufferPool:
    """Send buffers by size; a size that is no longer used is let go."""

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
        """Wait until the oldest sent buffer is free; None where all are only held."""
        for buffer in buffers:
            if not buffer.is_held and buffer.tracker is not None:
                try:
                    buffer.tracker.wait(self._timeout_s)
                except zmq.NotDone:
                    raise ServiceTimeout(
                        f"{len(buffers)} images of {buffer.memory.nbytes} bytes were "
                        f"not taken by the service within {self._timeout_s:g} s"
                    ) from None
                return buffer
        return None

    def _forget_other_sizes(self, size_bytes: int) -> None:
        """Let go of sizes of which every buffer is free: the camera has changed."""
        for other in [size for size in self._buffers if size != size_bytes]:
            if len(self._buffers) > 8 and all(b.is_free for b in self._buffers[other]):
                del self._buffers[other]


class Connection:
    """A DEALER socket that knows whether the service is there.

    Parameters
    ----------
    endpoint : str
        As in ``tcp://127.0.0.1:5577`` or ``ipc:///run/user/1000/ocufilter``.
    key : ClientKey, optional
        For a service that wants one.
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
        # Queue nothing for a service that is not there: frames would be stale.
        socket.immediate = True
        socket.sndhwm = SEND_HIGH_WATER_MARK
        socket.rcvhwm = RECEIVE_HIGH_WATER_MARK
        socket.reconnect_ivl = RECONNECT_INTERVAL_MS
        socket.reconnect_ivl_max = RECONNECT_MAX_MS
        # A stopped service is noticed; a hung render loop is not (see ping).
        socket.heartbeat_ivl = HEARTBEAT_INTERVAL_MS
        socket.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS

    def wait(self, timeout_s: float) -> None:
        """Return when a message or a change of the connection is there, or in time."""
        self._poller.poll(max(0, round(timeout_s * 1000)))

    def changes(self) -> list[bool]:
        """Return what the connection did since the last call: True up, False down."""
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
                self.is_up, self.state = False, "connection lost, trying again"
                changes.append(False)
            else:
                # Without a reason it may be a wrong key, or a service under attack
                # that had to close connections.
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
        """Return the parts of one waiting message, or None."""
        try:
            parts = self._socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        self.last_message_s = time.monotonic()
        self.n_bytes_received += sum(len(part) for part in parts)
        return parts

    def send(self, parts: Sequence[Any], buffers: Sequence[SendBuffer] = ()) -> bool:
        """Send parts; return False where the connection cannot take them now.

        ``buffers`` hold the memory of ``parts[1:]``, in order, and get the trackers.
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
                # The connection broke inside the message.  libzmq throws away what
                # follows up to the last part, so the rest must still be handed over;
                # the message counts as sent and is lost with the connection.
                continue
            self.n_bytes_sent += n_bytes
            if is_large and i > 0 and i - 1 < len(buffers):
                buffers[i - 1].tracker = tracker
        return True

    def describe(self) -> str:
        """Return one phrase about the connection, for the texts of errors."""
        if self.last_message_s is None:
            return f"{self.state}; nothing was ever received"
        silent_s = time.monotonic() - self.last_message_s
        return f"{self.state}; the last message came {silent_s:.1f} s ago"

    def close(self) -> None:
        """Close both sockets; a last bye has 0.2 s to get out."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)
        self._socket.close(linger=CLOSE_LINGER_MS if self.is_up else 0)
        self._context.term()
