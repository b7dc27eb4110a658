"""A connection that cannot wait forever for a request, one of a limited number.

uvicorn's own has no limit on the time that a request's head takes, and with httptools
none on its size.
"""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_HEAD_BYTES = 32_768
"""Of a request line with its headers; for `uvicorn.Config`."""


class BoundedConnection(H11Protocol):
    """HTTP/1.1, as uvicorn speaks it, with limits.

    Attributes
    ----------
    head_s : float
        Until the head of the next request is whole.
    most : int
        Connections at the same time, websockets included; a page takes up to 8.
    """

    head_s = 10.0
    most = 256
    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Begin, unless there are too many."""
        super().connection_made(transport)
        if len(self.connections) > self.most:
            transport.abort()
        else:
            self._watch()

    def data_received(self, data: bytes) -> None:
        """Take in a part of a request."""
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._stop_watching()
        super().connection_lost(exc)

    def _watch(self) -> None:
        """Start the clock where a request is awaited, stop it where one is answered."""
        is_awaited = self.cycle is None or self.cycle.response_complete
        if not is_awaited or self.transport.get_protocol() is not self:
            self._stop_watching()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(self.head_s, self.transport.abort)

    def _stop_watching(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
