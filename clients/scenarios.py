"""Scenarios: two states of one person in a scene, such as before and after surgery.

`scenarios.json` describes them; docs/how-to/scenarios.md says how to add one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

CHART = "chart"
"""Scene of the letter chart, which is at the distance that the person looks at."""


@dataclass(frozen=True)
class ScenarioState:
    """One of the two states of a person.

    Attributes
    ----------
    title : str
        Its name, such as the lens that is worn.
    profile : mapping
        JSON object of the profile.
    """

    title: str
    profile: Mapping[str, Any]


@dataclass(frozen=True)
class Scenario:
    """Two states of one person, and what the person looks at.

    Attributes
    ----------
    name : str
        Name of the scenario, for commands.
    title : str
        Its title for people.
    sees : str
        What the person sees, in one sentence.
    leaves_out : str
        What the model leaves out, in one sentence.
    scene : str
        Name of a scene of `clients.scenes.catalog`, or `CHART`.
    luminance_cd_m2 : float
        Luminance to which the eye is adapted.
    pupil_diameter_mm : float
        Pupil at this luminance and age (Watson and Yellott, J. Vision 12(10):12, 2012).
    distance_m : float
        Distance that the person looks at.
    gaze_deg : (h, v)
        Gaze relative to the axis of the camera.
    a, b : ScenarioState
        The states to compare, such as before and after.
    """

    name: str
    title: str
    sees: str
    leaves_out: str
    scene: str
    luminance_cd_m2: float
    pupil_diameter_mm: float
    distance_m: float
    gaze_deg: tuple[float, float]
    a: ScenarioState
    b: ScenarioState

    @property
    def focus_dpt(self) -> float:
        """Return the distance that the person looks at, in diopters."""
        return 0.0 if math.isinf(self.distance_m) else 1.0 / self.distance_m

    @property
    def differing_entries(self) -> tuple[str, ...]:
        """Return the names of the profile's entries that differ between the states."""
        a, b = self.a.profile, self.b.profile
        return tuple(sorted(k for k in {*a, *b} if a.get(k) != b.get(k)))


@cache
def scenarios() -> Mapping[str, Scenario]:
    """Return all scenarios by their names."""
    text = Path(__file__).with_suffix(".json").read_text(encoding="utf-8")
    return {name: _scenario(name, body) for name, body in json.loads(text).items()}


def _scenario(name: str, body: dict[str, Any]) -> Scenario:
    person = body.pop("person")
    states = {
        side: ScenarioState(state["title"], {**person, **state["entries"]})
        for side, state in ((side, body.pop(side)) for side in ("a", "b"))
    }
    gaze_deg = tuple(body.pop("gaze_deg", (0.0, 0.0)))
    return Scenario(name=name, gaze_deg=gaze_deg, **states, **body)
