"""What is typed on the page becomes a profile, or an explanation."""

import base64
import json

import pytest

from clients.web.controls import (
    AGE,
    AXIS,
    CONDITIONS,
    DISTANCE,
    FOCUS,
    GAZE_V,
    SPHERE,
    distance_text,
    prescription_texts,
)
from clients.web.correction_hints import (
    KEPT_ABERRATIONS,
    additions_text,
    correction_hint,
)
from clients.web.eye_form import (
    DESIGNS,
    KINDS,
    SURGERIES,
    CorrectionForm,
    EyeForm,
    preset_titles,
)
from clients.web.page_link import fragment_of, restore
from clients.web.page_state import PageState
from clients.web.picture import chart_picture
from estimator import parse_profile, preset_names
from tests.unit.web_parts import a_picture


@pytest.mark.parametrize(
    ("text", "value"), [("-2,5", -2.5), (" +1.25 ", 1.25), ("−6", -6.0), ("0", 0.0)]
)
def test_numbers_are_read_as_people_write_them(text, value):
    assert SPHERE.read(text) == value


@pytest.mark.parametrize(
    ("field", "text", "said"),
    [
        (SPHERE, "abc", "“abc” is not a number; allowed: −30 to 30 dpt"),
        (SPHERE, "-31", "-31 is out of range; allowed: −30 to 30 dpt"),
        (SPHERE, "nan", "“nan” is not a number; allowed: −30 to 30 dpt"),
        (SPHERE, "", "Sphere is empty; allowed: −30 to 30 dpt"),
        (AXIS, "181", "181 is out of range; allowed: 0 to 180°"),
    ],
)
def test_a_wrong_entry_is_told_with_what_is_allowed(field, text, said):
    assert field.problem(text) == said


def test_arrow_keys_step_within_what_is_allowed():
    assert SPHERE.normalized("-2.5", 1) == "-2.25"
    assert SPHERE.normalized("0", 1) == "+0.25"
    assert SPHERE.normalized("30", 1) == "+30.00"
    assert SPHERE.normalized("abc", 1) == "abc"


def test_a_distance_is_told_as_people_say_it():
    assert distance_text(0.0) == "0 dpt · far away"
    assert distance_text(4.0) == "4.00 dpt · 25 cm"
    assert distance_text(0.25) == "0.25 dpt · 4.0 m"


def test_the_entries_become_a_profile_with_what_is_worn():
    form = EyeForm("OS", has_higher_order=False)
    form.texts.update(sphere_dpt="-6", cylinder_dpt="-3", axis_deg="102")
    form.correct_fully()
    body = form.body(age_years=40.0)
    worn = {
        "sphere_dpt": -6.0,
        "cylinder_dpt": -3.0,
        "axis_deg": 102.0,
        "vertex_mm": 12.0,
    }
    assert body == {
        "kind": "prescription",
        "higher_order": "none",
        "age_years": 40.0,
        "eye_side": "OS",
        **worn,
        "correction": worn,
    }


def test_a_wrong_worn_entry_is_told_as_such():
    form = EyeForm("OD", wears_correction=True)
    form.worn.texts["axis_deg"] = "200"
    with pytest.raises(ValueError, match=r"Worn correction: Axis: 200 is out of range"):
        form.body(age_years=30.0)


@pytest.mark.parametrize("source", ["prescription", "preset"])
@pytest.mark.parametrize(
    ("kind", "design"),
    [(kind, "monofocal") for kind in KINDS] + [("iol", name) for name in DESIGNS],
)
def test_every_lens_of_the_page_is_one_that_a_profile_may_have(kind, design, source):
    form = EyeForm("OD", source=source, wears_correction=True)
    form.worn.kind, form.worn.design = kind, design
    powers = {"cylinder_dpt": "-1.00", "axis_deg": "20"}
    is_surgery = kind in SURGERIES
    form.worn.texts |= {
        f"residual_{name}" if is_surgery else name: text
        for name, text in powers.items()
    }
    body = form.body(age_years=70.0)
    found = parse_profile(body)
    assert (found.surgery if is_surgery else found.correction) is not None
    again = EyeForm("OD")
    again.load_body(body, "p.json")
    assert again.worn == form.worn


def test_a_lens_that_the_page_has_no_entries_for_stays_as_it_is():
    zones = {"kind": "iol", "design": "zones", "zone_adds_dpt": [2, 0]}
    zones["zone_diameters_mm"] = [1.5, 6]
    form = CorrectionForm()
    form.take(zones)
    assert form.body() == zones
    assert "file" in form.kinds
    assert form.entries == ()
    assert "file" not in CorrectionForm().kinds


def test_additions_that_no_lens_can_have_are_told():
    form = EyeForm("OD", wears_correction=True)
    form.worn.kind, form.worn.design = "iol", "bifocal"
    form.worn.texts["add_dpt"] = "7"
    with pytest.raises(
        ValueError,
        match=r"Worn correction: Addition: 7 is out of range; allowed: 0\.5 to 6 dpt",
    ):
        form.body(age_years=70.0)
    form.worn.design = "trifocal"
    form.worn.texts["middle_add_dpt"] = "3.1"
    with pytest.raises(ValueError, match="a ratio of whole numbers"):
        form.body(age_years=70.0)


def test_the_gaze_slider_turns_a_progressive_lens_of_the_figures():
    state = PageState(picture=a_picture())
    form = state.eyes["OD"]
    form.wears_correction, form.worn.kind = True, "progressive"
    state.values[GAZE_V.name] = -15.0
    request = state.request()
    assert "gaze_deg" not in request.bodies["OD"]["correction"]  # the settings have it
    seen = parse_profile(state.profile_at_gaze("OD")).correction
    # 25.5 mm before the center of rotation 15 deg are 6.8 mm, half of the corridor
    assert seen.sphere_dpt == pytest.approx(2.0 / 2, abs=0.15)
    form.worn.kind = "contact_lens"
    state.request()
    assert state.profile_at_gaze("OD") == state.valid_profiles["OD"]


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_may_be_chosen(name):
    assert name in preset_titles()
    form = EyeForm("OS", source="preset", preset=name)
    assert parse_profile(form.body(age_years=30.0)).eye_side == "OS"


def test_a_file_is_taken_as_what_it_is():
    state = PageState()
    form = state.eyes["OD"]
    body = {"kind": "prescription", "sphere_dpt": -3, "age_years": 52}
    assert state.load_file("OD", "p.json", json.dumps(body).encode()) == "OD"
    assert state.values[AGE.name] == 52
    assert (form.source, form.loaded_name) == ("prescription", "p.json")
    assert (form.source, form.texts["sphere_dpt"]) == ("prescription", "-3.00")
    wave = {
        "kind": "zernike",
        "pupil_diameter_mm": 5,
        "wavelength_nm": 555,
        "zernike_um": {"2,0": 1.0},
    }
    state.load_file("OD", "w.json", json.dumps(wave).encode())
    assert (form.source, form.file_name) == ("file", "w.json")
    assert form.body(age_years=30.0)["zernike_um"] == {"2,0": 1.0}


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("p.exe", b"", r"'p.exe': not a profile; allowed: .json, .abp, .csv, .zmx"),
        ("p.json", b"{", r"not JSON.*allowed: one JSON object"),
        (
            "p.json",
            b'{"kind": "cat"}',
            r"'p.json': kind: 'cat' is unknown.*prescription",
        ),
        ("p.csv", b"\xff\xfe\x00", r"is not a text file"),
        ("my eye.csv", b"n;m", r"'my eye.csv': line 1.*allowed: the columns n,m,um"),
        ("o.abp", b"Ap = 6,0,1", r"'o.abp': line 1: '6,0,1' is not.*as -0.25"),
    ],
)
def test_a_file_that_is_no_profile_changes_nothing(name, content, said):
    state = PageState()
    with pytest.raises(ValueError, match=said) as refused:
        state.load_file("OD", name, content)
    assert state == PageState()
    assert "/ocufilter-" not in str(refused.value)


def test_coefficients_are_called_as_their_file_is():
    state = PageState()
    state.load_file("OD", "my eye.abp", b"Ap = 6\nWa = 555\nZ[2, 0] = 1")
    assert state.eyes["OD"].body(age_years=30.0)["name"] == "my eye.abp"


def test_a_wrong_entry_leaves_the_eye_as_it_was_and_the_sliders_alive():
    state = PageState(picture=a_picture())
    first = state.request()
    state.eyes["OD"].texts["sphere_dpt"] = "abc"
    state.values[FOCUS.name] = 1.0
    second = state.request()
    assert second.bodies == first.bodies
    assert (second.focus_dpt, second.number) == (1.0, first.number + 1)
    (problem,) = state.problems()
    assert problem.startswith("Right eye: Sphere: “abc” is not a number")


def test_both_eyes_are_asked_for_with_the_age_of_the_person():
    state = PageState(picture=a_picture(), shown="both")
    state.values[AGE.name] = 61.0
    bodies = state.request().bodies
    assert {side: body["eye_side"] for side, body in bodies.items()} == {
        "OD": "OD",
        "OS": "OS",
    }
    assert {body["age_years"] for body in bodies.values()} == {61.0}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("-3.5 -1.25 x 80", ("-3.5", "-1.25", "80")),
        ("−3,50/−1,25×80°", ("-3.50", "-1.25", "80")),
        ("+2 -0.75 axis 5", ("+2", "-0.75", "5")),
        ("-3.5-1.25@180", ("-3.5", "-1.25", "180")),
        ("-3.5", None),
        ("-3.5 -1.25", None),
        ("-3.5 x 80", None),
        ("a b c", None),
    ],
)
def test_a_whole_prescription_is_read(text, found):
    assert prescription_texts(text) == found


def test_correcting_fully_keeps_the_kind_of_lens_and_its_addition():
    form = EyeForm("OD", wears_correction=True)
    form.texts.update(sphere_dpt="-3", cylinder_dpt="-1", axis_deg="20")
    form.worn.kind = "progressive"
    form.worn.texts["add_dpt"] = "+2.50"
    form.correct_fully()
    worn = form.body(age_years=60.0)["correction"]
    assert (worn["kind"], worn["add_dpt"]) == ("progressive", 2.5)
    assert (worn["sphere_dpt"], worn["cylinder_dpt"], worn["axis_deg"]) == (-3, -1, 20)


def test_a_contact_lens_that_corrects_fully_has_the_powers_at_the_cornea():
    form = EyeForm("OD", wears_correction=True)
    form.texts.update(sphere_dpt="-10", cylinder_dpt="-2", vertex_mm="12")
    form.worn.kind = "contact_lens"
    form.correct_fully()
    worn = form.body(age_years=30.0)["correction"]
    # 1 / (1 / -10 - 0.012) = -8.93 and 1 / (1 / -12 - 0.012) = -10.49
    assert worn["sphere_dpt"] == pytest.approx(-8.93)
    assert worn["cylinder_dpt"] == pytest.approx(-1.56)


def test_progressive_spectacles_start_from_the_prescription():
    form = EyeForm("OD", wears_correction=True)
    form.texts.update(sphere_dpt="-3", cylinder_dpt="-1", axis_deg="20")
    form.choose_worn("progressive")
    assert form.worn.texts["sphere_dpt"] == "-3"
    form.worn.texts["sphere_dpt"] = "-2.50"  # typed: another kind keeps it
    form.choose_worn("lenslets")
    assert form.worn.texts["sphere_dpt"] == "-2.50"


def test_looking_to_read_turns_the_gaze_to_the_addition():
    state = PageState(picture=a_picture())
    form = state.eyes["OD"]
    form.wears_correction, form.worn.kind = True, "progressive"
    state.request()
    state.look(is_reading=True)
    # the corridor of 14 mm ends 25.5 mm before the center of rotation
    assert state.values[GAZE_V.name] == -29.0
    seen = parse_profile(state.profile_at_gaze("OD")).correction
    assert seen.sphere_dpt == pytest.approx(2.0, abs=0.05)
    state.look(is_reading=False)
    assert (state.values[GAZE_V.name], state.values[FOCUS.name]) == (0.0, 0.0)


def test_a_chart_stays_on_the_line_of_sight():
    state = PageState(picture=chart_picture(0.25))
    form = state.eyes["OD"]
    form.wears_correction, form.worn.kind = True, "progressive"
    state.move(GAZE_V.name, -29.0)
    request = state.request()
    assert request.gaze_deg == state.picture_gaze_deg == (0.0, 0.0)
    assert request.bodies["OD"]["correction"]["gaze_deg"] == [0.0, -29.0]
    state.set_picture(a_picture())
    assert state.request().gaze_deg == (0.0, -29.0)


def test_the_focus_follows_the_distance_until_it_is_set():
    state = PageState()
    state.set_picture(chart_picture(0.25))
    assert state.values[FOCUS.name] == 0.25
    state.move(DISTANCE.name, 2.5)
    assert state.values[FOCUS.name] == 2.5
    state.move(FOCUS.name, 1.0)
    state.move(DISTANCE.name, 3.0)
    assert state.values[FOCUS.name] == 1.0
    again = PageState()
    restore(again, fragment_of(state, "chart"))
    again.set_picture(chart_picture(3.0))
    assert again.values[FOCUS.name] == 1.0


def test_the_pipeline_is_in_requests_and_links():
    state = PageState()
    assert (
        '"pipeline"'
        not in base64.urlsafe_b64decode(fragment_of(state, "courtyard") + "==").decode()
    )
    state.set_picture(a_picture())
    assert state.request().pipeline == "exact"
    state.pipeline = "published"
    again = PageState(picture=a_picture())
    restore(again, fragment_of(state, "courtyard"))
    assert again.request().pipeline == "published"
    again.reset()
    assert again.pipeline == "exact"
    text = json.dumps({"v": 1, "pipeline": "best"}).encode()
    restore(again, base64.urlsafe_b64encode(text).decode())
    assert again.pipeline == "exact"


def test_a_click_focuses_on_a_rounded_distance():
    state = PageState()
    state.set_picture(a_picture())  # 2 m away on the axis
    state.look_at(0.0, 0.0)
    focus_dpt = state.values[FOCUS.name]
    assert focus_dpt == round(focus_dpt, 2)
    assert focus_dpt == pytest.approx(0.5, abs=0.01)


def test_a_file_of_the_other_eye_is_loaded_there():
    state = PageState()
    state.eyes["OD"].source = "file"
    body = {"kind": "prescription", "sphere_dpt": -3, "eye_side": "OS"}
    assert state.load_file("OD", "p.json", json.dumps(body).encode()) == "OS"
    assert state.eyes["OS"].texts["sphere_dpt"] == "-3.00"
    assert state.eyes["OD"] == EyeForm("OD")


@pytest.mark.parametrize("number", CONDITIONS, ids=lambda number: number.name)
def test_a_link_has_every_condition_and_a_new_page_its_initial_value(number):
    state, again = PageState(), PageState()
    state.values[number.name] = number.high
    restore(again, fragment_of(state, "courtyard"))
    assert again.values == state.values != PageState().values
    again.reset()
    assert again.values[number.name] == number.initial


def test_a_link_sets_all_entries_also_those_that_it_leaves_out():
    state = PageState()
    state.eyes["OD"].texts["sphere_dpt"] = "-3"
    state.shown = "both"
    found = restore(state, fragment_of(PageState(), "courtyard"))
    assert state == PageState()
    assert (found.scene, found.problems) == ("courtyard", [])


@pytest.mark.parametrize(
    "entries",
    [
        {"values": {"pupil_diameter_mm": 10**400}},
        {"values": {"pupil_diameter_mm": 10**18}},
        {"values": {"focus_dpt": float("nan"), "age_years": 1e308}},
        {"values": [12, {}], "shown": ["both"], "scene": {}},
        {"eyes": {"OD": {"preset": ["myopia"], "source": {}}}},
        {"eyes": {"OD": {"preset": {"a": 1}, "texts": {"sphere_dpt": [1]}}}},
        {"eyes": {"OD": {"correction": {"kind": [], "design": {}}}}},
        {"eyes": {"OD": {"correction": {"kind": "iol", "design": ["trifocal"]}}}},
        {"eyes": {"OD": {"correction": {"kind": "iol", "texts": {"add_dpt": {}}}}}},
        {"eyes": {"OD": json.loads("[" * 30 + "]" * 30)}},
        {"eyes": {"OD": {"texts": {"sphere_dpt": "\ud800"}}}},
    ],
)
def test_a_link_of_other_types_is_told_and_changes_nothing(entries):
    state = PageState()
    text = json.dumps({"v": 1, **entries}).encode()
    found = restore(state, base64.urlsafe_b64encode(text).decode())
    assert all(isinstance(problem, str) for problem in found.problems)
    assert state.values == PageState().values
    assert [form.preset for form in state.eyes.values()] == ["myopia", "myopia"]
    assert state.eyes["OD"].texts == EyeForm("OD").texts
    fragment_of(state, "chart")
    state.problems()


@pytest.mark.parametrize(
    "text", [b"[" * 3000, b"\xff", b"5", b"{}", b'{"v": NaN}', b""]
)
def test_a_link_that_is_none_is_told(text):
    found = restore(PageState(), base64.urlsafe_b64encode(text).decode())
    assert found.scene is None
    assert "no entries" in found.problems[0]


def test_an_addition_at_the_implant_is_told_as_one_in_spectacles():
    form = EyeForm("OD", wears_correction=True)
    form.worn.kind, form.worn.design = "iol", "bifocal"
    form.worn.texts["add_dpt"] = "4"
    # Gaussian optics of a cornea of 43.04 dpt, a lens 4.6 mm behind it, an entrance
    # pupil 3.05 mm behind it and spectacles 12 mm before it
    at_pupil_dpt = 4.0 * (1.0 - 0.0046 / 1.3386 * 43.04) ** 2
    near_m = 1.0 / at_pupil_dpt
    worn_dpt = 1.0 / (near_m - 0.01505)
    text = additions_text(form, age_years=70.0)
    assert f"spectacles: {worn_dpt:+.2f} dpt, for {100.0 * near_m:.0f} cm" in text
    form.worn.design = "monofocal"
    assert additions_text(form, age_years=70.0) == ""


@pytest.mark.parametrize("kind", SURGERIES)
def test_surgery_of_an_eye_of_surfaces_is_refused_in_a_sentence(kind):
    form = EyeForm("OD", wears_correction=True)
    form.load_body({"kind": "synteyes", "sample": 3}, "eye.json")
    form.worn.kind = kind
    with pytest.raises(
        ValueError, match=r"^Surgery cannot be computed .* prescription"
    ):
        form.body(age_years=70.0)
    form.worn.kind = "spectacles"
    assert form.body(age_years=70.0)["kind"] == "synteyes"
    assert KEPT_ABERRATIONS not in correction_hint(form)
