"""The state of an eye, and the eye and state that a view is filtered with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol, Self, get_args

from msgspec import Meta

from filter_service.errors import BadMessage
from filter_service.settings import FilterSettings, GazeDeg, PupilMm, VergenceDpt
from filter_service.validation import Record, checked

EyeName = Literal["both", "left", "right"]
EYE_NAMES: tuple[EyeName, ...] = get_args(EyeName)
"""`both` is one eye for all views; `left` and `right` have separate profiles."""


def body_of_eye(body: Mapping[str, Any], eye: EyeName) -> dict[str, Any]:
    """Return a profile's body for an eye.

    The left eye gets ``eye_side`` "OS", unless the body sets the side.
    """
    return ({"eye_side": "OS"} if eye == "left" else {}) | dict(body)


@dataclass(frozen=True)
class State:
    """State of an eye in a frame.

    Attributes
    ----------
    pupil_diameter_mm : float
        Diameter of the entrance pupil.
    focus_dpt : float
        Distance of focus; 0 is infinity.
    gaze_deg : (h, v), optional
        Gaze in the image; by default from the settings.
    """

    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float] | None = None

    @classmethod
    def checked(
        cls,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
    ) -> Self:
        """Return a state whose values a frame may request.

        Raises
        ------
        BadMessage
            If a value is out of range; the error names it.
        """
        return cls(
            checked(pupil_diameter_mm, PupilMm, "pupil_diameter_mm"),
            checked(focus_dpt, VergenceDpt, "focus_dpt"),
            None
            if gaze_deg is None
            else checked(gaze_deg, tuple[GazeDeg, GazeDeg], "gaze_deg"),
        )

    def clamped(self, settings: FilterSettings) -> Self:
        """Return the state with pupil and focus clamped to the prepared ranges."""
        return type(self)(
            _clamped(self.pupil_diameter_mm, settings.pupil_range_mm),
            _clamped(self.focus_dpt, settings.focus_range_dpt),
            self.gaze_deg,
        )


class HasState(Protocol):
    """A result with the state that was used for it."""

    @property
    def state(self) -> State: ...  # noqa: D102


class WithState:
    """Mixin of results: the values of their attribute `state`."""

    @property
    def pupil_diameter_mm(self: HasState) -> float:
        """Return the pupil diameter used."""
        return self.state.pupil_diameter_mm

    @property
    def focus_dpt(self: HasState) -> float:
        """Return the focus used."""
        return self.state.focus_dpt

    @property
    def gaze_deg(self: HasState) -> tuple[float, float]:
        """Return the gaze used, (h, v)."""
        return self.state.gaze_deg or (0.0, 0.0)


def _clamped(value: float, limits: tuple[float, float]) -> float:
    return min(max(value, limits[0]), limits[1])


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

    def state(self, of_frame: State) -> State:
        """Return the state of the view; values that are None are the frame's."""

        def own(value: Any, default: Any) -> Any:
            return default if value is None else value

        return State(
            own(self.pupil_diameter_mm, of_frame.pupil_diameter_mm),
            own(self.focus_dpt, of_frame.focus_dpt),
            own(self.gaze_deg, of_frame.gaze_deg),
        )


def check_states(states: Sequence[ViewState], of_frame: State) -> None:
    """Check that views of one eye have the same pupil and focus.

    Parameters
    ----------
    states : sequence of ViewState
        States of the views of a frame.
    of_frame : State
        State of the frame, for views without a state.

    Raises
    ------
    BadMessage
        If they differ, or an item is not a ViewState; the error names the view.
    """
    first_of: dict[EyeName, State] = {}
    for i, view in enumerate(states):
        if not isinstance(view, ViewState):
            raise BadMessage(f"{view!r}", field=f"states[{i}]", allowed="a ViewState")
        state = view.state(of_frame)
        first = first_of.setdefault(view.eye, state)
        for name in ("pupil_diameter_mm", "focus_dpt"):
            wanted, found = getattr(first, name), getattr(state, name)
            if found is not wanted and found != wanted:
                raise BadMessage(
                    f"it is {found}",
                    field=f"views[{i}].{name}",
                    allowed=f"{wanted}, as in the first view of the eye {view.eye}",
                )
