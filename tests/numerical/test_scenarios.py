"""Scenarios: each figure against an own calculation, and what the list contains."""

import math

import numpy as np
import pytest

from clients.scenarios import CHART, scenarios
from clients.scenes.catalog import SCENE_BUILDERS
from estimator import parse_profile
from tests.scenario_truth import Figure, figures

AT_LENGTH = {"night_driving", "night_trifocal"}
"""Scenarios whose figure takes sums over a whole picture or point image."""


def _case(figure: Figure):
    marks = [pytest.mark.clients] if figure.scenario in AT_LENGTH else []
    name = f"{figure.scenario}: {figure.name}, {figure.reference}"
    return pytest.param(figure, id=name, marks=marks)


@pytest.mark.parametrize("figure", [_case(figure) for figure in figures()])
def test_the_main_figure_is_that_of_an_own_calculation(figure):
    expected = figure.expected()
    assert figure.found() == pytest.approx(expected, abs=figure.tolerance)


def test_every_scenario_has_a_figure_and_a_scene():
    assert {figure.scenario for figure in figures()} == set(scenarios())
    for name, one in scenarios().items():
        assert one.scene in (CHART, *SCENE_BUILDERS), name
        assert one.differing_entries, name
        for state in (one.a, one.b):
            assert parse_profile(dict(state.profile)).age_years, name
        for text in (one.sees, one.leaves_out):
            assert text.endswith(".") and text.count(". ") == 0, name


@pytest.mark.parametrize("name", sorted(scenarios()))
def test_pupils_are_those_of_the_luminance(name):
    """Watson and Yellott 2012, both eyes, a field of 20 x 20 to 30 x 30 degrees."""
    one = scenarios()[name]
    found = []
    for area_deg2 in (400.0, 1000.0):
        flux = (one.luminance_nit * area_deg2 / 846.0) ** 0.41
        unaged_mm = 7.75 - 5.75 * flux / (flux + 2.0)
        years = one.a.profile["age_years"] - 28.58
        found.append(unaged_mm + years * (0.02132 - 0.009562 * unaged_mm))
    assert min(found) - 0.3 < one.pupil_diameter_mm < max(found) + 0.3


def test_a_scenario_looks_at_a_distance():
    one = scenarios()["reading"]
    assert one.focus_dpt == pytest.approx(2.5)
    assert all(math.isfinite(each.focus_dpt) for each in scenarios().values())
    assert np.all([each.distance_m > 0.0 for each in scenarios().values()])
