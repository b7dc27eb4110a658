"""HTTP connections with a request timeout and a limited number.

uvicorn itself does not limit the time to receive a request's head, nor, with httptools,
its size.
"""

from __future__ import annotations

import asyncio
import itertools

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_HEAD_BYTES = 32_768
"""Size limit of a request line with its headers, for `uvicorn.Config`."""

_WATCH_NUMBERS = itertools.count()  # the clock of uvloop has milliseconds only


class BoundedConnection(H11Protocol):
    """uvicorn's HTTP/1.1 connection, with limits.

    Attributes
    ----------
    head_s : float
        Time limit for receiving the head of the next request.
    max_connections : int
        Maximum number of concurrent connections, including websockets; a page takes up
        to 8.  Beyond it, a connection that awaits a request is closed: first those that
        have not sent one yet, then idle ones, the oldest first.  If there is none, the
        new connection is closed.
    """

    head_s = 10.0
    max_connections = 256
    _deadline: asyncio.TimerHandle | None = None
    _watch_number = 0

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Accept the connection; close one that is silent if there are too many."""
        super().connection_made(transport)
        if len(self.connections) > self.max_connections:
            waiting = [c for c in self.connections if isinstance(c, BoundedConnection)]
            silent = min(waiting, key=lambda c: c._silence)
            self.connections.discard(silent)  # it is closed later
            silent._stop_watching()
            silent.transport.abort()
            if silent is self:
                return
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Process a part of a request."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timer."""
        self._stop_watching()
        super().connection_lost(exc)

    @property
    def _silence(self) -> tuple[bool, bool, int]:
        """Return a key by which to sort connections: the one to close comes first."""
        return self._deadline is None, self.cycle is not None, self._watch_number

    def _watch(self) -> None:
        """Start the timer while a request is awaited, stop it while one is handled."""
        is_awaited = self.cycle is None or self.cycle.response_complete
        if not is_awaited or self.transport.get_protocol() is not self:
            self._stop_watching()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(self.head_s, self.transport.abort)
            self._watch_number = next(_WATCH_NUMBERS)

    def _stop_watching(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
