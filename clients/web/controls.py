"""The numbers that can be entered on the page: limits, steps and initial values.

A control is one line of a table here, and its use in `page_state` or `eye_form`: the
page, links and new pages take everything else from the line.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

from clients.web.written import (
    DEGREE,
    DIOPTERS,
    MINUS_SIGNS,
    NO_CYLINDER,
    prescription_hint,
    written_number,
)
from clients.web.written import begins_prescription as begins_prescription
from clients.web.written import prescription_texts as prescription_texts
from estimator.dynamics import steady_pupil_mm
from estimator.media import LOG_S_RANGE

HIDDEN = 0.05
"""Fraction of a number without decimals that is not shown."""


METERS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "in": 0.0254}
_DISTANCE = re.compile(r"(\d*\.?\d+)\s*(m|cm|mm|ft|in)", re.IGNORECASE | re.ASCII)


@dataclass(frozen=True)
class NumberField:
    """One number of a form.

    Attributes
    ----------
    name : str
        Profile field, with its unit.
    label, unit : str
        As displayed.
    low, high : float
        Allowed range.
    step : float
        Step of arrow keys and sliders.
    initial : float
        Value on a new page.
    digits : int
        Decimals shown.
    is_signed : bool
        Whether a plus sign is shown, as on a prescription.
    is_distance : bool
        Whether a slider shows the distance in meters, too.
    """

    name: str
    label: str
    unit: str
    low: float
    high: float
    step: float
    initial: float = 0.0
    digits: int = 2
    is_signed: bool = False
    is_distance: bool = False

    @property
    def allowed(self) -> str:
        """Return the range as text."""
        limits = f"{self.low:g} to {self._with_unit(f'{self.high:g}')}"
        return limits.replace("-", "\N{MINUS SIGN}")

    def read(self, text: str) -> float:
        """Return the number in a text as people write it; see `written_number`.

        Raises
        ------
        ValueError
            If it is not a number or out of range; the message contains the text and the
            allowed range.
        """
        shown = text.strip()
        if not shown:
            raise ValueError(f"{self.label} is empty; allowed: {self.allowed}")
        if self.name.endswith("cylinder_dpt") and shown.lower() in NO_CYLINDER:
            return 0.0
        value = written_number(
            shown, unit=self.unit, is_vertex=self.name == "vertex_mm"
        )
        if not math.isfinite(value):
            hint = prescription_hint(shown) if self.unit == DIOPTERS else ""
            text = hint or f"is not a number; allowed: {self.allowed}"
            raise ValueError(f"“{shown:.20}” {text}")
        if not self.low <= value <= self.high:
            raise ValueError(f"{shown:.20} is out of range; allowed: {self.allowed}")
        return value

    def read_typed(self, text: str) -> float:
        """Return the value of a text that may have a unit, as "6 m" or "3.5 mm".

        Raises
        ------
        ValueError
            If it has no value within the range; the message contains the text and the
            allowed range.
        """
        shown = text.strip().translate(MINUS_SIGNS)
        if self.is_distance:
            meters = _DISTANCE.fullmatch(shown)
            if meters is not None:
                length = float(meters[1]) * METERS[meters[2].lower()]
                shown = f"{1.0 / length:.4f}" if length > 0.0 else "inf"
            shown = re.sub(r"\s*(dpt|D)$", "", shown)
        return self.read(shown.removesuffix(self.unit).strip())

    def problem(self, text: str) -> str | None:
        """Return the error message for a text, or None."""
        try:
            self.read(text)
        except ValueError as error:
            return str(error)
        return None

    def clamped(self, value: float) -> float:
        """Return a value clamped to the range."""
        return float(min(max(value, self.low), self.high))

    def show(self, value: float) -> str:
        """Return a value as displayed in an entry."""
        sign = "+" if self.is_signed and value > 0 else ""
        digits = self.digits
        if not digits and abs(value - round(value)) >= HIDDEN:
            digits = 1  # 12.5 mm as typed
        return f"{sign}{value:.{digits}f}"

    def normalized(self, text: str, steps: int = 0) -> str:
        """Return a valid text as displayed, "-4" as "-4.00"; others unchanged.

        Parameters
        ----------
        steps : int
            Number of steps by which to change the value, within the range.
        """
        try:
            value = self.read(text)
        except ValueError:
            return text
        if steps:
            value = self.clamped((round(value / self.step) + steps) * self.step)
        return self.show(value)

    def describe(self, value: float) -> str:
        """Return a value as displayed beside a slider."""
        if self.is_distance:
            return distance_text(value)
        return self._with_unit(self.show(value))

    def _with_unit(self, text: str) -> str:
        return f"{text}{'' if self.unit == DEGREE else ' '}{self.unit}"


PUPIL = NumberField("pupil_diameter_mm", "Pupil", "mm", 2.0, 7.0, 0.1, 4.0, digits=1)
FOCUS = NumberField("focus_dpt", "Focus", "dpt", 0.0, 8.0, 0.05, is_distance=True)
DISTANCE = NumberField(
    "distance_dpt", "Distance", "dpt", 0.0, 6.0, 0.05, 0.25, is_distance=True
)
GAZE_H = NumberField("gaze_h_deg", "Gaze, right", "°", -20.0, 20.0, 1.0, digits=0)
GAZE_V = NumberField("gaze_v_deg", "Gaze, up", "°", -45.0, 30.0, 1.0, digits=0)
AGE = NumberField("age_years", "Age", "years", 5.0, 90.0, 1.0, 30.0, digits=0)
AGE_B = replace(AGE, name="age_b_years", label="Age of B")
AGES = (AGE, AGE_B)
CONDITIONS = (PUPIL, FOCUS, DISTANCE, GAZE_H, GAZE_V, *AGES)
"""Viewing conditions, in the order of the page."""

DISTANCES_M = {"6 m": 6.0, "4 m": 4.0, "1 m": 1.0, "66 cm": 0.66, "40 cm": 0.4}
"""Distances of charts and of reading, as people say them."""

BY_HAND = "hand"
LIGHTS: dict[str, tuple[str, float]] = {
    BY_HAND: ("Set by the slider", 0.0),
    "moon": ("Moonlit street, 0.03 cd/m²", 0.03),
    "night": ("Lit road at night, 1 cd/m²", 1.0),
    "room": ("Living room, 30 cd/m²", 30.0),
    "screen": ("Letter chart or screen, 100 cd/m²", 100.0),
    "overcast": ("Overcast day, 2,000 cd/m²", 2000.0),
    "sun": ("Sunny day, 8,000 cd/m²", 8000.0),
}
"""Levels of light: text, and mean luminance in cd/m²."""

SCENE_LIGHTS = {"night_road": "night"}
"""Level of light that a scene sets when it is chosen, a key of `LIGHTS`."""

LIT_FIELD_DEG2 = 2827.0
"""Area of the adapting field: a disk of 60 deg."""

SPHERE = NumberField("sphere_dpt", "Sphere", "dpt", -30.0, 30.0, 0.25, is_signed=True)
CYLINDER = replace(SPHERE, name="cylinder_dpt", label="Cylinder", low=-15.0, high=15.0)
AXIS = NumberField("axis_deg", "Axis", "°", 0.0, 180.0, 1.0, digits=0)
VERTEX = NumberField("vertex_mm", "Vertex", "mm", 0.0, 25.0, 1.0, 12.0, digits=0)
PRESCRIPTION = (SPHERE, CYLINDER, AXIS, VERTEX)
SPHERE_SLIDER = replace(SPHERE, name="sphere_slider_dpt", low=-10.0, high=10.0)
"""Typed values may exceed the range of the slider."""

PROGRESSIVE_ADD = NumberField(
    "add_dpt", "Addition", "dpt", 0.25, 4.0, 0.25, 2.0, is_signed=True
)
CORRIDOR = NumberField("corridor_mm", "Corridor", "mm", 8.0, 24.0, 1.0, 14.0, digits=0)
BIFOCAL_ADD = replace(PROGRESSIVE_ADD, low=0.5, high=6.0)
EDOF_ADD = replace(PROGRESSIVE_ADD, high=3.0)
MIDDLE_ADD = NumberField(
    "middle_add_dpt", "Middle add", "dpt", 0.5, 6.0, 0.01, 1.66, is_signed=True
)
NEAR_ADD = replace(MIDDLE_ADD, name="near_add_dpt", label="Near add", initial=3.32)
RESIDUAL_SPHERE = NumberField(
    *("residual_sphere_dpt", "Residual sphere", "dpt", -10.0, 10.0, 0.25),
    is_signed=True,
)
RESIDUAL_CYLINDER = replace(
    RESIDUAL_SPHERE, name="residual_cylinder_dpt", label="Residual cylinder"
)
RESIDUAL_AXIS = replace(AXIS, name="residual_axis_deg", label="Residual axis")
RESIDUAL = (RESIDUAL_SPHERE, RESIDUAL_CYLINDER, RESIDUAL_AXIS)
"""Refraction that remains after surgery, at the cornea."""

STRAYLIGHT = NumberField("log_s", "log s at 7°", "", *LOG_S_RANGE, 0.05, 1.2)
ABERRATION = NumberField(
    *("spherical_aberration_um", "Spherical aberration", "µm", -2.0, 2.0, 0.01),
    is_signed=True,
)
CORRECTION = (
    *PRESCRIPTION,
    *(PROGRESSIVE_ADD, CORRIDOR, MIDDLE_ADD, NEAR_ADD, ABERRATION),
    *RESIDUAL,
)
"""All entries of corrections."""


def initial_values() -> dict[str, float]:
    """Return the initial viewing conditions."""
    return {field.name: field.initial for field in CONDITIONS}


def pupil_by_light_mm(light: str, age_years: float) -> float:
    """Return the pupil at a level of light, within the range of its slider.

    References
    ----------
    Watson & Yellott, J. Vision 12(10):12, 2012: the "unified formula".
    """
    _, luminance_cd_m2 = LIGHTS[light]
    found_mm = steady_pupil_mm(luminance_cd_m2, LIT_FIELD_DEG2, age_years)
    return round(PUPIL.clamped(found_mm), PUPIL.digits)


def initial_texts(fields: Iterable[NumberField]) -> dict[str, str]:
    """Return the initial texts of entries."""
    return {field.name: field.show(field.initial) for field in fields}


def distance_text(vergence_dpt: float) -> str:
    """Return a distance in dpt and in meters or centimeters."""
    if vergence_dpt < 0.005:
        return "0 dpt · far away"
    meters = 1.0 / vergence_dpt
    distance = f"{100 * meters:.0f} cm" if meters < 1.0 else f"{meters:.1f} m"
    return f"{vergence_dpt:.2f} dpt · {distance}"
