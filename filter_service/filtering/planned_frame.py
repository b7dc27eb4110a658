"""Rendering of a frame whose eyes are ready."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from filter_service.filtering.builder import Builder
from filter_service.filtering.filtered import Filtered
from filter_service.filtering.stream_eyes import (
    AcceptedProfile,
    Preparing,
    StreamEyes,
)
from filter_service.rendering.engine import (
    Pending,
    ViewRequest,
    ViewResult,
)
from filter_service.rendering.frame_kernels import MissingPsfs, SampledView
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.media_effects import begin_through_media
from filter_service.rgbd_view import RgbdView
from filter_service.settings import DEFAULT_OPTIONS, Output, RenderOptions
from filter_service.stage_times import StageTimes
from filter_service.texture_view import GlTexture, TextureView
from filter_service.view_state import EyeName, State


@dataclass(frozen=True)
class PlannedView:
    """A view, and the eye, the state and the store that it is rendered with."""

    builder: Builder  # the filter may be closed during the frame
    stream: StreamEyes
    eye: AcceptedProfile
    store: FrameStore
    view: RgbdView | TextureView
    state: State
    name: EyeName

    def begin(self, **values: Any) -> Pending:
        """Start rendering; ``values`` are fields of `ViewRequest`."""
        options = self.eye.settings.frame_options(values.pop("options"))
        request = ViewRequest(
            self.view, self.store, self.state, options=options, **values
        )
        engine, effects = self.builder.engine, self.eye.media_effects
        with self.builder.frame():
            return begin_through_media(engine, request, effects)

    def finish(self, begun: Pending, started_s: float) -> ViewResult | None:
        """Wait for the view; return None if PSFs are missing."""
        with self.builder.turn():
            found = begun()
            if isinstance(found, MissingPsfs):
                return None
            self.builder.mark_rendered(self.stream, self.eye, self.store)
            earlier, camera = found.earlier, self.view.camera
            if earlier is not None:
                self.stream.history.record_sampled(
                    lambda: (SampledView.of_samples(camera, earlier.sampled),),
                    self.state,
                    at_s=started_s,
                )
        return replace(
            found,
            eye=self.name,
            profile_id=self.eye.profile_id,
            generation=self.eye.generation,
        )


@dataclass(frozen=True)
class PlannedFrame:
    """A frame whose eyes are ready: its views, in order."""

    views: tuple[PlannedView, ...]

    def render(
        self,
        *,
        output: Output = "srgb8",
        options: RenderOptions = DEFAULT_OPTIONS,
        out: Sequence[NDArray[Any] | GlTexture | None] | None = None,
        until_s: float | None = None,
        times: StageTimes | None = None,
    ) -> Filtered | Preparing:
        """Filter the frame; start all views before waiting for one.

        Parameters
        ----------
        output, options
            As for `EyeFilter.filter`.
        out : sequence of arrays or GlTexture, optional
            Output arrays that may be used; only the returned arrays are valid.  Views
            in textures require the textures for their images.
        until_s : float, optional
            Time of `time.monotonic` after which no more PSFs are computed.
        times : StageTimes, optional
            Receives the times of the frame's stages.

        Returns
        -------
        Filtered or Preparing
            The latter if PSFs that the frame needs were not computed by ``until_s``.

        Raises
        ------
        RenderError
            If the engine failed.
        """
        return self.begin(
            output=output,
            options=options,
            out=out,
            until_s=until_s,
            times=times or StageTimes(),
            waits=True,
        )()

    def begin(
        self,
        *,
        out: Sequence[NDArray[Any] | GlTexture | None] | None = None,
        **values: Any,
    ) -> Callable[[], Filtered | Preparing]:
        """Start rendering; return a function that waits for the result.

        Other values are fields of `ViewRequest`.
        """
        started_s = time.monotonic()
        outs = out or [None] * len(self.views)
        begun = [
            view.begin(out=own, **values)
            for view, own in zip(self.views, outs, strict=True)
        ]
        return _BegunFrame(self, begun, started_s)


class _BegunFrame:
    """A frame in progress: while it exists, the stores of its streams are kept.

    A caller may drop it instead of calling it.
    """

    def __init__(
        self, planned: PlannedFrame, begun: Sequence[Pending], started_s: float
    ) -> None:
        self._views, self._begun, self._started_s = planned.views, begun, started_s
        for view in self._views:
            view.stream.begun.add(self)

    def __call__(self) -> Filtered | Preparing:
        """Wait for the frame."""
        try:
            found = []
            for view, begun in zip(self._views, self._begun, strict=True):
                result = view.finish(begun, self._started_s)
                if result is None:
                    return Preparing("extending", stage="psfs")
                found.append(result)
            for view in self._views:
                duration_s = time.monotonic() - self._started_s
                view.builder.end_frame(view.stream, duration_s)
            return Filtered.of(found)
        finally:
            for view in self._views:
                view.stream.begun.discard(self)
