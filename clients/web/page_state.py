"""State of a page: both eyes' entries, viewing conditions, and the picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from clients.web.correction_form import at_gaze
from clients.web.eye_form import SIDES, EyeForm, EyeSide, NoFile
from clients.web.numbers import NumberField
from clients.web.picture import Picture, Place
from clients.web.picture_requests import PictureRequest

Shown = Literal["OD", "OS", "both"]

PUPIL = NumberField("pupil_diameter_mm", "Pupil", "mm", 2.0, 7.0, 0.1, digits=1)
FOCUS = NumberField("focus_dpt", "Focus", "dpt", 0.0, 8.0, 0.05)
DISTANCE = NumberField("distance_dpt", "Distance", "dpt", 0.0, 6.0, 0.05)
GAZE_H = NumberField("gaze_h_deg", "Gaze, right", "°", -20.0, 20.0, 1.0, digits=0)
GAZE_V = NumberField("gaze_v_deg", "Gaze, up", "°", -15.0, 15.0, 1.0, digits=0)
AGE = NumberField("age_years", "Age", "years", 5.0, 90.0, 1.0, digits=0)
LOOKS = (PUPIL, FOCUS, DISTANCE, AGE, GAZE_H, GAZE_V)
"""In the order of the page."""


@dataclass
class PageState:
    """The entries of one page.

    Attributes
    ----------
    picture : the scene; None until one is ready
    right : the last valid profile of each eye
    shown : which eye, or both
    """

    eyes: dict[EyeSide, EyeForm] = field(
        default_factory=lambda: {side: EyeForm(side) for side in SIDES}
    )
    values: dict[str, float] = field(
        default_factory=lambda: {
            PUPIL.name: 4.0,
            FOCUS.name: 0.0,
            DISTANCE.name: 0.25,
            GAZE_H.name: 0.0,
            GAZE_V.name: 0.0,
            AGE.name: 30.0,
        }
    )
    picture: Picture | None = None
    shown: Shown = "OD"
    number: int = 0
    right: dict[EyeSide, Mapping[str, Any]] = field(default_factory=dict)

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
                continue  # nobody erred: the upload says what is allowed
            except ValueError as error:
                found.append(f"{SIDES[side]}: {error}")
        return found

    @property
    def gaze_deg(self) -> tuple[float, float]:
        """Return the gaze in the picture."""
        return self.values[GAZE_H.name], self.values[GAZE_V.name]

    def body_at_gaze(self, side: EyeSide) -> dict[str, Any] | None:
        """Return an eye's last valid profile, with the correction at the gaze."""
        body = self.right.get(side)
        return None if body is None else at_gaze(body, self.gaze_deg)

    def set_picture(self, picture: Picture) -> None:
        """Set the picture; the first one also sets the state that it suggests."""
        if self.picture is None:
            for number, value in (
                (FOCUS, picture.focus_dpt),
                (PUPIL, picture.pupil_diameter_mm),
            ):
                if value is not None:
                    self.values[number.name] = min(value, number.high)
        self.picture = picture
        if picture.distance_dpt is not None:
            self.values[DISTANCE.name] = picture.distance_dpt

    def request(self) -> PictureRequest | None:
        """Return the request for the current state; None without a picture or an eye.

        An eye with an invalid entry keeps its last profile: see `problems`.
        """
        for side in self.sides:
            try:
                self.right[side] = self.body(side)
            except ValueError:
                continue
        bodies = {side: self.right[side] for side in self.sides if side in self.right}
        if self.picture is None or not bodies:
            return None
        self.picture = self.picture.at(self.values[DISTANCE.name])
        self.number += 1
        return PictureRequest(
            number=self.number,
            picture=self.picture,
            bodies=bodies,
            pupil_diameter_mm=self.values[PUPIL.name],
            focus_dpt=self.values[FOCUS.name],
            gaze_deg=self.gaze_deg,
        )

    def place(self, x: float, y: float) -> Place | None:
        """Return the place at a position in the picture."""
        return None if self.picture is None else self.picture.place(x, y)

    def look_at(self, x: float, y: float) -> None:
        """Focus on the place at a position in the picture."""
        place = self.place(x, y)
        if place is not None:
            self.values[FOCUS.name] = min(place.distance_dpt, FOCUS.high)
