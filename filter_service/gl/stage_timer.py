"""Times of a frame's stages, on the GPU and on the CPU."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from filter_service.gl.gpu import Gpu
from filter_service.gl.staging import TimerQuery
from filter_service.stage_times import StageTimes


class StageTimer:
    """Times of named stages, ms: by timer queries on a GPU, else by the wall clock.

    Waiting for a software renderer after each stage does not slow it down.
    """

    def __init__(self, gpu: Gpu, times: StageTimes | None = None):
        self._gpu = gpu
        self._times = times or StageTimes()
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
        return self._times.wall(name)

    def result_ms(self) -> dict[str, float]:
        """Wait for the GPU, and return the times by stage."""
        for name, query in self._queries:
            self._times.add(name, query.elapsed_ns / 1e6)
        self._gpu.release_queries([query for _, query in self._queries])
        self._queries.clear()
        return self._times.ms


class Untimed:
    """A stage timer that measures nothing, for frames that are never waited for."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Return a context manager that does nothing."""
        return nullcontext()

    wall = stage

    def result_ms(self) -> dict[str, float]:
        """Return no times."""
        return {}


Timer = StageTimer | Untimed
