"""Interface of the frame engines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from filter_service.rendering.frame_use import FrameUse
from filter_service.rgbd_view import RgbdView
from filter_service.settings import Accumulation, Output


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


class Rendered(Protocol):
    """Result of an engine for one view.

    Attributes
    ----------
    color : (height, width, 3)
        float32 or float16 linear light, or uint8 sRGB.
    stage_times_ms : dict
        Time by stage; their sum is the time spent in the engine.
    pupil_diameter_mm, focus_dpt, gaze_deg : as used
    """

    @property
    def color(self) -> NDArray[Any]: ...  # noqa: D102
    @property
    def stage_times_ms(self) -> dict[str, float]: ...  # noqa: D102
    @property
    def missing_depth_count(self) -> int: ...  # noqa: D102
    @property
    def clamped_depth_count(self) -> int: ...  # noqa: D102
    @property
    def bad_color_count(self) -> int: ...  # noqa: D102
    @property
    def overflow_count(self) -> int: ...  # noqa: D102
    @property
    def pupil_diameter_mm(self) -> float: ...  # noqa: D102
    @property
    def focus_dpt(self) -> float: ...  # noqa: D102
    @property
    def gaze_deg(self) -> tuple[float, float]: ...  # noqa: D102
    @property
    def notes(self) -> list[str]: ...  # noqa: D102


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

    def render(
        self,
        view: RgbdView,
        handle: Any,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        accumulation: Accumulation = "coverage",
        merge: bool = True,
        render_tolerance: float = 1.0,
        output: Output = "linear",
        gaze_deg: tuple[float, float] | None = None,
        out: NDArray[Any] | None = None,
        until_s: float | None = None,
    ) -> Rendered:
        """Filter one view through the eye of a loaded store.

        Parameters
        ----------
        render_tolerance : float
            0 is exact, 1 leaves no visible difference, more is faster.
        out : array, optional
            Output array of the shape and type of the image; an engine may use it.
        until_s : float, optional
            Deadline on the clock of `time.monotonic`; no PSFs are computed after it.

        Raises
        ------
        FilterError
            `BadMessage`, `CameraMismatch` or another `RenderError`.
        NotPrepared
            Some PSFs that the frame needs were not computed by ``until_s``.
        """


def begin_view(
    engine: FrameEngine, view: RgbdView, handle: Any, **options: Any
) -> Callable[[], Rendered]:
    """Start filtering a view; return a function that waits for the result.

    If the engine has a ``begin`` method (with the arguments of `FrameEngine.render`),
    other views may be started in between; otherwise the view is filtered at once.
    """
    begin = getattr(engine, "begin", None)
    if begin is not None:
        return cast(Callable[[], Rendered], begin(view, handle, **options))
    seen = engine.render(view, handle, **options)
    return lambda: seen
