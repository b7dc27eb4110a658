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

from clients.scenes.letter_chart import LOG_MAR_ROWS, ROWS_OF_LETTERS, letter_chart
from filter_service import Camera, EyeFilter, Filtered, Output, RgbdView

CHART_HEIGHT_DEG = 4.6
CHART_LARGEST_LOG_MAR = 0.7

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
    luminance_nit : float
        Luminance to which the eye is adapted, cd/m².
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
    luminance_nit: float
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


def scenario_named(name: str) -> Scenario:
    """Return a scenario by its name.

    Raises
    ------
    ValueError
        If no scenario has that name.
    """
    if name not in scenarios():
        names = ", ".join(sorted(scenarios()))
        raise ValueError(f"unknown scenario {name!r:.60}; expected one of: {names}")
    return scenarios()[name]


def _scenario(name: str, body: dict[str, Any]) -> Scenario:
    person, a, b = (body.pop(part) for part in ("person", "a", "b"))
    h_deg, v_deg = body.pop("gaze_deg", (0.0, 0.0))
    return Scenario(
        name=name,
        gaze_deg=(h_deg, v_deg),
        a=ScenarioState(a["title"], {**person, **a["entries"]}),
        b=ScenarioState(b["title"], {**person, **b["entries"]}),
        **body,
    )


def scenario_view(scenario: Scenario, size_px: tuple[int, int]) -> RgbdView:
    """Render the scene of a scenario, with its hidden layer.

    Colors are sRGB bytes, or linear light in a scene with lamps brighter than white.

    Parameters
    ----------
    scenario : Scenario
    size_px : (int, int)
        Width and height of the image.

    Raises
    ------
    ValueError
        If the size is too small for the chart.
    RenderFailed
        If this machine offers no OpenGL context for the scene.
    """
    if scenario.scene == CHART:
        width_px, height_px = size_px
        camera = Camera.from_fov(
            CHART_HEIGHT_DEG, width_px=width_px, height_px=height_px
        )
        rows = [row for row in LOG_MAR_ROWS if row <= CHART_LARGEST_LOG_MAR]
        chart = letter_chart(
            camera,
            distance_m=scenario.distance_m,
            log_mar=rows,
            letters=ROWS_OF_LETTERS[-len(rows) :],
        )
        return chart.view
    from clients.scene_renderer import PATHS, SceneRenderer, path_moments
    from clients.scenes.catalog import build_scene

    scene = build_scene(scenario.scene)
    (moment,) = path_moments(PATHS[scenario.scene], 1)
    with SceneRenderer(scene, size_px, is_linear=scene.is_hdr) as renderer:
        visible, hidden = renderer.render_layers(moment.pose)
        return RgbdView(
            *visible,
            renderer.tangents,
            hidden_color=hidden[0],
            hidden_depth_m=hidden[1],
        )


def filtered_states(
    scenario: Scenario, view: RgbdView, *, output: Output = "srgb8", **settings: Any
) -> tuple[Filtered, Filtered]:
    """Filter a view through both states of a scenario.

    Parameters
    ----------
    scenario : Scenario
    view : RgbdView
        Its scene, such as of `scenario_view`.
    output : "srgb8", "linear" or "linear16"
    **settings
        Settings of the filter.
    """
    found = []
    for state in (scenario.a, scenario.b):
        with EyeFilter(
            dict(state.profile), view.camera, settings, worker=False
        ) as eye_filter:
            found.append(
                eye_filter.filter(
                    view,
                    pupil_diameter_mm=scenario.pupil_diameter_mm,
                    focus_dpt=scenario.focus_dpt,
                    gaze_deg=scenario.gaze_deg,
                    output=output,
                    whole=True,
                )
            )
    return found[0], found[1]
