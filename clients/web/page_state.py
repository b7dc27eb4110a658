"""State of a page: both eyes' entries, viewing conditions, and the picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from clients.web.correction_form import profile_for_gaze, reading_gaze_deg
from clients.web.eye_form import SIDES, EyeForm, EyeSide, NoFile, read_profile_file
from clients.web.numbers import NumberField
from clients.web.picture import Picture, ScenePoint
from clients.web.picture_requests import PictureRequest
from filter_service.settings import Pipeline

Shown = Literal["OD", "OS", "both"]

PUPIL = NumberField("pupil_diameter_mm", "Pupil", "mm", 2.0, 7.0, 0.1, digits=1)
FOCUS = NumberField("focus_dpt", "Focus", "dpt", 0.0, 8.0, 0.05)
DISTANCE = NumberField("distance_dpt", "Distance", "dpt", 0.0, 6.0, 0.05)
GAZE_H = NumberField("gaze_h_deg", "Gaze, right", "°", -20.0, 20.0, 1.0, digits=0)
GAZE_V = NumberField("gaze_v_deg", "Gaze, up", "°", -45.0, 30.0, 1.0, digits=0)
AGE = NumberField("age_years", "Age", "years", 5.0, 90.0, 1.0, digits=0)
CONDITIONS = (PUPIL, FOCUS, DISTANCE, AGE, GAZE_H, GAZE_V)
"""Viewing conditions, in the order of the page."""

READING_DPT = 2.5
READING_GAZE_DEG = -30.0
"""Vertical gaze for reading without a progressive lens."""


def first_values() -> dict[str, float]:
    """Return the initial viewing conditions."""
    return {
        PUPIL.name: 4.0,
        FOCUS.name: 0.0,
        DISTANCE.name: 0.25,
        GAZE_H.name: 0.0,
        GAZE_V.name: 0.0,
        AGE.name: 30.0,
    }


@dataclass
class PageState:
    """The entries of one page.

    Attributes
    ----------
    picture : the scene; None until one is ready
    valid_profiles : the last valid profile of each eye
    shown : which eye, or both
    is_focus_set : whether the user set the focus, so that it ignores the distance
    pipeline : that of full pictures; previews are exact
    """

    eyes: dict[EyeSide, EyeForm] = field(
        default_factory=lambda: {side: EyeForm(side) for side in SIDES}
    )
    values: dict[str, float] = field(default_factory=first_values)
    is_focus_set: bool = False
    picture: Picture | None = None
    shown: Shown = "OD"
    pipeline: Pipeline = "exact"
    number: int = 0
    valid_profiles: dict[EyeSide, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def sides(self) -> tuple[EyeSide, ...]:
        """Return the eyes that are shown."""
        return tuple(SIDES) if self.shown == "both" else (self.shown,)

    def body(self, side: EyeSide) -> dict[str, Any]:
        """Return an eye's profile.

        Raises
        ------
        ValueError
            An invalid entry: its value and the allowed ones.
        """
        return self.eyes[side].body(age_years=self.values[AGE.name])

    def problems(self) -> list[str]:
        """Return the errors in the entries of the eyes shown."""
        found = []
        for side in self.sides:
            try:
                self.body(side)
            except NoFile:
                continue  # not an error: the upload shows what is allowed
            except ValueError as error:
                found.append(f"{SIDES[side]}: {error}")
        return found

    @property
    def gaze_deg(self) -> tuple[float, float]:
        """Return the gaze relative to straight ahead of the head."""
        return self.values[GAZE_H.name], self.values[GAZE_V.name]

    @property
    def picture_gaze_deg(self) -> tuple[float, float]:
        """Return the gaze relative to the picture's center."""
        follows = self.picture is not None and self.picture.follows_gaze
        return (0.0, 0.0) if follows else self.gaze_deg

    def profile_at_gaze(self, side: EyeSide) -> dict[str, Any] | None:
        """Return an eye's last valid profile, with its correction at the gaze."""
        body = self.valid_profiles.get(side)
        return None if body is None else profile_for_gaze(body, self.gaze_deg)

    def set_picture(self, picture: Picture) -> None:
        """Set the picture; the first one also sets its initial focus and pupil."""
        if self.picture is None:
            for number, value in (
                (FOCUS, picture.focus_dpt),
                (PUPIL, picture.pupil_diameter_mm),
            ):
                if value is not None:
                    shown = round(value, number.digits)
                    self.values[number.name] = min(shown, number.high)
        self.picture = picture
        if picture.distance_dpt is not None:
            self.values[DISTANCE.name] = picture.distance_dpt
            self._focus_on_picture()

    def _focus_on_picture(self) -> None:
        is_flat = self.picture is not None and self.picture.distance_dpt is not None
        if is_flat and not self.is_focus_set:
            self.values[FOCUS.name] = min(self.values[DISTANCE.name], FOCUS.high)

    def move(self, name: str, value: float) -> None:
        """Set a viewing condition.

        The focus follows the distance of a flat picture until the user sets it.
        """
        self.values[name] = value
        if name == FOCUS.name:
            self.is_focus_set = True
        elif name == DISTANCE.name:
            self._focus_on_picture()

    def look(self, *, is_reading: bool) -> None:
        """Look straight ahead and far, or down at a reading distance."""
        bodies = (self.valid_profiles.get(side, {}) for side in self.sides)
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

    def load_file(self, side: EyeSide, name: str, content: bytes) -> EyeSide:
        """Load a profile file into the eye that it names, by default into `side`.

        Returns
        -------
        The eye that was loaded.

        Raises
        ------
        ValueError
            Not a profile; nothing has changed.
        """
        body = read_profile_file(name, content)
        loaded_side: EyeSide = body.get("eye_side", side)
        self.eyes[loaded_side].load_body(body, Path(name).name)
        if loaded_side != side and self.eyes[side].file_body is None:
            self.eyes[side].source = "prescription"
        self.values[AGE.name] = body.get(AGE.name, self.values[AGE.name])
        return loaded_side

    def reset(self) -> None:
        """Set the initial entries; picture and uploaded files stay available."""
        for form in self.eyes.values():
            form.reset()
        self.values.update(first_values())
        self.shown, self.is_focus_set, self.pipeline = "OD", False, "exact"

    def read_profiles(self) -> bool:
        """Read the profiles of the eyes shown; return whether any has changed.

        An eye with an invalid entry keeps its last profile: see `problems`.
        """
        before = dict(self.valid_profiles)
        for side in self.sides:
            try:
                self.valid_profiles[side] = self.body(side)
            except ValueError:
                continue
        return self.valid_profiles != before

    def request(self) -> PictureRequest | None:
        """Return the request for the current state; None without a picture or eye."""
        self.read_profiles()
        bodies = {
            side: self.valid_profiles[side]
            for side in self.sides
            if side in self.valid_profiles
        }
        if self.picture is None or not bodies:
            return None
        self.picture = self.picture.at(self.values[DISTANCE.name])
        if self.picture.follows_gaze:
            bodies = {
                s: profile_for_gaze(body, self.gaze_deg) for s, body in bodies.items()
            }
        self.number += 1
        return PictureRequest(
            number=self.number,
            picture=self.picture,
            bodies=bodies,
            pupil_diameter_mm=self.values[PUPIL.name],
            focus_dpt=self.values[FOCUS.name],
            gaze_deg=self.picture_gaze_deg,
            pipeline=self.pipeline,
        )

    def scene_point(self, x: float, y: float) -> ScenePoint | None:
        """Return the scene point at a position in the picture."""
        return None if self.picture is None else self.picture.scene_point(x, y)

    def look_at(self, x: float, y: float) -> None:
        """Focus on the scene point at a position in the picture."""
        point = self.scene_point(x, y)
        if point is not None:
            focus_dpt = round(point.distance_dpt, FOCUS.digits)
            self.move(FOCUS.name, min(focus_dpt, FOCUS.high))
