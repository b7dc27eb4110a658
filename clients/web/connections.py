"""HTTP connections with a request timeout and a limited number.

uvicorn itself does not limit the time to receive a request's head, nor, with httptools,
its size.
"""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_HEAD_BYTES = 32_768
"""Size limit of a request line with its headers, for `uvicorn.Config`."""


class BoundedConnection(H11Protocol):
    """uvicorn's HTTP/1.1 connection, with limits.

    Attributes
    ----------
    head_s : float
        Time limit for receiving the head of the next request.
    max_connections : int
        Maximum number of concurrent connections, including websockets; a page takes up
        to 8.
    """

    head_s = 10.0
    max_connections = 256
    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Accept the connection, unless there are too many."""
        super().connection_made(transport)
        if len(self.connections) > self.max_connections:
            transport.abort()
        else:
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

    def _watch(self) -> None:
        """Start the timer while a request is awaited, stop it while one is handled."""
        is_awaited = self.cycle is None or self.cycle.response_complete
        if not is_awaited or self.transport.get_protocol() is not self:
            self._stop_watching()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(self.head_s, self.transport.abort)

    def _stop_watching(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
