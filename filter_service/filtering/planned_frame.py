"""Rendering of a frame whose eye is ready."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from filter_service.filtering.builder import Builder
from filter_service.filtering.filtered import Filtered, ViewResult, summed_times
from filter_service.filtering.stream_eyes import Preparing, RenderPlan, StreamEyes
from filter_service.rendering.engine import Pending, ViewRequest
from filter_service.rendering.filtered_view import summed_counts
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.media_effects import begin_through_media
from filter_service.rgbd_view import RgbdView
from filter_service.settings import DEFAULT_OPTIONS, Output, RenderOptions
from filter_service.view_state import State


@dataclass(frozen=True)
class PlannedFrame:
    """Views of one eye, their states, and the stores that render them."""

    builder: Builder  # the filter may be closed during the frame
    stream: StreamEyes
    plan: RenderPlan
    views: tuple[RgbdView, ...]
    states: tuple[State, ...]

    def render(
        self,
        *,
        output: Output = "srgb8",
        options: RenderOptions = DEFAULT_OPTIONS,
        out: Sequence[NDArray[Any] | None] | None = None,
        until_s: float | None = None,
    ) -> Filtered | Preparing:
        """Filter the frame; `EyeFilter.filter` describes the other parameters.

        Parameters
        ----------
        out : sequence of arrays, optional
            Output arrays that may be used; only the returned arrays are valid.
        until_s : float, optional
            Time of `time.monotonic` after which no more PSFs are computed.

        Returns
        -------
        Filtered or Preparing
            The latter if PSFs were not computed by ``until_s``.

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
        )()

    def begin(
        self,
        *,
        options: RenderOptions = DEFAULT_OPTIONS,
        out: Sequence[NDArray[Any] | None] | None = None,
        **values: Any,
    ) -> Callable[[], Filtered | Preparing]:
        """Start rendering; return a function that waits for the result.

        The parameters are those of `render`.  Frames of other eyes may be started
        before this one is finished.
        """
        plan = self.plan
        arrays = out or [None] * len(self.views)
        started_s = time.monotonic()
        effects = plan.eye.media_effects
        options = plan.eye.settings.frame_options(options)
        begun = [
            begin_through_media(
                self.builder.engine,
                ViewRequest(
                    view,
                    store,
                    state,
                    options=options,
                    out=array,
                    **values,
                ),
                effects,
            )
            for view, store, state, array in zip(
                self.views, plan.stores, self.states, arrays, strict=True
            )
        ]
        return _BegunFrame(self, begun, started_s)

    def finish(
        self, begun: Sequence[Pending], started_s: float
    ) -> Filtered | Preparing:
        """Wait for the views and return the result."""
        rendered = []
        for finish in begun:
            view = finish()
            if isinstance(view, MissingPsfs):
                return Preparing("extending", stage="psfs")
            rendered.append(view)
        self.builder.frame_s = time.monotonic() - started_s
        self.builder.mark_rendered(self.stream, self.plan)
        eye = self.plan.eye
        return Filtered(
            views=tuple(
                ViewResult(
                    view.color, "both", eye.profile_id, eye.generation, view.state
                )
                for view in rendered
            ),
            notes=tuple(
                dict.fromkeys(note for view in rendered for note in view.notes)
            ),
            stage_times_ms=summed_times(view.stage_times_ms for view in rendered),
            **summed_counts(rendered),
        )


class _BegunFrame:
    """A frame in progress: while it exists, the stores of its stream are kept.

    A caller may drop it instead of calling it, as when another eye's frame has failed.
    """

    def __init__(
        self, planned: PlannedFrame, begun: Sequence[Pending], started_s: float
    ) -> None:
        self._planned, self._begun, self._started_s = planned, begun, started_s
        planned.stream.begun.add(self)

    def __call__(self) -> Filtered | Preparing:
        """Wait for the frame."""
        try:
            return self._planned.finish(self._begun, self._started_s)
        finally:
            self._planned.stream.begun.discard(self)
