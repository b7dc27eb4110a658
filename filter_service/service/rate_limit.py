"""Rate limit of a connection, beyond which it is ignored, then closed."""

from __future__ import annotations

import enum

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
