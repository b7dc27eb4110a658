"""States A and B of one person, scenarios, typed values and comparisons of widths."""

import base64
import io
import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from clients.acuity_text import acuity_text
from clients.scenarios import scenarios
from clients.web.blur_widths import WIDTHS_ARCMIN, nearest_familiar_object
from clients.web.comparison import differences, joined_png, label_of, short_label_of
from clients.web.controls import (
    AGE,
    AGE_B,
    BY_HAND,
    DISTANCE,
    FOCUS,
    LIGHTS,
    PUPIL,
    distance_text,
    pupil_by_light_mm,
)
from clients.web.page_link import fragment_of, restore
from clients.web.page_state import PageState
from clients.web.page_texts import scenario_text
from clients.web.picture import chart_picture, coarser, png_of, shown_srgb8
from filter_service import RgbdView
from tests.unit.web_parts import a_picture


def _comparing():
    state = PageState(picture=a_picture())
    state.eyes["OD"].texts["sphere_dpt"] = "-2.50"
    state.values[AGE.name] = 61.0
    state.compare(True)
    return state


def test_b_starts_as_a_copy_of_a_and_changes_alone():
    state = _comparing()
    bodies = state.request().bodies
    assert list(bodies) == ["OD", "OD_B"]
    assert bodies["OD"] == bodies["OD_B"]
    assert state.differences() == []
    state.others["OD"].texts["sphere_dpt"] = "0"
    state.values[AGE_B.name] = 70.0
    bodies = state.request().bodies
    assert (bodies["OD"]["sphere_dpt"], bodies["OD_B"]["sphere_dpt"]) == (-2.5, 0.0)
    assert (bodies["OD"]["age_years"], bodies["OD_B"]["age_years"]) == (61.0, 70.0)
    found = {one.path: (one.label, one.a, one.b) for one in state.differences()}
    assert found == {
        "sphere_dpt": ("Sphere", "-2.50 dpt", "0.00 dpt"),
        "age_years": ("Age", "61 years", "70 years"),
    }
    assert state.titles == "right eye, A and B"


def test_states_are_exchanged_with_their_ages():
    state = _comparing()
    state.others["OD"].texts["sphere_dpt"] = "+1.00"
    state.values[AGE_B.name] = 70.0
    before = state.request().bodies
    state.swap()
    after = state.request().bodies
    assert (after["OD"], after["OD_B"]) == (before["OD_B"], before["OD"])


def test_both_eyes_are_not_compared():
    state = _comparing()
    state.shown = "both"
    assert state.names == ("OD", "OS")
    state.compare(True)
    assert state.names == ("OD", "OD_B")


def test_a_link_keeps_both_states():
    state = _comparing()
    state.others["OD"].texts["sphere_dpt"] = "+1.00"
    state.others["OD"].wears_correction = True
    state.arrangement, state.light, state.notation = "beside", "room", "feet"
    again = PageState(picture=a_picture())
    assert restore(again, fragment_of(state, "chart")).problems == []
    assert again.request().bodies == state.request().bodies
    shown = again.arrangement, again.light, again.notation
    assert shown == ("beside", "room", "feet")
    restore(again, fragment_of(PageState(), "courtyard"))
    assert again.names == ("OD",)


def test_a_link_of_version_0_2_shows_one_eye():
    entries = {
        "v": 1,
        "eyes": {"OD": {"texts": {"sphere_dpt": "-3"}}},
        "scene": "chart",
    }
    state = PageState(picture=a_picture())
    fragment = base64.urlsafe_b64encode(json.dumps(entries).encode()).decode()
    found = restore(state, fragment)
    assert (found.scene, found.problems, state.names) == ("chart", [], ("OD",))
    assert state.request().bodies["OD"]["sphere_dpt"] == -3.0


def test_corrections_of_other_kinds_are_one_difference():
    a = {"kind": "prescription", "sphere_dpt": -2.5, "straylight": {}}
    b = a | {"correction": {"kind": "iol", "design": "edof", "add_dpt": 1.75}}
    c = a | {"correction": {"sphere_dpt": -2.0}}
    del b["straylight"]
    found = {one.label: (one.a, one.b) for one in differences(c, b)}
    assert found == {
        "Straylight": ("Of this age", "none"),
        "Correction": (
            "Spectacles, -2.00 dpt",
            "Intraocular lens, extended depth of focus",
        ),
    }
    (one,) = differences(a, c)
    assert (one.path, one.a) == ("correction", "none")
    (power,) = differences(c, a | {"correction": {"sphere_dpt": -1.0}})
    assert power.label == "Sphere of the correction"


@pytest.mark.parametrize("name", scenarios())
def test_a_scenario_sets_both_states_as_they_are_described(name):
    scenario, state = scenarios()[name], PageState(picture=a_picture())
    state.start_scenario(scenario)
    request = state.request()
    for eye, described in (("OD", scenario.a), ("OD_B", scenario.b)):
        body = request.bodies[eye]
        for field, value in described.profile.items():
            if field == "correction":
                value = {"kind": "spectacles", **value}
                found = {"kind": "spectacles", **body[field]}
                assert found.items() >= value.items()
            else:
                assert body[field] == value, field
        assert ("correction" in body) == ("correction" in described.profile)
    assert request.pupil_diameter_mm == scenario.pupil_diameter_mm
    assert request.focus_dpt == pytest.approx(scenario.focus_dpt, abs=1e-4)
    assert state.problems() == []


def test_a_scenario_says_what_was_changed_in_it():
    scenario = scenarios()["cataract_trifocal"]
    text = scenario_text(scenario)
    assert text.startswith("A: Cataract, old spectacles. B: Trifocal implant. Before,")
    assert scenario.leaves_out in text
    text = scenario_text(scenario, ["scene", "entries of B"])
    assert "Changed since: scene, entries of B. As the scenario started: " in text
    assert scenario.sees in text


def test_a_cataract_is_gone_with_the_natural_lens():
    a = {"kind": "prescription", "sphere_dpt": -2.5, "straylight": {}}
    a["straylight"] = {"cataract": "nuclear"}
    b = a | {"correction": {"kind": "iol", "residual_sphere_dpt": 0.0}}
    found = {one.label: (one.a, one.b) for one in differences(a, b)}
    assert found["Straylight"] == ("Nuclear cataract", "gone with the natural lens")
    assert "-2.50 dpt before surgery, correction: Intraocular" in label_of("OD_B", b)
    assert "surgery" not in label_of("OD", a)


def test_additions_of_zones_are_named():
    soft = scenarios()["myopia_soft_lens"]
    labels = [one.label for one in differences(soft.a.profile, soft.b.profile)]
    assert labels == ["Additions of the zones", "Diameters of the zones"]


def test_the_focus_on_a_chart_ends_with_the_chart():
    state, scene = PageState(), replace(a_picture(), focus_dpt=0.5)
    state.set_picture(scene)
    state.set_picture(chart_picture(2.5))
    assert state.values[FOCUS.name] == 2.5
    state.move(FOCUS.name, 3.0)
    state.set_picture(scene)
    assert state.values[FOCUS.name] == 0.5
    state.set_picture(chart_picture(2.5))
    state.values[FOCUS.name], state.keeps_focus = 0.025, True  # by a scenario
    state.set_picture(scene)
    assert state.values[FOCUS.name] == 0.025


@pytest.mark.parametrize(
    ("number", "text", "value"),
    [
        (DISTANCE, "6 m", 1 / 6),
        (DISTANCE, "40cm", 2.5),
        (DISTANCE, "20 ft", 1 / 6.096),
        (DISTANCE, "0,25 dpt", 0.25),
        (FOCUS, "2.5 D", 2.5),
        (PUPIL, "3.5 mm", 3.5),
        (AGE, "61 years", 61.0),
        (AGE, "61", 61.0),
    ],
)
def test_typed_values_may_have_their_unit(number, text, value):
    assert number.read_typed(text) == pytest.approx(value, abs=1e-4)


@pytest.mark.parametrize("text", ["10 cm", "0 m", "far", "", "6 miles"])
def test_a_distance_out_of_range_or_unknown_is_refused(text):
    with pytest.raises(ValueError, match="allowed: 0 to 6 dpt"):
        DISTANCE.read_typed(text)


def test_six_meters_are_shown_as_six():
    assert distance_text(1 / 6).endswith("· 6.0 m")


def test_the_pupil_by_light_is_that_of_the_published_formula():
    """Watson & Yellott 2012, with their example of age and field written out."""
    for light, (_, luminance_cd_m2) in LIGHTS.items():
        if light == BY_HAND:
            continue
        flux = (luminance_cd_m2 * np.pi * 30.0**2 / 846.0) ** 0.41
        young_mm = 7.75 - 5.75 * flux / (flux + 2.0)
        expected_mm = young_mm + (60.0 - 28.58) * (0.02132 - 0.009562 * young_mm)
        found_mm = pupil_by_light_mm(light, 60.0)
        assert found_mm == pytest.approx(np.clip(expected_mm, 2.0, 7.0), abs=0.051)


def test_light_sets_the_pupil_until_the_slider_does():
    state = PageState()
    state.set_light("night")
    wide_mm = state.values[PUPIL.name]
    state.move(AGE.name, 80.0)
    assert state.values[PUPIL.name] < wide_mm
    state.move(PUPIL.name, 3.0)
    assert state.light == BY_HAND
    state.move(AGE.name, 20.0)
    assert state.values[PUPIL.name] == 3.0


@pytest.mark.parametrize(
    ("log_mar", "texts"),
    [
        (0.0, ("1.00", "20/20", "6/6", "0.0")),
        (0.3, ("0.50", "20/40", "6/12", "0.3")),
        (1.0, ("0.10", "20/200", "6/60", "1.0")),
        (-0.1, ("1.26", "20/16", "6/4.8", "−0.1")),
        (0.1, ("0.79", "20/25", "6/7.6", "0.1")),
    ],
)
def test_an_acuity_has_the_usual_texts(log_mar, texts):
    notations = ("decimal", "feet", "meters", "log_mar")
    assert tuple(acuity_text(log_mar, each) for each in notations) == texts


def test_an_unknown_notation_is_refused():
    with pytest.raises(ValueError, match="notation is 'jaeger'; allowed: decimal"):
        acuity_text(0.0, "jaeger")
    with pytest.raises(ValueError, match="log_mar is nan"):
        acuity_text(float("nan"), "feet")


def test_the_whole_prescription_of_a_correction_is_named():
    a = {"kind": "prescription", "sphere_dpt": -3.5, "cylinder_dpt": -1.25}
    lens = {"sphere_dpt": -3.5, "cylinder_dpt": -1.25, "axis_deg": 80.0}
    (one,) = differences(a, a | {"correction": lens})
    assert (one.a, one.b) == ("none", "Spectacles, -3.50 -1.25 x 80°")
    implant = {"kind": "iol", "design": "trifocal", "residual_cylinder_dpt": -0.5}
    implant |= {"residual_axis_deg": 10.0}
    (one,) = differences(a | {"correction": lens}, a | {"correction": implant})
    assert one.b == "Intraocular lens, trifocal, residual 0.00 -0.50 x 10°"
    assert short_label_of("OD_B", a | {"correction": implant}) == "B (trifocal implant)"
    assert short_label_of("OD", a | {"correction": lens}) == "A (spectacles)"
    assert short_label_of("OS", a) == "A (no correction)"


def test_a_night_road_sets_its_light_until_it_is_left():
    state = PageState(picture=a_picture())
    state.values[PUPIL.name] = 3.0
    state.adapt_to("night_road")
    assert state.light == "night"
    assert state.values[PUPIL.name] == pupil_by_light_mm("night", 30.0) > 4.0
    state.adapt_to("courtyard")
    assert (state.light, state.values[PUPIL.name]) == (BY_HAND, 3.0)
    state.keeps_focus = True  # a link or a scenario has its own pupil
    state.adapt_to("night_road")
    assert (state.light, state.values[PUPIL.name]) == (BY_HAND, 3.0)
    state.keeps_focus = False
    state.adapt_to("night_road")
    state.move(PUPIL.name, 6.0)
    state.adapt_to("stairs")
    assert state.values[PUPIL.name] == 6.0  # set by hand


def test_widths_are_compared_in_small_steps():
    sizes = sorted(WIDTHS_ARCMIN.values())
    ratios = np.divide(sizes[1:], sizes[:-1])
    assert sizes[0] <= 0.5
    assert sizes[-1] >= 1200.0
    assert ratios.max() <= 1.5
    assert nearest_familiar_object(1.0) == "the stroke of a fine pen at arm's length"
    assert nearest_familiar_object(7.75) == "half the full moon"
    # a row of a chart would be read as an acuity
    assert not any("line" in name or "letter" in name for name in WIDTHS_ARCMIN)


def test_pictures_are_joined_beside_each_other():
    left, right = (np.full((20, 30, 3), value, np.uint8) for value in (10, 200))
    joined = joined_png([png_of(left), png_of(right)], ["A", "B"])
    with Image.open(io.BytesIO(joined)) as image:
        pixels = np.asarray(image)
    np.testing.assert_array_equal(pixels[:20, :30], left)
    np.testing.assert_array_equal(pixels[:20, -30:], right)


def test_lamps_brighter_than_white_are_shown_white_and_keep_their_light():
    light = np.zeros((4, 4, 3), np.float32)
    light[1, 1] = 100.0
    view = RgbdView(light, np.ones((4, 4), np.float32), (-1.0, 1.0, 1.0, -1.0))
    small = coarser(view, 2)
    assert small.color.max() == pytest.approx(25.0)
    assert shown_srgb8(light).max() == 255
    assert shown_srgb8(light).min() == 0
