"""Two renderers on one processor: small frames come between parts of large ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from filter_service.psfs.store import PsfStore
from filter_service.rendering.filtered_view import FilteredView
from filter_service.rendering.native.native_store import NativeStore
from filter_service.rendering.native.renderer import NativeRenderer
from filter_service.rgbd_view import RgbdView


class NativeLanes:
    """The native engine of a service: what `call_between` calls may use it again.

    Everything happens in the caller's thread: while one renderer rests, another may
    filter a frame or take a store.
    """

    def __init__(self) -> None:
        self._main, self._other = NativeRenderer(), NativeRenderer()
        self._is_busy = False

    @property
    def name(self) -> str:
        """What the loops are compiled for, and on how many threads they run."""
        return self._main.name

    @property
    def memory_mb(self) -> float:
        """Memory that frames use again."""
        return self._main.memory_mb + self._other.memory_mb

    def trim(self) -> None:
        """Give back the memory that frames use again."""
        self._main.trim()
        self._other.trim()

    def close(self) -> None:
        """End the threads; the engine is of no use after."""
        self._main.close()
        self._other.close()

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Have a function called while frames are filtered; it may filter another."""
        self._main.call_between(function, interval_s)
        return True

    def load(self, store: PsfStore) -> NativeStore:
        """Take a store, whose kernels may all be computed later."""
        return self._other.load(store)

    def render(
        self, view: RgbdView, handle: NativeStore, **options: Any
    ) -> FilteredView:
        """Filter one view; see `NativeRenderer.render`."""
        if self._is_busy:
            return self._other.render(view, handle, **options)
        self._is_busy = True
        try:
            return self._main.render(view, handle, **options)
        finally:
            self._is_busy = False
