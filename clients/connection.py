"""DEALER socket to the service, with connection state and zero-copy sends.

This module handles message parts; `link` implements the protocol.
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
from filter_service.waiting import Wait

READABLE = int(zmq.POLLIN)
NO_WAIT, NO_WAIT_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)
COPY_BELOW_BYTES = 65536  # pyzmq always copies smaller parts
MAX_BUFFERS_PER_SIZE = 8
HEARTBEAT_INTERVAL_MS = 500
HEARTBEAT_TIMEOUT_MS = 2000
RECONNECT_INTERVAL_MS = 50
RECONNECT_MAX_MS = 1000
CLOSE_LINGER_MS = 200
MAX_BROKEN_HANDSHAKES = 5
SEND_HIGH_WATER_MARK = 64
# The credit limits the number of results.  While a program does not read, only
# heartbeats accumulate, one every 5 s; beyond the mark the connection counts as lost.
RECEIVE_HIGH_WATER_MARK = 100_000

_UP = zmq.EVENT_HANDSHAKE_SUCCEEDED
_DOWN = zmq.EVENT_DISCONNECTED
_HANDSHAKE_FAILED = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)


class SendBuffer:
    """Buffer that an image is copied to and sent from.

    A buffer is free again only when its tracker is done.  Writing to an array right
    after a zero-copy send corrupted 2 of 100 frames at the receiver.
    """

    def __init__(self, size_bytes: int) -> None:
        self.memory = np.empty(size_bytes, dtype=np.uint8)
        self.tracker: zmq.MessageTracker | None = None
        self.is_held = False

    @property
    def is_free(self) -> bool:
        """Return whether the buffer can be reused."""
        if self.is_held:
            return False
        return self.tracker is None or self.tracker.done


class SendBufferPool:
    """Pool of send buffers by size, which releases sizes that are no longer used."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._buffers: dict[int, list[SendBuffer]] = {}

    def copy_in(self, image: NDArray[Any]) -> tuple[SendBuffer, NDArray[Any]]:
        """Copy an image to a buffer; return the buffer and the array in it."""
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
        """Wait for the oldest sent buffer; return None if none has been sent."""
        for buffer in buffers:
            if not buffer.is_held and buffer.tracker is not None:
                try:
                    with Wait("Waiting for the service"):
                        buffer.tracker.wait(self._timeout_s)
                except zmq.NotDone:
                    raise ServiceTimeout(
                        f"{len(buffers)} images of {buffer.memory.nbytes} bytes were "
                        f"not accepted by the service within {self._timeout_s:g} s"
                    ) from None
                return buffer
        return None

    def _forget_other_sizes(self, size_bytes: int) -> None:
        """Release unused sizes if there are many, after changes of the camera."""
        for other in [size for size in self._buffers if size != size_bytes]:
            if len(self._buffers) > 8 and all(b.is_free for b in self._buffers[other]):
                del self._buffers[other]


class Connection:
    """DEALER socket that tracks whether the service is connected.

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
        self._has_changed = False
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
                f"endpoint is {endpoint!r} ({error}); expected a form such as "
                "tcp://127.0.0.1:5577"
            ) from None

    def _set_options(self) -> None:
        socket = self._socket
        socket.linger = 0
        # Frames queued for an absent service would be outdated.
        socket.immediate = True
        socket.sndhwm = SEND_HIGH_WATER_MARK
        socket.rcvhwm = RECEIVE_HIGH_WATER_MARK
        socket.reconnect_ivl = RECONNECT_INTERVAL_MS
        socket.reconnect_ivl_max = RECONNECT_MAX_MS
        # Heartbeats detect a stopped service, but not a hung render worker (see ping).
        socket.heartbeat_ivl = HEARTBEAT_INTERVAL_MS
        socket.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS

    def wait(self, timeout_s: float) -> None:
        """Wait for a message or a connection change, or until the timeout."""
        events = self._poller.poll(max(0, round(timeout_s * 1000)))
        self._has_changed = any(item is self._monitor for item, _ in events)

    @staticmethod
    def _has_message(socket: zmq.Socket[bytes]) -> bool:
        """Return whether a message can be received, much faster than by `recv`."""
        return bool(int(socket.get(zmq.EVENTS)) & READABLE)

    def changes(self) -> list[bool]:
        """Return the connection changes before the last wait; True means connected."""
        changes: list[bool] = []
        if not self._has_changed:
            return changes
        while self._has_message(self._monitor):
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
                # A failure without a reason means a wrong key, or that a service under
                # attack closed the connection.
                self._n_broken_handshakes += (
                    kind == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
                )
                self.has_failed_handshake = (
                    kind != zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
                    or self._n_broken_handshakes >= MAX_BROKEN_HANDSHAKES
                )
                self.state = f"the service rejected the handshake ({event['value']})"
        return changes

    def receive(self) -> list[zmq.Frame] | None:
        """Return the parts of one received message, or None."""
        if not self._has_message(self._socket):
            return None
        parts = self._socket.recv_multipart(zmq.NOBLOCK, copy=False)
        self.last_message_s = time.monotonic()
        self.n_bytes_received += sum(len(part) for part in parts)
        return parts

    def send(self, parts: Sequence[Any], buffers: Sequence[SendBuffer] = ()) -> bool:
        """Send a message; return False if the connection cannot accept it now.

        Parameters
        ----------
        parts : sequence
            Parts of the message.
        buffers : sequence of SendBuffer
            Buffers of ``parts[1:]``, in order, which receive the trackers.
        """
        last = len(parts) - 1
        for i, part in enumerate(parts):
            flags = NO_WAIT_MORE if i < last else NO_WAIT
            n_bytes = memoryview(part).nbytes
            is_large = n_bytes >= COPY_BELOW_BYTES
            try:
                tracker = self._socket.send(
                    part, flags, copy=not is_large, track=is_large
                )
            except zmq.Again:
                if i == 0:
                    return False
                # The connection was lost within the message.  libzmq discards the rest
                # up to the last part, so the remaining parts must still be sent.  The
                # message counts as sent and is lost with the connection.
                continue
            self.n_bytes_sent += n_bytes
            if is_large and i > 0 and i - 1 < len(buffers):
                buffers[i - 1].tracker = tracker
        return True

    def describe(self) -> str:
        """Describe the state of the connection, for error messages."""
        if self.last_message_s is None:
            return f"{self.state}; no message was received"
        silent_s = time.monotonic() - self.last_message_s
        return f"{self.state}; the last message arrived {silent_s:.1f} s ago"

    def close(self) -> None:
        """Close the sockets; wait up to 0.2 s for the final bye to be sent."""
        self._socket.disable_monitor()
        self._monitor.close(linger=0)
        self._socket.close(linger=CLOSE_LINGER_MS if self.is_up else 0)
        self._context.term()
