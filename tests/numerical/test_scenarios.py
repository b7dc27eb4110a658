"""Scenarios: each figure against an independent one, and what the list contains."""

import math

import numpy as np
import pytest

from clients.figures.defocus import field_defocus_dpt
from clients.scenarios import CHART, scenarios
from clients.scenes.catalog import SCENE_BUILDERS
from estimator import Eye, parse_profile
from estimator.corrections.worn_lens import TEAR_FILM_RATIO
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


def cone(*, has_lens: bool, coma_mm: float):
    """An eye whose cornea has coma, trefoil and astigmatism, bare or behind a lens."""
    offset_mm = np.zeros(28)
    offset_mm[[5, 6, 7]] = coma_mm / 2.0, -coma_mm / 2.0, coma_mm
    eye = [
        {"radius_mm": 7.8, "z_mm": 0.0, "medium_after": "cornea"},
        {"radius_mm": 6.5, "z_mm": 0.55, "medium_after": "aqueous"},
        {"radius_mm": 10.2, "z_mm": 3.6, "medium_after": "lens"},
        {"radius_mm": -6.0, "z_mm": 7.6, "medium_after": "vitreous"},
    ]
    eye[0]["offset_mm"] = offset_mm.tolist()
    lens = [
        {"radius_mm": 7.9, "z_mm": -0.2, "medium_after": "plastic"},
        {"radius_mm": 7.8, "z_mm": -0.05, "medium_after": "tears"},
    ]
    indices = {"cornea": 1.376, "aqueous": 1.336, "lens": 1.42, "vitreous": 1.336}
    return Eye(
        {
            "kind": "surfaces",
            "surfaces": [*lens, *eye] if has_lens else eye,
            "stop_z_mm": 3.6,
            "retina": {"radius_mm": -12.0, "z_mm": 24.0},
            "indices": indices | {"plastic": 1.45, "tears": 1.336},
        }
    )


def test_rays_through_a_tear_film_leave_as_much_as_is_assumed():
    bare, behind = (
        cone(has_lens=has_lens, coma_mm=0.004).wavefront(pupil_diameter_mm=4.0).values
        - cone(has_lens=has_lens, coma_mm=0.0).wavefront(pupil_diameter_mm=4.0).values
        for has_lens in (False, True)
    )
    assert np.linalg.norm(bare[5:10]) > 0.03
    left = float(behind @ bare / (bare @ bare))
    # The lens and its distance from the pupil change the size of the light's path.
    assert left == pytest.approx(TEAR_FILM_RATIO, abs=0.004)
    assert np.linalg.norm(behind - left * bare) < 0.1 * np.linalg.norm(behind)


def test_defocus_is_positive_in_front_of_the_retina():
    myope = {"kind": "prescription", "sphere_dpt": -1, "age_years": 30}
    at = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.0}
    axis = {"h_deg": np.array([0.0]), "v_deg": np.array([0.0])}
    found = field_defocus_dpt(parse_profile(myope), **at, **axis)
    assert found == pytest.approx(1.0, abs=0.01)
    zones = {"zone_adds_dpt": [0, 2], "zone_diameters_mm": [2, 8]}
    lens = {"kind": "contact_lens", "sphere_dpt": -1, **zones}
    found = field_defocus_dpt(parse_profile(myope | {"correction": lens}), **at, **axis)
    # A pupil of 4 mm has three quarters of its area outside a zone of 2 mm.
    assert found == pytest.approx(0.75 * 2.0, abs=0.03)
