"""Two renderers in one thread, so that small frames can interrupt large ones."""

from __future__ import annotations

from collections.abc import Callable

from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import OneView, Pending, ViewRequest
from filter_service.rendering.native.native_store import NativeStore
from filter_service.rendering.native.renderer import NativeRenderer


class NativeLanes(OneView):
    """Reentrant native engine: the callback of `call_between` may use it.

    Everything runs in the caller's thread.  While the callback pauses one renderer, the
    other may filter a frame or load a store.
    """

    def __init__(self) -> None:
        self._main, self._other = NativeRenderer(), NativeRenderer()
        self._is_busy = False

    importer = None

    @property
    def name(self) -> str:
        """Instruction set of the compiled loops, and their number of threads."""
        return self._main.name

    def trim(self) -> None:
        """Release the buffers that frames reuse."""
        self._main.trim()
        self._other.trim()

    def close(self) -> None:
        """Stop the threads; the engine cannot be used afterward."""
        self._main.close()
        self._other.close()

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Register a callback for pauses during frames; it may use this engine."""
        self._main.call_between(function, interval_s)
        return True

    def load(self, store: PsfStore) -> NativeStore:
        """Load a store; its kernels may be computed later."""
        return self._other.load(store)

    def begin(self, request: ViewRequest) -> Pending:
        """Filter one view; see `FrameEngine.begin`."""
        if self._is_busy:
            return self._other.begin(request)
        self._is_busy = True
        try:
            return self._main.begin(request)
        finally:
            self._is_busy = False
