"""How many wrong messages a client may send before it is not listened to."""

from __future__ import annotations

MAX_REFUSALS = 100
WINDOW_S = 1.0
"""More refusals than that in a window, and the rest of it passes unheard."""

MAX_KNOWN = 10_000


class Patience:
    """Counts refused messages by client; to refuse is dearer than not to listen."""

    def __init__(self) -> None:
        self._counts: dict[bytes, int] = {}
        self._ends_s = 0.0
        self.n_unheard = 0

    def is_over(self, identity: bytes, now_s: float) -> bool:
        """Return whether a client's message is to be thrown away unread."""
        if now_s >= self._ends_s:
            self._counts.clear()
            self._ends_s = now_s + WINDOW_S
        is_over = self._counts.get(identity, 0) >= MAX_REFUSALS
        self.n_unheard += is_over
        return is_over

    def note(self, identity: bytes) -> None:
        """Note that a message was refused."""
        if identity in self._counts or len(self._counts) < MAX_KNOWN:
            self._counts[identity] = self._counts.get(identity, 0) + 1
