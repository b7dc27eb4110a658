"""Rendering of a frame whose eyes are ready, and its result.

Views may use different eyes:

eyes = {
"left": EyeFilter("myopia", left_camera),
"right": EyeFilter("keratoconus", right_camera),
}
states = [ViewState("left"), ViewState("right", gaze_deg=(3.0, 0.0))]
planned = plan_views(eyes.__getitem__, [left, right], states, ...)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from numpy.typing import NDArray

from estimator.note import Note
from filter_service.errors import BadMessage, NoProfile, SessionError
from filter_service.filtering.builder import Builder
from filter_service.filtering.stream_eyes import (
    AcceptedProfile,
    Preparing,
    StreamEyes,
)
from filter_service.rendering.engine import (
    FrameCounts,
    Pending,
    ViewRequest,
    ViewResult,
    summed_counts,
)
from filter_service.rendering.frame_kernels import MissingPsfs, SampledView
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.media_effects import begin_through_media
from filter_service.rgbd_view import RgbdView
from filter_service.settings import DEFAULT_OPTIONS, Output, RenderOptions
from filter_service.stage_times import StageTimes
from filter_service.texture_view import EarlierFrame, GlTexture, TextureView
from filter_service.view_state import EyeName, State, ViewState, WithState, check_states


@dataclass(frozen=True, kw_only=True)
class Filtered(FrameCounts, WithState):
    """A filtered frame, and the eyes and states that it was filtered with.

    The properties `color`, `profile_id`, `generation`, `pupil_diameter_mm`, `focus_dpt`
    and `gaze_deg` refer to the first view.

    Attributes
    ----------
    views : tuple of ViewResult
        One for each view of the frame.
    missing_depth_count and the other attributes of `FrameCounts` : int
        Sums over the views.
    notes : tuple of str
        Notes for the user; those about a left or right eye name it.
    stage_times_ms : dict
        Duration of each stage.
    """

    views: tuple[ViewResult, ...]

    @classmethod
    def of(cls, views: Sequence[ViewResult]) -> Self:
        """Return a frame of these views."""
        return cls(views=tuple(views), **summed_counts(views))

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes of all views, each once."""
        by_eye: dict[EyeName, list[str]] = {}
        for view in self.views:
            by_eye.setdefault(view.eye, []).extend(view.notes)
        return tuple(
            note if eye == "both" else _with_prefix(note, f"{eye} eye: ")
            for eye, notes in by_eye.items()
            for note in dict.fromkeys(notes)
        )

    @property
    def stage_times_ms(self) -> dict[str, float]:
        """Return the duration of each stage, of all views."""
        return self.views[0].stage_times_ms

    @property
    def number(self) -> int:
        """Return the number of a frame in textures; see `ViewResult`."""
        return self.views[0].number

    @property
    def earlier(self) -> EarlierFrame | None:
        """Return the results of an earlier frame in textures; see `ViewResult`."""
        return self.views[0].earlier

    @property
    def color(self) -> NDArray[Any]:
        """Return the first view's image, (height, width, 3)."""
        return self.views[0].color

    @property
    def colors(self) -> tuple[NDArray[Any], ...]:
        """Return the images of all views."""
        return tuple(view.color for view in self.views)

    @property
    def state(self) -> State:
        """Return the state used for the first view."""
        return self.views[0].state

    @property
    def profile_id(self) -> int:
        """Return the identifier of the first view's profile."""
        return self.views[0].profile_id

    @property
    def generation(self) -> int:
        """Return the generation of the first view's profile."""
        return self.views[0].generation


def _with_prefix(note: str, prefix: str) -> str:
    return note.with_prefix(prefix) if isinstance(note, Note) else prefix + note


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
        with self.builder.exclusive():
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


def plan_views(
    filter_of: Callable[[EyeName], Any],
    views: Sequence[RgbdView | TextureView],
    states: Sequence[ViewState],
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    gaze_deg: tuple[float, float] | None = None,
) -> PlannedFrame | Preparing:
    """Plan a frame for the eyes of its views; all of them must be ready.

    All eyes are prepared at the same time.

    Parameters
    ----------
    filter_of : callable
        Returns the `EyeFilter` of an eye, or None.
    views : sequence of RgbdView or TextureView
    states : sequence of ViewState, one for each view
        Values that are None default to the frame's values.
    pupil_diameter_mm, focus_dpt, gaze_deg
        Values of the frame, as for `EyeFilter.try_filter`.

    Returns
    -------
    PlannedFrame or Preparing
        The latter, which is false, while an eye is being prepared.

    Raises
    ------
    BadMessage
        If an argument is out of range, or views of one eye have different states.
    SessionError
        If an eye has no profile (field ``views[i].eye``), or its build failed.
    """
    if len(states) != len(views):
        raise BadMessage(
            f"there are {len(states)}",
            field="states",
            allowed=f"{len(views)}, as views",
        )
    of_frame = State(pupil_diameter_mm, focus_dpt, gaze_deg)
    check_states(states, of_frame)
    indices: dict[EyeName, tuple[int, ...]] = {}
    for i, state in enumerate(states):
        indices[state.eye] = (*indices.get(state.eye, ()), i)
    for eye, own in indices.items():
        found = filter_of(eye)
        if found is None:
            raise _with_eye_name(NoProfile("there is no filter"), eye, own[0])
    planned: dict[int, PlannedView] = {}
    own_states = [State.checked(**vars(state.state(of_frame))) for state in states]
    failure: SessionError | None = None
    preparing: Preparing | None = None
    for eye, own in indices.items():
        eye_filter = filter_of(eye)
        assert eye_filter is not None
        try:
            frame = eye_filter.plan(
                [views[i] for i in own], [own_states[i] for i in own], name=eye
            )
        except SessionError as error:
            failure = failure or _with_eye_name(error, eye, own[0])
            continue
        if isinstance(frame, Preparing):
            preparing = frame
        else:
            planned |= zip(own, frame.views, strict=True)
    if failure is not None:
        raise failure.with_traceback(None)
    if preparing is not None:
        return preparing
    return PlannedFrame(tuple(planned[i] for i in range(len(views))))


def _with_eye_name(error: SessionError, eye: EyeName, view: int) -> SessionError:
    """Name the eye in an error about a missing profile."""
    if not isinstance(error, NoProfile):
        return error
    return NoProfile(
        f"the eye {eye} has no profile",
        field=f"views[{view}].eye",
        allowed=error.allowed,
    )
