"""Recent load of a device."""

from __future__ import annotations

import math

WINDOW_S = 10.0


class Load:
    """Exponentially decaying sum of the time used."""

    def __init__(self) -> None:
        self._used_s = 0.0
        self._at_s = 0.0

    def note(self, used_s: float, now_s: float) -> None:
        """Add time that was used until now."""
        self._used_s = self._left_s(now_s) + used_s
        self._at_s = now_s

    def busy_ratio(self, now_s: float) -> float:
        """Return the used share of the last seconds, 0 to 1."""
        return min(1.0, self._left_s(now_s) / WINDOW_S)

    def _left_s(self, now_s: float) -> float:
        return self._used_s * math.exp(min(0.0, self._at_s - now_s) / WINDOW_S)
