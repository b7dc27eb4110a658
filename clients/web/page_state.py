"""State of a page, independent of its layout."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from clients.acuity_text import Notation
from clients.scenarios import Scenario
from clients.web.comparison import (
    B_OF,
    EYE_NAMES,
    Difference,
    EyeName,
    differences,
    side_of,
    title_of,
)
from clients.web.controls import (
    AGE,
    AGE_B,
    BY_HAND,
    DISTANCE,
    FOCUS,
    GAZE_H,
    GAZE_V,
    PUPIL,
    SCENE_LIGHTS,
    NumberField,
    initial_values,
    pupil_by_light_mm,
)
from clients.web.eye_form import (
    SIDES,
    EyeForm,
    EyeSide,
    NoFile,
    profile_for_gaze,
    read_profile_file,
    reading_gaze_deg,
)
from clients.web.filter_thread import PictureRequest
from clients.web.picture import Picture
from filter_service.messages import State
from filter_service.settings import Pipeline

Shown = Literal["OD", "OS", "both"]
Arrangement = Literal["divider", "beside"]
"""A and B behind one divider, or beside each other, each with the scene."""

READING_DPT = 2.5
READING_GAZE_DEG = -30.0
"""Vertical gaze for reading without a progressive lens."""

WHOLE_SCENES = ("night_road",)
"""Scenes of scenarios that A and B show whole: what matters is at one side."""

SCENES = ("courtyard", "primitives", "night_road", "stairs", "chart")
"""Scenes that need no file; a new page shows the first one."""


@dataclass
class PageState:
    """The entries of one page.

    Attributes
    ----------
    eyes : entries of both eyes; of state A where two states are compared
    others : entries of state B of each eye
    values : viewing conditions by field name; those of A and B are the same but for age
    wants_comparison : whether A and B are shown while one eye is selected
    arrangement : of the pictures of A and B
    notation : of acuity beside logMAR
    light : level of light that sets the pupil, a key of `LIGHTS`
    is_focus_set : whether the user set the focus, so that it ignores the distance
    picture : the scene; None until one is ready
    empty_reason : text in place of the picture, or an empty string
    shown : which eye, or both
    pipeline : pipeline of full pictures; previews are exact
    number : number of the last request
    keeps_focus : whether the next picture keeps the focus, as it came with the link or
        the scenario that selected it
    light_before : light before a scene set it, or None; and the pupil then
    valid_profiles : the last valid profile of each eye
    """

    eyes: dict[EyeSide, EyeForm] = field(
        default_factory=lambda: {side: EyeForm(side) for side in SIDES}
    )
    others: dict[EyeSide, EyeForm] = field(
        default_factory=lambda: {side: EyeForm(side) for side in SIDES}
    )
    values: dict[str, float] = field(default_factory=initial_values)
    wants_comparison: bool = False
    arrangement: Arrangement = "divider"
    is_focus_set: bool = False
    light: str = BY_HAND
    notation: Notation = "decimal"
    picture: Picture | None = None
    empty_reason: str = ""
    shown: Shown = "OD"
    pipeline: Pipeline = "exact"
    number: int = 0
    keeps_focus: bool = False
    light_before: str | None = None
    pupil_before_mm: float = PUPIL.initial
    valid_profiles: dict[EyeName, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def sides(self) -> tuple[EyeSide, ...]:
        """Return the eyes that are shown."""
        return tuple(SIDES) if self.shown == "both" else (self.shown,)

    @property
    def is_comparing(self) -> bool:
        """Return whether states A and B of one eye are shown."""
        return self.wants_comparison and self.shown != "both"

    @property
    def names(self) -> tuple[EyeName, ...]:
        """Return the names of the pictures that are shown."""
        if self.is_comparing:
            return (self.sides[0], B_OF[self.sides[0]])
        return self.sides

    def title(self, name: EyeName) -> str:
        """Return the name of a picture as displayed."""
        return title_of(name, is_comparing=self.is_comparing)

    @property
    def titles(self) -> str:
        """Return the names of the pictures that are shown, in lower case but A, B."""
        if self.is_comparing:
            return f"{SIDES[self.sides[0]].lower()}, A and B"
        return " and ".join(SIDES[side].lower() for side in self.sides)

    def form(self, name: EyeName) -> EyeForm:
        """Return the entries of an eye or of its state B."""
        side = side_of(name)
        return self.eyes[side] if name == side else self.others[side]

    def age(self, name: EyeName) -> NumberField:
        """Return the field of the age of an eye or of its state B."""
        return AGE if name == side_of(name) else AGE_B

    def body(self, name: EyeName) -> dict[str, Any]:
        """Return the profile of an eye or of its state B.

        Raise ValueError for an invalid entry: its value and the allowed ones.
        """
        return self.form(name).body(age_years=self.values[self.age(name).name])

    def problems(self) -> list[str]:
        """Return the errors in the entries of the eyes shown."""
        found = []
        for name in self.names:
            try:
                self.body(name)
            except NoFile:
                continue  # not an error: the upload shows what is allowed
            except ValueError as error:
                found.append(f"{self.title(name)}: {error}")
        return found

    # Comparison

    def compare(self, is_on: bool) -> None:
        """Show states A and B of one eye, or one state; B starts as a copy of A."""
        if is_on and self.shown == "both":
            self.shown = "OD"
        if is_on and self.others[self.sides[0]] == EyeForm(self.sides[0]):
            self.copy_to_b()
        self.wants_comparison = is_on

    def copy_to_b(self) -> None:
        """Set the entries of state B of the eye shown to those of A."""
        side = self.sides[0]
        self.others[side].copy(self.eyes[side])
        self.values[AGE_B.name] = self.values[AGE.name]

    def swap(self) -> None:
        """Exchange A and B of the eye shown."""
        side = self.sides[0]
        old = copy.deepcopy(self.eyes[side])
        self.eyes[side].copy(self.others[side])
        self.others[side].copy(old)
        values = self.values
        values[AGE.name], values[AGE_B.name] = values[AGE_B.name], values[AGE.name]

    def differences(self) -> list[Difference]:
        """Return the entries in which the last valid states A and B differ."""
        bodies = [self.valid_profiles.get(name) for name in self.names]
        if not self.is_comparing or None in bodies:
            return []
        a, b = (body for body in bodies if body is not None)
        return differences(a, b)

    @property
    def eye_state(self) -> dict[str, float]:
        """Return pupil and focus, as arguments of filters and figures."""
        return {number.name: self.values[number.name] for number in (PUPIL, FOCUS)}

    @property
    def is_flat(self) -> bool:
        """Return whether all of the picture is at one distance."""
        return self.picture is not None and self.picture.distance_dpt is not None

    @property
    def object_dpt(self) -> float:
        """Return the distance of a flat picture; in a scene, that of the focus."""
        return self.values[(DISTANCE if self.is_flat else FOCUS).name]

    @property
    def gaze_deg(self) -> tuple[float, float]:
        """Return the gaze relative to straight ahead of the head."""
        return self.values[GAZE_H.name], self.values[GAZE_V.name]

    @property
    def picture_gaze_deg(self) -> tuple[float, float]:
        """Return the gaze relative to the picture's center."""
        follows = self.picture is not None and self.picture.follows_gaze
        return (0.0, 0.0) if follows else self.gaze_deg

    def profile_at_gaze(self, name: EyeName) -> dict[str, Any] | None:
        """Return an eye's last valid profile, with its correction at the gaze."""
        body = self.valid_profiles.get(name)
        return None if body is None else profile_for_gaze(body, self.gaze_deg)

    def set_picture(self, picture: Picture) -> None:
        """Set the picture; the first one also sets its initial focus and pupil.

        The focus on a flat picture ends with it: a scene has its own initial focus.
        """
        is_left = self.is_flat and picture.distance_dpt is None
        if is_left and not self.keeps_focus:
            self.values[FOCUS.name] = round(picture.focus_dpt or 0.0, FOCUS.digits)
            self.is_focus_set = False
        self.keeps_focus = False
        if self.picture is None:
            for number in (FOCUS, PUPIL):
                value = getattr(picture, number.name)
                if value is not None:
                    shown = round(value, number.digits)
                    self.values[number.name] = min(shown, number.high)
        self.picture = picture
        if picture.distance_dpt is not None:
            self.values[DISTANCE.name] = picture.distance_dpt
            self._focus_on_picture()

    def _focus_on_picture(self) -> None:
        if self.is_flat and not self.is_focus_set:
            self.values[FOCUS.name] = min(self.values[DISTANCE.name], FOCUS.high)

    def move(self, name: str, value: float) -> None:
        """Set a viewing condition.

        The focus follows the distance of a flat picture until the user sets it.
        """
        self.values[name] = value
        if name == PUPIL.name:
            self.light = BY_HAND
        elif name == AGE.name:
            self.set_light(self.light)
        if name == FOCUS.name:
            self.is_focus_set = True
        elif name == DISTANCE.name:
            self._focus_on_picture()

    def set_light(self, light: str) -> None:
        """Set the pupil by a level of light; it follows the age of A."""
        self.light = light
        if light != BY_HAND:
            pupil_mm = pupil_by_light_mm(light, self.values[AGE.name])
            self.values[PUPIL.name] = pupil_mm

    def adapt_to(self, scene: str) -> None:
        """Set the light of a scene chosen by hand, and undo it when the scene is left.

        A link or a scenario has its own pupil.
        """
        light, before = SCENE_LIGHTS.get(scene), self.light_before
        self.light_before = None
        if light is not None and not self.keeps_focus:
            if before is None:
                self.pupil_before_mm = self.values[PUPIL.name]
            self.light_before = before or self.light
            self.set_light(light)
        elif before is not None and self.light in SCENE_LIGHTS.values():
            self.light, self.values[PUPIL.name] = before, self.pupil_before_mm

    def look(self, *, is_reading: bool) -> None:
        """Look straight ahead and far, or down at a reading distance."""
        bodies = (self.valid_profiles.get(name, {}) for name in self.names)
        turns_deg = [turn for body in bodies if (turn := reading_gaze_deg(body))]
        gaze_deg = max(min([*turns_deg, 0.0]) or READING_GAZE_DEG, GAZE_V.low)
        distance_dpt = READING_DPT if is_reading else 0.0
        self.values |= {
            GAZE_H.name: 0.0,
            GAZE_V.name: gaze_deg if is_reading else 0.0,
            DISTANCE.name: distance_dpt,
            FOCUS.name: distance_dpt,
        }
        self.is_focus_set = False

    def look_at_distance(self, meters: float) -> None:
        """Look at a distance, and move a flat picture there; a scene stays in place."""
        distance_dpt = round(1.0 / meters, 4)
        if self.is_flat:
            self.move(DISTANCE.name, distance_dpt)
        else:
            self.values[FOCUS.name] = distance_dpt

    def start_scenario(self, scenario: Scenario) -> None:
        """Set the entries to those of a scenario."""
        notation = self.notation
        self.reset()
        self.notation = notation
        gaze_h_deg, gaze_v_deg = scenario.gaze_deg
        values: dict[NumberField, float] = {
            PUPIL: scenario.pupil_diameter_mm,
            FOCUS: scenario.focus_dpt,
            DISTANCE: scenario.focus_dpt,
            GAZE_H: gaze_h_deg,
            GAZE_V: gaze_v_deg,
        }
        self.values |= {
            number.name: round(number.clamped(v), 4) for number, v in values.items()
        }
        side = self.sides[0]
        for name, one in ((side, scenario.a), (B_OF[side], scenario.b)):
            self.load_body(name, one.profile, one.title)
        self.wants_comparison = True
        self.arrangement = "beside" if scenario.scene in WHOLE_SCENES else "divider"

    def load_body(self, eye: EyeName, body: Mapping[str, Any], name: str) -> None:
        """Load a profile into an eye, with the age of the person."""
        self.form(eye).load_body(body, name)
        age = self.age(eye).name
        self.values[age] = body.get(AGE.name, self.values[age])

    def load_file(self, eye: EyeName, name: str, content: bytes) -> EyeName:
        """Load a profile file into the eye that it names, by default into `eye`.

        A file that is loaded into state A or B of a comparison stays there.

        Return the eye that was loaded.  Raise ValueError if it is not a profile;
        nothing has changed.
        """
        body = read_profile_file(name, content)
        loaded = eye if self.is_comparing else body.get("eye_side", eye)
        self.load_body(loaded, body, Path(name).name)
        if loaded != eye and self.form(eye).file_body is None:
            self.form(eye).source = "prescription"
        return loaded

    def reset(self) -> None:
        """Set the initial entries; picture and uploaded files stay available."""
        for name in EYE_NAMES:
            self.form(name).reset()
        self.values.update(initial_values())
        self.shown, self.is_focus_set, self.pipeline = "OD", False, "exact"
        self.wants_comparison, self.arrangement = False, "divider"
        self.keeps_focus, self.light, self.light_before = False, BY_HAND, None
        self.notation = "decimal"

    def read_profiles(self) -> bool:
        """Read the profiles of the eyes shown; return whether any has changed.

        An eye with an invalid entry keeps its last one: see `problems`.
        """
        before = dict(self.valid_profiles)
        for name in self.names:
            try:
                self.valid_profiles[name] = self.body(name)
            except ValueError:
                continue
        return self.valid_profiles != before

    def request(self) -> PictureRequest | None:
        """Return the request for the current state; None without a picture or eye."""
        self.read_profiles()
        shown = [name for name in self.names if name in self.valid_profiles]
        if self.picture is None or not shown:
            return None
        self.picture = self.picture.at(self.values[DISTANCE.name])
        bodies = {name: self.valid_profiles[name] for name in shown}
        if self.picture.follows_gaze:
            bodies = {n: profile_for_gaze(bodies[n], self.gaze_deg) for n in shown}
        self.number += 1
        return PictureRequest(
            number=self.number,
            picture=self.picture,
            bodies=bodies,
            state=State(**self.eye_state, gaze_deg=self.picture_gaze_deg),
            pipeline=self.pipeline,
        )

    def look_at(self, x: float, y: float) -> None:
        """Focus on the scene point at a position in the picture."""
        if self.picture is not None:
            distance_dpt = self.picture.scene_point(x, y).distance_dpt
            focus_dpt = round(distance_dpt, FOCUS.digits)
            self.move(FOCUS.name, min(focus_dpt, FOCUS.high))
