"""Interface of the frame engines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from filter_service.rendering.filtered_view import FilteredView
from filter_service.rendering.frame_use import FrameUse
from filter_service.rgbd_view import RgbdView
from filter_service.settings import DEFAULT_OPTIONS, Output, RenderOptions


class LoadedStore(Protocol):
    """A PSF store that an engine can filter frames with; see `FrameStore`."""

    @property
    def computed_count(self) -> int: ...  # noqa: D102
    @property
    def memory_mb(self) -> float: ...  # noqa: D102

    def missing_psfs(  # noqa: D102
        self,
        use: FrameUse | None = None,
        *,
        state: tuple[float, float] | None = None,
    ) -> NDArray[np.int64]: ...

    def fill(  # noqa: D102
        self, psfs: NDArray[np.int64], *, until_s: float, batch_count: int
    ) -> None: ...

    def evict(self, max_mb: float) -> None: ...  # noqa: D102

    def take(self, part: Any) -> None: ...  # noqa: D102

    def release(self) -> None:
        """Free the engine's resources for this store; call it once."""


@dataclass(frozen=True)
class ViewRequest:
    """One view to filter: what is seen, through which eye in which state, and how.

    Attributes
    ----------
    handle : LoadedStore
        PSFs of the eye, loaded by the engine.
    gaze_deg : (h, v), optional
        Gaze in the image, clamped to the prepared range with a note; the store's by
        default.
    out : array, optional
        Output array of the shape and type of the image; an engine may use it.
    until_s : float, optional
        Deadline on the clock of `time.monotonic`; no PSFs are computed after it.
    """

    view: RgbdView
    handle: Any
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float] | None = None
    output: Output = "linear"
    options: RenderOptions = DEFAULT_OPTIONS
    out: NDArray[Any] | None = None
    until_s: float | None = None


Pending = Callable[[], FilteredView]
"""Waits for a view that was begun, and returns it."""


class FrameEngine(Protocol):
    """Filters views through loaded stores, one at a time; not thread-safe."""

    @property
    def name(self) -> str:
        """Name of the renderer in replies and in `ocufilter doctor`."""

    def trim(self) -> None:
        """Release buffers that frames reuse; called after an idle period."""

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Register a function to be called during frames, if this engine can.

        The engine calls it at most once every ``interval_s``.  The function must not
        raise; it may filter another frame or load a store.  Returns whether the engine
        will call it.
        """

    def load(self, store: Any) -> LoadedStore:
        """Load a store; its kernels may all be computed later."""

    def begin(self, request: ViewRequest) -> Pending:
        """Start filtering a view; return a function that waits for the result.

        Other views may be begun in between, such as that of the other eye.  An engine
        without concurrency filters the view at once.

        Raises
        ------
        BadMessage
            Arrays or options are invalid.
        CameraMismatch
            The store is for another camera, see `camera.is_same_camera`.
        NotPrepared
            Some PSFs that the frame needs were not computed by ``until_s``; the
            returned function may raise it, too.
        RenderError
        """


class OneView:
    """Adds `render`, which takes the fields of a request by name, to an engine."""

    def render(
        self: FrameEngine, view: RgbdView, handle: Any, **values: Any
    ) -> FilteredView:
        """Filter one view; options of `RenderOptions` are given by name, too."""
        names = {option.name for option in fields(RenderOptions)}
        options = {name: values.pop(name) for name in names & set(values)}
        request = ViewRequest(view, handle, options=RenderOptions(**options), **values)
        return self.begin(request)()
