"""What every frame engine offers, so that a second fits beside the first."""

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
        """Free what the engine holds of it; once."""


class Rendered(Protocol):
    """What an engine says of one filtered view.

    Attributes
    ----------
    color : (height, width, 3)
        float32 or float16 linear light, or uint8 sRGB.
    stage_times_ms : dict
        By stage; their sum is the time spent in the engine.
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
        """What does the work, as replies and `ocufilter doctor` name it."""

    def trim(self) -> None:
        """Give back memory that frames use again, after a while without any."""

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Have a function called in the middle of frames, where this engine can.

        Not sooner than ``interval_s`` after the last time.  It must not raise; it may
        filter another frame, or have a store taken.  Returns whether it is called.
        """

    def load(self, store: Any) -> LoadedStore:
        """Take a store, whose kernels may all be computed later."""

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
            Memory of the shape and type of the picture, which an engine may use for it.
        until_s : float, optional
            Time of `time.monotonic` after which no more PSFs are computed.

        Raises
        ------
        FilterError
            `BadMessage`, `CameraMismatch` or another `RenderError`.
        NotPrepared
            PSFs that the frame needs were not computed by ``until_s``.
        """


def begin_view(
    engine: FrameEngine, view: RgbdView, handle: Any, **options: Any
) -> Callable[[], Rendered]:
    """Have an engine begin with a view; call what is returned for the answer.

    Where an engine can, other views may be begun between (its ``begin``, with the
    arguments of `FrameEngine.render`); else the view is done at once.
    """
    begin = getattr(engine, "begin", None)
    if begin is not None:
        return cast(Callable[[], Rendered], begin(view, handle, **options))
    seen = engine.render(view, handle, **options)
    return lambda: seen
