"""Exponential approach of a value to its target, after a latency."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable


class DelayedApproach:
    """Exponential approach to a target after a latency.

    Parameters
    ----------
    value : float
        Initial value and target.
    latency_s : float
        Delay from a change of the target to the start of the response.
    time_constant_s : callable
        ``time_constant_s(value, target)``, called at the start of each response.
    """

    def __init__(
        self,
        value: float,
        latency_s: float,
        time_constant_s: Callable[[float, float], float],
    ) -> None:
        self._value, self._at_s = value, -math.inf
        self._latency_s = latency_s
        self._time_constant_s = time_constant_s
        self._target, self._tau_s = value, 1.0
        self._pending: deque[tuple[float, float]] = deque()  # start time, target

    def follow(
        self, target: float, at_s: float, latency_s: float | None = None
    ) -> float:
        """Set the target from ``at_s`` on; return the value then.

        Times before the last one are replaced by it.  Targets take effect in the order
        in which they were set.

        Parameters
        ----------
        target, at_s : float
        latency_s : float, optional
            Latency of this change; that of the constructor by default.

        Raises
        ------
        ValueError
            The target or the time is not finite.
        """
        if not math.isfinite(target) or not math.isfinite(at_s):
            raise ValueError(f"target {target} at {at_s} s; allowed: finite numbers")
        at_s = max(at_s, self._at_s)
        value = self.value_at(at_s)
        latest = self._pending[-1][1] if self._pending else self._target
        if target != latest:
            start_s = at_s + (self._latency_s if latency_s is None else latency_s)
            if self._pending:
                start_s = max(start_s, self._pending[-1][0])
            self._pending.append((start_s, target))
            value = self.value_at(at_s)  # in case of zero latency
        return value

    def value_at(self, at_s: float) -> float:
        """Return the value at a time; times before the last one are replaced by it."""
        while self._pending and self._pending[0][0] <= at_s:
            start_s, target = self._pending.popleft()
            self._approach(start_s)
            self._target = target
            self._tau_s = self._time_constant_s(self._value, target)
        self._approach(at_s)
        return self._value

    def hold(self, low: float, high: float) -> None:
        """Clamp the value to limits; a clamped value starts a new response."""
        clamped = min(max(self._value, low), high)
        if clamped != self._value:
            self._value = clamped
            self._tau_s = self._time_constant_s(clamped, self._target)

    def _approach(self, at_s: float) -> None:
        if at_s > self._at_s:
            if math.isfinite(self._at_s):
                share = math.exp(-(at_s - self._at_s) / self._tau_s)
                self._value = self._target + (self._value - self._target) * share
            self._at_s = at_s
