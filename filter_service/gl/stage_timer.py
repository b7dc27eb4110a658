"""Times of a frame's stages, on the GPU and on the CPU."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from filter_service.gl.gpu import Gpu
from filter_service.gl.staging import TimerQuery


class StageTimer:
    """Times of named stages, ms: by timer queries on a GPU, else by the wall clock.

    Waiting for a software renderer after each stage does not slow it down.
    """

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._ms: dict[str, float] = {}
        self._queries: list[tuple[str, TimerQuery]] = []

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Time a GPU stage; the times of equal names are added."""
        if not self._gpu.has_timers:
            return self._finished(name)
        query = self._gpu.acquire_query()
        self._queries.append((name, query))
        return query

    @contextmanager
    def _finished(self, name: str) -> Iterator[None]:
        with self.wall(name):
            yield
            self._gpu.context.finish()

    def wall(self, name: str) -> AbstractContextManager[None]:
        """Time a CPU stage."""
        return _Wall(self._ms, name)

    def result_ms(self) -> dict[str, float]:
        """Wait for the GPU, and return the times by stage."""
        for name, query in self._queries:
            self._ms[name] = self._ms.get(name, 0.0) + query.elapsed_ns / 1e6
        self._gpu.release_queries([query for _, query in self._queries])
        self._queries.clear()
        return dict(self._ms)


class Untimed:
    """A stage timer that measures nothing, for frames that are never waited for."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Return a context manager that does nothing."""
        return nullcontext()

    wall = stage

    def result_ms(self) -> dict[str, float]:
        """Return no times."""
        return {}


class _Wall:
    """Context manager for wall time; a generator takes four times as long."""

    def __init__(self, times_ms: dict[str, float], name: str):
        self._times_ms, self._name = times_ms, name

    def __enter__(self) -> None:
        self._started_s = time.perf_counter()

    def __exit__(self, *raised: object) -> None:
        elapsed_ms = 1e3 * (time.perf_counter() - self._started_s)
        self._times_ms[self._name] = self._times_ms.get(self._name, 0.0) + elapsed_ms


Timer = StageTimer | Untimed
