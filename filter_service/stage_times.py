"""Times of a frame's stages."""

from __future__ import annotations

import time


class StageTimes:
    """Wall times of the named stages of one frame.

    Whoever begins the frame creates it, and all that filter the frame add to it.

    Attributes
    ----------
    ms : dict
        Time of each stage, without the stages within it.
    """

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}
        self._ended_ms = 0.0  # total of the stages, to subtract those within a stage

    def add(self, name: str, elapsed_ms: float) -> None:
        """Add to the time of a stage."""
        self.ms[name] = self.ms.get(name, 0.0) + elapsed_ms

    def wall(self, name: str) -> _Wall:
        """Return a context manager that adds its wall time to a stage."""
        return _Wall(self, name)


class _Wall:
    """Context manager for wall time; a generator takes four times as long."""

    def __init__(self, times: StageTimes, name: str) -> None:
        self._times, self._name = times, name

    def __enter__(self) -> None:
        self._before_ms = self._times._ended_ms
        self._started_s = time.perf_counter()

    def __exit__(self, *raised: object) -> None:
        elapsed_ms = 1e3 * (time.perf_counter() - self._started_s)
        within_ms = self._times._ended_ms - self._before_ms
        self._times.add(self._name, elapsed_ms - within_ms)
        self._times._ended_ms = self._before_ms + elapsed_ms
