"""Recent load of a device."""

from __future__ import annotations

import math

WINDOW_S = 10.0


class Load:
    """Exponentially decaying sum of the time that a device was busy."""

    def __init__(self) -> None:
        self._busy_s = 0.0
        self._at_s = 0.0

    def add(self, busy_s: float, now_s: float) -> None:
        """Add busy time that ended now."""
        self._busy_s = self._decayed_s(now_s) + busy_s
        self._at_s = now_s

    def busy_ratio(self, now_s: float) -> float:
        """Return the busy share of about the last `WINDOW_S`, 0 to 1."""
        return min(1.0, self._decayed_s(now_s) / WINDOW_S)

    def _decayed_s(self, now_s: float) -> float:
        return self._busy_s * math.exp(min(0.0, self._at_s - now_s) / WINDOW_S)
