"""The eye that a view is filtered for, and its state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from msgspec import Meta

from filter_service.errors import BadMessage
from filter_service.settings import GazeDeg, PupilMm, VergenceDpt
from filter_service.validation import Record

EyeName = Literal["both", "left", "right"]
EYE_NAMES: tuple[EyeName, ...] = get_args(EyeName)
"""`both` is one eye for all views; `left` and `right` have separate profiles."""


def body_of_eye(body: Mapping[str, Any], eye: EyeName) -> dict[str, Any]:
    """Return a profile's body for an eye.

    The left eye gets ``eye_side`` "OS", unless the body sets the side.
    """
    return ({"eye_side": "OS"} if eye == "left" else {}) | dict(body)


PoseNumber = Annotated[float, Meta(ge=-1e9, le=1e9)]
Pose = tuple[
    PoseNumber,
    PoseNumber,
    PoseNumber,
    PoseNumber,
    PoseNumber,
    PoseNumber,
    PoseNumber,
]
"""Position x, y, z in meters and orientation x, y, z, w, as in OpenXR."""


@dataclass(frozen=True)
class ViewState(Record):
    """Per-view state: eye, pupil, focus, gaze and pose.

    Attributes
    ----------
    eye : "both", "left" or "right"
        Eye whose profile applies to the view.
    pupil_diameter_mm, focus_dpt : float, optional
        State of that eye, the same for all its views; the frame's by default.
    gaze_deg : (h, v), optional
        Gaze in this view; the frame's by default.
    pose : seven floats, optional
        Pose of the camera, which is returned with the output image.
    """

    eye: EyeName = "both"
    pupil_diameter_mm: PupilMm | None = None
    focus_dpt: VergenceDpt | None = None
    gaze_deg: tuple[GazeDeg, GazeDeg] | None = None
    pose: Pose | None = None


def check_states(
    states: Sequence[ViewState], pupil_diameter_mm: float, focus_dpt: float
) -> None:
    """Check that views of one eye have the same pupil and focus.

    Parameters
    ----------
    states : sequence of ViewState
        States of the views of a frame.
    pupil_diameter_mm, focus_dpt : float
        State of the frame, for views that have none of their own.

    Raises
    ------
    BadMessage
        If they differ, or an item is not a ViewState; the error names the view.
    """
    defaults = {"pupil_diameter_mm": pupil_diameter_mm, "focus_dpt": focus_dpt}
    first_of: dict[EyeName, ViewState] = {}
    for i, state in enumerate(states):
        if not isinstance(state, ViewState):
            raise BadMessage(f"{state!r}", field=f"states[{i}]", allowed="a ViewState")
        first = first_of.setdefault(state.eye, state)
        for name, of_frame in defaults.items():
            wanted, found = (
                of_frame if own is None else own
                for own in (getattr(first, name), getattr(state, name))
            )
            if found is not wanted and found != wanted:
                raise BadMessage(
                    f"it is {found}",
                    field=f"views[{i}].{name}",
                    allowed=f"{wanted}, as in the first view of the eye {state.eye}",
                )
