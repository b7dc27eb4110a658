"""Interface of the frame engines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from filter_service.rendering.filtered_view import FilteredView
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.frame_states import FrameStates
from filter_service.rendering.sampled_frame import SampledFrame
from filter_service.rgbd_view import RgbdView
from filter_service.settings import DEFAULT_OPTIONS, Output, RenderOptions
from filter_service.texture_view import (
    EarlierFrame,
    GlTexture,
    TextureMemory,
    TextureSupport,
    TextureView,
)
from filter_service.view_state import State


class LoadedStore(Protocol):
    """A PSF store that an engine can filter frames with; see `FrameStore`."""

    @property
    def computed_count(self) -> int: ...  # noqa: D102
    @property
    def memory_mb(self) -> float: ...  # noqa: D102

    def missing_psfs(  # noqa: D102
        self,
        frame: SampledFrame | None = None,
        *,
        state: State | None = None,
    ) -> NDArray[np.int64]: ...

    def fill(  # noqa: D102
        self, psfs: NDArray[np.int64], *, until_s: float, batch_count: int
    ) -> NDArray[np.int64]: ...

    def evict(self, max_mb: float) -> None: ...  # noqa: D102

    def add_part(self, part: Any) -> None: ...  # noqa: D102

    def release(self) -> None:
        """Free the engine's resources for this store; call it once."""


@dataclass(frozen=True)
class ViewRequest:
    """One view to filter, with the eye, its state and the options.

    Attributes
    ----------
    handle : LoadedStore
        PSFs of the eye, loaded by the engine.
    state : State
        A gaze outside the prepared range is clamped, and the result has a note.
    out : array, optional
        Array of the shape and type of the output, which the engine may fill.
    until_s : float, optional
        Deadline by `time.monotonic`; the engine computes no PSFs after it.
    white_level : float, optional
        White level of the view, if it is known; see `white_level`.
    """

    view: RgbdView
    handle: Any
    state: State
    output: Output = "linear"
    options: RenderOptions = DEFAULT_OPTIONS
    out: NDArray[Any] | None = None
    until_s: float | None = None
    white_level: float | None = None


@dataclass(frozen=True)
class TextureRequest:
    """One view in textures to filter, with the eye, its state and the options.

    Attributes
    ----------
    view : TextureView
    target : GlTexture
        Texture for the filtered image: "rgba8" or "srgb8_a8" for sRGB values, "rgba16f"
        for linear light.
    handle : LoadedStore
        PSFs of the eye, loaded by the engine.
    target_is_top_first : bool
        Whether the first row of the target is the top of the image.
    gain_ratio : (red, green, blue)
        Transmittance of the ocular media.
    waits : bool
        Whether to wait until the frame is finished, and to repeat it until it is
        complete, so that `ShownTexture.earlier` describes this frame.
    until_s : float, optional
        Deadline of a frame that waits, as in `ViewRequest`.
    """

    view: TextureView
    target: GlTexture
    handle: Any
    state: State
    target_is_top_first: bool = False
    gain_ratio: tuple[float, float, float] = (1.0, 1.0, 1.0)
    options: RenderOptions = DEFAULT_OPTIONS
    waits: bool = False
    until_s: float | None = None


@dataclass(frozen=True)
class ShownTexture:
    """State of the eye in a frame of textures, which the GPU may not have finished.

    Attributes
    ----------
    state : State
        After clamping to the prepared ranges.
    number : int
        Number of the frame among those of the context, from 1 on.
    notes : tuple of str
    earlier : EarlierFrame or None
        The newest frame through this eye that the GPU has finished; this frame, if the
        request waits.
    """

    state: State
    number: int
    notes: tuple[str, ...]
    earlier: EarlierFrame | None


Pending = Callable[[], FilteredView | MissingPsfs]
"""Wait for a view that `FrameEngine.begin` has started, and return it, or the PSFs that
were not computed by ``until_s``."""


class FrameEngine(Protocol):
    """Filters views through loaded stores, one at a time; not thread-safe."""

    @property
    def name(self) -> str:
        """Name of the renderer in replies and in `ocufilter doctor`."""

    def trim(self) -> None:
        """Release buffers that frames reuse; called after an idle period."""

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Register a callback for pauses during frames, if the engine has any.

        The engine calls it at most once every ``interval_s``.  The callback must not
        raise; it may filter another frame or load a store.  Returns whether the engine
        will call it.
        """

    def load(self, store: Any) -> LoadedStore:
        """Load a store; its kernels may be computed later."""

    def frame_states(self, handle: Any) -> FrameStates:
        """Return the cached layers and cells of the frames of a loaded store."""

    def begin(self, request: ViewRequest) -> Pending:
        """Start filtering a view; return a function that waits for the result.

        The caller may start other views before it calls that function, such as the
        view of the other eye.  An engine without concurrency filters the view at once.

        Raises
        ------
        BadMessage
            Arrays or options are invalid.
        CameraMismatch
            The store is for another camera, see `camera.is_same_camera`.
        RenderError
        """


@runtime_checkable
class TextureEngine(Protocol):
    """An engine that filters frames in textures of the caller's context."""

    def filter_textures(self, request: TextureRequest) -> ShownTexture | None:
        """Filter a view from textures to a texture, without waiting for the GPU.

        Returns None if the request waits, and PSFs were not computed by ``until_s``.

        Raises
        ------
        BadMessage
            Textures or options are invalid.
        CameraMismatch
            The store is for another camera, see `camera.is_same_camera`.
        RenderError
        """


@runtime_checkable
class TextureImporter(TextureEngine, Protocol):
    """An engine that may import textures from memory of other processes."""

    @property
    def texture_support(self) -> TextureSupport | None:
        """Devices whose memory it can import, or None."""

    def import_texture(self, memory: TextureMemory, descriptor: int) -> Any:
        """Return a texture, with the attribute ``texture``, in memory of a descriptor.

        The descriptor is closed.

        Raises
        ------
        BadMessage
            The memory cannot be used for such a texture.
        RenderError
        """

    def release_texture(self, imported: Any) -> None:
        """Free an imported texture."""


class OneView:
    """Mixin that adds the method `render` to an engine."""

    def render(
        self: FrameEngine, view: RgbdView, handle: Any, **values: Any
    ) -> FilteredView | MissingPsfs:
        """Filter one view; ``values`` are a state, options or fields of the request."""
        state = State(
            values.pop("pupil_diameter_mm"),
            values.pop("focus_dpt"),
            values.pop("gaze_deg", None),
        )
        names = {option.name for option in fields(RenderOptions)}
        options = {name: values.pop(name) for name in names & set(values)}
        request = ViewRequest(
            view, handle, state, options=RenderOptions(**options), **values
        )
        return self.begin(request)()
