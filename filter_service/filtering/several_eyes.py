"""A frame whose views use different eyes.

eyes = {
"left": EyeFilter("myopia", left_camera),
"right": EyeFilter("keratoconus", right_camera),
}
states = [ViewState("left"), ViewState("right", gaze_deg=(3.0, 0.0))]
planned = plan_views(eyes.__getitem__, [left, right], states, ...)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from filter_service.errors import BadMessage, NoProfile, SessionError
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.planned_frame import PlannedFrame, PlannedView
from filter_service.filtering.stream_eyes import Preparing
from filter_service.rgbd_view import RgbdView
from filter_service.texture_view import TextureView
from filter_service.view_state import EyeName, State, ViewState, check_states


def plan_views(
    filter_of: Callable[[EyeName], EyeFilter | None],
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
        Returns the filter of an eye.
    views : sequence of RgbdView or TextureView
    states : sequence of ViewState, one for each view
        Values that are None default to those of the frame.
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
