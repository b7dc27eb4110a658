"""The workshop that all filters of a process share, as long as one of them is open."""

from __future__ import annotations

import atexit
from contextlib import ExitStack

from filter_service.building.jobs import BuildLimits, default_cache_dir
from filter_service.building.worker_handle import WorkerHandle
from filter_service.filtering.workshop import Workshop


def open_workshop(
    worker: WorkerHandle, limits: BuildLimits, closing: ExitStack
) -> Workshop:
    """Start the worker, and the engine while it gets ready; ``closing`` ends both.

    Raises
    ------
    RenderError
        No engine works on this machine; names what to install.
    """
    closing.callback(worker.close)
    worker.start()
    # What takes long to import is imported while the worker process does the same.
    from filter_service.gl.gpu import Gpu
    from filter_service.rendering.gl.compile_passes import compile_passes
    from filter_service.rendering.gl.renderer import FilterRenderer

    gpu = Gpu()
    closing.callback(gpu.close)
    engine = FilterRenderer(gpu)
    compile_passes(engine)
    # Here mypy sees that the renderer is a `FrameEngine`.
    workshop = Workshop(worker, engine, limits)
    closing.callback(workshop.close)
    return workshop


class _Shared:
    """One workshop and how many use it."""

    def __init__(self) -> None:
        self._workshop: Workshop | None = None
        self._closing = ExitStack()
        self._n_users = 0
        atexit.register(self._closing.close)

    def take(self) -> Workshop:
        """Return the workshop, for one more user; the first starts it."""
        if self._workshop is None:
            limits = BuildLimits(store_cache_dir=default_cache_dir())
            with ExitStack() as closing:
                self._workshop = open_workshop(WorkerHandle(), limits, closing)
                self._closing.push(closing.pop_all())
        self._n_users += 1
        return self._workshop

    def give_back(self) -> None:
        """Say that one user is done; the last one closes the workshop."""
        self._n_users -= 1
        if self._n_users == 0:
            self._workshop = None
            self._closing.close()


SHARED = _Shared()
