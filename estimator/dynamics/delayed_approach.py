"""A value that approaches its target exponentially after a latency."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable


class DelayedApproach:
    """Delayed exponential approach, independent of the sampling rate.

    Parameters
    ----------
    value : float
        Initial value.
    latency_s : float
        Delay from a change of the target to the start of a movement.
    time_constant_s : callable
        ``time_constant_s(value, target)`` of a movement, called when it begins.
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
        self._coming: deque[tuple[float, float]] = deque()  # start time, target

    def follow(
        self, target: float, at_s: float, latency_s: float | None = None
    ) -> float:
        """Set the target from now on; return the current value.

        Time does not run backward: an earlier time counts as the last one, and no
        target takes effect before an earlier one.

        Parameters
        ----------
        target, at_s : float
        latency_s : float, optional
            Latency of this change, if different.
        """
        if not math.isfinite(target) or not math.isfinite(at_s):
            raise ValueError(f"target {target} at {at_s} s; allowed: finite numbers")
        at_s = max(at_s, self._at_s)
        value = self.value_at(at_s)
        newest = self._coming[-1][1] if self._coming else self._target
        if target != newest:
            acts_s = at_s + (self._latency_s if latency_s is None else latency_s)
            if self._coming:
                acts_s = max(acts_s, self._coming[-1][0])
            self._coming.append((acts_s, target))
            value = self.value_at(at_s)  # in case of zero latency
        return value

    def value_at(self, at_s: float) -> float:
        """Return the value at a time, not before the last one."""
        while self._coming and self._coming[0][0] <= at_s:
            acts_s, target = self._coming.popleft()
            self._approach(acts_s)
            self._target = target
            self._tau_s = self._time_constant_s(self._value, target)
        self._approach(at_s)
        return self._value

    def hold(self, low: float, high: float) -> None:
        """Clamp the current value to limits; targets are unchanged.

        A clamped value starts a new movement to the target.
        """
        held = min(max(self._value, low), high)
        if held != self._value:
            self._value = held
            self._tau_s = self._time_constant_s(held, self._target)

    def _approach(self, at_s: float) -> None:
        if at_s > self._at_s:
            if math.isfinite(self._at_s):
                share = math.exp(-(at_s - self._at_s) / self._tau_s)
                self._value = self._target + (self._value - self._target) * share
            self._at_s = at_s
