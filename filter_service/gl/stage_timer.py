"""Times of a frame's stages, on the GPU and on the processor."""

import time
from contextlib import contextmanager

from filter_service.gl.gpu import Gpu, Query


class StageTimer:
    """Times of named stages, ms: GPU queries on hardware, wall clock on software.

    A software renderer works inside the call, so waiting for it costs nothing there.
    """

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._ms: dict[str, float] = {}
        self._queries: list[tuple[str, Query]] = []

    @contextmanager
    def stage(self, name: str):
        """Time a GPU stage; entering a name twice adds up."""
        if self._gpu.is_software:
            with self.wall(name):
                yield
                self._gpu.context.finish()
            return
        query = self._gpu.take_query()
        with query:
            yield
        self._queries.append((name, query))

    @contextmanager
    def wall(self, name: str):
        """Time a CPU stage."""
        started_s = time.perf_counter()
        yield
        elapsed_ms = 1e3 * (time.perf_counter() - started_s)
        self._ms[name] = self._ms.get(name, 0.0) + elapsed_ms

    def result_ms(self) -> dict[str, float]:
        """Return times by stage; waits for the GPU."""
        for name, query in self._queries:
            self._ms[name] = self._ms.get(name, 0.0) + query.elapsed / 1e6
        self._gpu.give_queries([query for _, query in self._queries])
        self._queries.clear()
        return dict(self._ms)
