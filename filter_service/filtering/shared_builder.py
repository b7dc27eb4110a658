"""Engines, and builders that the filters of a process share, one for each setting."""

from __future__ import annotations

import atexit
import logging
import threading
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from multiprocessing import current_process
from typing import TYPE_CHECKING, Any

from estimator.threads import call_after_fork
from filter_service.building.jobs import BuildLimits, default_cache_dir
from filter_service.building.worker_handle import InlineWorker, WorkerHandle
from filter_service.constants import ENGINES
from filter_service.errors import BadMessage, RenderFailed
from filter_service.filtering.builder import Builder
from filter_service.gl_device import is_device_selected, may_have_gpu
from filter_service.settings import Engine

if TYPE_CHECKING:
    from filter_service.gl.current_context import CurrentContext

GL_CONTEXTS = ("own", "current")

KEEP_S = 10.0
"""Time for which the worker process stays after the last filter was closed, for
programs that open a filter for each eye in turn."""

log = logging.getLogger("ocufilter")


def open_builder(
    worker: WorkerHandle | InlineWorker,
    limits: BuildLimits,
    closing: ExitStack,
    *,
    engine: str = "auto",
    current: CurrentContext | None = None,
) -> Builder:
    """Start the build worker and the engine at the same time.

    Parameters
    ----------
    worker : WorkerHandle or InlineWorker
    limits : BuildLimits
    closing : ExitStack
        Closes both.
    engine : "auto", "gl" or "native"
        Engine that filters frames.
    current : CurrentContext, optional
        Context of the caller for the engine gl, instead of an own one.

    Raises
    ------
    RenderError
        If no engine works on this machine; the message names what to install.
    """
    closing.callback(worker.close)
    worker.start()
    chosen = open_engine(engine, closing, warm_up=True, current=current)
    # mypy checks here that the engine implements `FrameEngine`.
    builder = Builder(worker, chosen.engine, limits, engine_name=chosen.name)
    closing.callback(builder.close)
    return builder


def open_inline_builder(closing: ExitStack, *, engine: str = "auto") -> Builder:
    """Open a builder that estimates eyes in the calling thread.

    For programs that filter one image: starting a worker process would take longer.

    Raises
    ------
    RenderError
        If no engine works on this machine; the message names what to install.
    """
    return open_builder(InlineWorker(), BuildLimits(), closing, engine=engine)


@dataclass(frozen=True)
class ChosenEngine:
    """An open frame engine.

    Attributes
    ----------
    name : "gl" or "native"
    engine : FrameEngine
    reason : str
        Reason for the choice, a phrase.
    """

    name: str
    engine: Any
    reason: str


def open_engine(
    choice: str,
    closing: ExitStack,
    *,
    warm_up: bool = False,
    current: CurrentContext | None = None,
) -> ChosenEngine:
    """Open a frame engine.

    Parameters
    ----------
    choice : "auto", "gl" or "native"
        "auto" selects gl on a hardware GPU or for a selected device, otherwise native.
    closing : ExitStack
        Closes the engine.
    warm_up : bool
        Whether to compile shaders now instead of in the first frames.
    current : CurrentContext, optional
        Context of the caller for the engine gl, which is then chosen.

    Raises
    ------
    ValueError
        For an unknown choice.
    RenderFailed
        If the engine does not work on this machine; the message says what to install.
    """
    if choice not in ENGINES:
        raise ValueError(f"unknown engine {choice!r}; allowed: {', '.join(ENGINES)}")
    if current is not None:
        return _gl(closing, "in the caller's context", warm_up=warm_up, current=current)
    if choice == "native":
        return _native(closing, "as requested")
    if choice == "gl":
        return _gl(closing, "as requested", warm_up=warm_up)
    if is_device_selected():
        return _gl(closing, "a device is selected", warm_up=warm_up)
    return _automatic(closing, warm_up=warm_up)


def _automatic(closing: ExitStack, *, warm_up: bool) -> ChosenEngine:
    if not may_have_gpu():
        return _native(closing, "no GPU on this machine")
    with ExitStack() as own:
        try:
            found = _gl(own, "a hardware GPU", warm_up=warm_up, hardware_only=True)
        except RenderFailed as error:
            return _native(closing, f"no GPU: {error}")
        closing.push(own.pop_all())
    return found


def _native(closing: ExitStack, reason: str) -> ChosenEngine:
    from filter_service.rendering.native.renderer import NativeLanes

    lanes = NativeLanes()
    closing.callback(lanes.close)
    return ChosenEngine("native", lanes, reason)


def _gl(
    closing: ExitStack,
    reason: str,
    *,
    warm_up: bool,
    hardware_only: bool = False,
    current: CurrentContext | None = None,
) -> ChosenEngine:
    from filter_service.gl.gpu import Gpu
    from filter_service.rendering.gl.renderer import FilterRenderer, compile_passes

    gpu = Gpu(current=current)
    closing.callback(gpu.close)
    if hardware_only and gpu.is_software:
        raise RenderFailed(f"{gpu.info['renderer']} is a software renderer")
    renderer = FilterRenderer(gpu)
    if warm_up:
        compile_passes(renderer)
    return ChosenEngine("gl", renderer, reason)


class SharedBuilder:
    """A reference-counted builder.

    Parameters
    ----------
    engine : str
    context : int
        Address of the caller's context that it belongs to; 0 for an own one.
    has_worker : bool
        Whether a worker process estimates eyes, or the thread that waits for them.
    """

    def __init__(
        self, engine: str, context: int = 0, *, has_worker: bool = True
    ) -> None:
        self._engine, self.context = engine, context
        self._has_worker = has_worker
        self._builder: Builder | None = None
        self._closing = ExitStack()
        self._n_users = 0
        atexit.register(self._closing.close)

    def acquire(self, current: CurrentContext | None = None) -> Builder:
        """Return the builder and add a reference; the first reference opens it."""
        if self._builder is None:
            limits = BuildLimits(store_cache_dir=default_cache_dir())
            worker = WorkerHandle(keep_s=KEEP_S) if self._has_worker else InlineWorker()
            with ExitStack() as closing:
                self._builder = open_builder(
                    *(worker, limits, closing), engine=self._engine, current=current
                )
                self._closing.push(closing.pop_all())
            if self._has_worker:
                preload()  # while it estimates the first eye
        self._n_users += 1
        return self._builder

    def release(self) -> None:
        """Remove a reference; removing the last one closes the builder."""
        self._n_users -= 1
        if self._n_users == 0:
            self._builder = None
            self._closing.close()

    def abandon(self) -> None:
        """Abandon the builder in a forked process: the worker belongs to the parent."""
        self._parents = self._closing.pop_all()  # a reference, so that nothing is freed


_opened: list[SharedBuilder] = []


@cache
def shared(engine: str, context: int = 0, *, has_worker: bool = True) -> SharedBuilder:
    """Return the shared builder of an engine setting and a context of the caller."""
    _opened.append(SharedBuilder(engine, context, has_worker=has_worker))
    return _opened[-1]


def acquired(
    engine: Engine, gl_context: str, *, worker: bool | None = None
) -> tuple[Builder, SharedBuilder]:
    """Return the shared builder of an engine and a context, with a reference.

    By default it has a worker process, unless this process must not have children.
    """
    if worker is None:
        worker = not current_process().daemon
    if gl_context not in GL_CONTEXTS:
        raise BadMessage(
            f"{gl_context!r}", field="gl_context", allowed=" or ".join(GL_CONTEXTS)
        )
    if gl_context == "own":
        found = shared(engine, has_worker=worker)
        return found.acquire(), found
    if engine == "native":
        raise BadMessage(
            "'native'", field="engine", allowed="gl or auto in the current context"
        )
    from filter_service.gl.current_context import CurrentContext

    current = CurrentContext()
    found = shared("gl", current.handle, has_worker=worker)
    return found.acquire(current), found


def _reset_after_fork() -> None:
    """Make a forked process open its own builders."""
    for builders in _opened:
        builders.abandon()
    shared.cache_clear()


call_after_fork(_reset_after_fork)


def preload() -> None:
    """Load the code that frames need, in a thread, before the first frame.

    Imports let other threads run every 5 ms, so the thread hardly delays clients.
    """

    def load() -> None:
        try:
            from estimator.field import traced_eye  # noqa: F401
            from estimator.psf.tables import psf_tables
            from filter_service.rendering import edge_light, frame_kernels  # noqa: F401

            psf_tables()
        except Exception:  # the first frame reports it to the client
            log.exception("could not preload")

    threading.Thread(target=load, name="preload", daemon=True).start()
