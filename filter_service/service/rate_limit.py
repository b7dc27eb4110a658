"""How many messages a connection may send before it is not answered, or closed."""

from __future__ import annotations

import enum

WINDOW_S = 1.0
MAX_REFUSALS = 100
"""Wrong messages of a connection within a window; the rest of it is not answered."""

MAX_REQUESTS = 200
"""Messages that are no frames, likewise: each takes about 0.1 ms of the front end."""

MAX_IGNORED = 400
"""Messages within a window that nobody answers any more; then the connection ends.
To take one from the socket and throw it away costs about 0.01 ms."""


class Verdict(enum.Enum):
    """What becomes of the next message of a connection."""

    HANDLE = "handle"
    IGNORE = "ignore"
    CLOSE = "close"


class RateLimit:
    """Counts the messages of one connection in windows of a second."""

    def __init__(self) -> None:
        self._ends_s = 0.0
        self._n_refusals = self._n_requests = self._n_ignored = 0

    def verdict(self, now_s: float) -> Verdict:
        """Return whether the next message is to be handled."""
        if now_s >= self._ends_s:
            self._ends_s = now_s + WINDOW_S
            self._n_refusals = self._n_requests = self._n_ignored = 0
        if self._n_refusals < MAX_REFUSALS and self._n_requests < MAX_REQUESTS:
            return Verdict.HANDLE
        self._n_ignored += 1
        return Verdict.IGNORE if self._n_ignored <= MAX_IGNORED else Verdict.CLOSE

    def end_patience(self) -> None:
        """Have the next message within the window end the connection."""
        self._n_refusals, self._n_ignored = MAX_REFUSALS, MAX_IGNORED

    def note_refusal(self) -> None:
        """Count a message that was wrong, or that another process refused."""
        self._n_refusals += 1

    def note_request(self) -> None:
        """Count a message that is no frame."""
        self._n_requests += 1
