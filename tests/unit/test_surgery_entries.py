"""Implants, laser surgery, haze and yellowing as entries of the page."""

import base64
import json

import numpy as np
import pytest

from clients.web.eye_form import EyeForm
from clients.web.page_link import fragment_of, restore
from clients.web.page_state import PageState
from estimator import parse_profile
from estimator.estimate.model import eye_model

AGE = 68.0
OLD_IMPLANT = {"kind": "iol", "design": "bifocal", "add_dpt": 3.0, "sphere_dpt": 0.5}


def myope():
    form = EyeForm("OD")
    form.texts |= {"sphere_dpt": "-2.50", "vertex_mm": "0"}
    return form


def test_a_myope_gets_a_trifocal_implant_for_far_vision():
    """-2.50 stays the eye before surgery; nothing remains after it."""
    form = myope()
    before = eye_model(parse_profile(form.body(age_years=AGE)))
    form.correct_fully()
    form.choose_worn("iol")
    form.worn.design = "trifocal"
    body = form.body(age_years=AGE)
    assert body["sphere_dpt"] == -2.5
    assert body["correction"]["residual_sphere_dpt"] == 0.0
    assert "sphere_dpt" not in body["correction"]
    after = eye_model(parse_profile(body))
    assert after.eye_length_mm == before.eye_length_mm
    seen_dpt = after.accommodating.refraction_at_dpt(
        pupil_diameter_mm=4.0, accommodation_dpt=0.0
    )
    assert seen_dpt == pytest.approx(0.0, abs=0.02)


def test_a_residual_refraction_stays_while_the_surgery_is_compared():
    form = myope()
    form.wears_correction = True
    form.choose_worn("iol")
    form.worn.texts["residual_sphere_dpt"] = "-1.00"
    form.choose_worn("laser")
    assert form.body(age_years=AGE)["correction"] == {
        "kind": "laser",
        "residual_sphere_dpt": -1.0,
        "residual_cylinder_dpt": 0.0,
        "residual_axis_deg": 0.0,
        "spherical_aberration_um": 0.0,
    }
    form.choose_worn("spectacles")
    form.choose_worn("iol")
    assert form.worn.texts["residual_sphere_dpt"] == "0.00"


def test_an_implant_of_a_profile_of_version_0_2_keeps_its_meaning():
    body = {"kind": "prescription", "sphere_dpt": -2.5, "correction": OLD_IMPLANT}
    form = EyeForm("OD")
    form.load_body(body, "p.json")
    assert form.worn.kind == "file"
    assert not form.applies_higher_order
    found = parse_profile(form.body(age_years=AGE))
    expected = parse_profile(body | {"age_years": AGE, "vertex_mm": 0.0})
    assert found.digest == expected.digest
    form.wears_correction = False
    assert form.applies_higher_order


def test_a_link_of_version_0_2_keeps_its_meaning():
    texts = {"sphere_dpt": "+0.50", "cylinder_dpt": "0.00", "axis_deg": "0"}
    texts |= {"vertex_mm": "12", "add_dpt": "+3.00", "spherical_aberration_um": "0.00"}
    worn = {"kind": "iol", "design": "bifocal", "texts": texts}
    eye = {"texts": {"sphere_dpt": "-2.50", "vertex_mm": "0"}, "correction": worn}
    entries = {"v": 1, "eyes": {"OD": eye}, "values": {"age_years": AGE}}
    text = base64.urlsafe_b64encode(json.dumps(entries).encode()).decode().rstrip("=")
    state = PageState()
    assert restore(state, text).problems == []
    body = {"kind": "prescription", "sphere_dpt": -2.5, "correction": OLD_IMPLANT}
    expected = parse_profile(body | {"age_years": AGE, "vertex_mm": 0.0})
    found = parse_profile(state.eyes["OD"].body(age_years=AGE))
    assert found.digest == expected.digest


def test_a_link_keeps_residual_haze_and_yellowing():
    state = PageState()
    form = state.eyes["OD"]
    form.haze, form.yellowing = "measured", "adapted"
    form.media_texts["log_s"] = "1.40"
    form.wears_correction = True
    form.choose_worn("iol")
    form.worn.texts["residual_sphere_dpt"] = "-0.50"
    again = PageState()
    assert restore(again, fragment_of(state, "Courtyard")).problems == []
    assert again.eyes["OD"] == form


def test_the_cataract_has_haze_and_says_how_much():
    form = EyeForm("OD", source="preset")
    assert form.haze_text(age_years=AGE) == ""
    assert form.choose_preset("cataract", age_years=30.0) == 72.0
    haze = parse_profile(form.body(age_years=AGE)).straylight
    assert haze.log_s == 1.48  # J. Ophthalmol. 2017, 5649532
    assert form.yellowing == "seen"
    by_age, young = ((1.0 + (age / 65.0) ** 4) for age in (AGE, 25.0))
    times = 10.0 ** (1.48 - 0.87) / np.array([young, by_age])
    percent = 100.0 * haze.fraction
    assert form.haze_text(age_years=AGE) == (
        f"{percent:.0f} % of the light is scattered over the scene: {times[0]:.1f} "
        f"times as much as in a young eye, and {times[1]:.1f} times as much as is "
        "usual at this age (log s 1.48 at 7°)."
    )
    form.haze = "nuclear"  # a published mean of mild cataracts
    assert "healthy eye of about 70" in form.haze_text(age_years=72.0)
    assert "healthy eye of about 70" not in form.haze_text(age_years=40.0)
    assert not form.is_before_surgery
    form.wears_correction = True
    form.choose_worn("iol")
    assert form.is_before_surgery
    text = form.haze_text(age_years=AGE)
    assert text.startswith("The cataract is gone with the natural lens; ")
    assert "1.0 times as much as is usual" in text
    assert form.choose_preset("myopia", age_years=72.0) == 30.0
    assert (form.haze, form.yellowing) == ("none", "none")


@pytest.mark.parametrize(
    ("straylight", "haze"),
    [
        ({}, "age"),
        ({"cataract": "cortical"}, "cortical"),
        ({"log_s": 1.3}, "measured"),
        (None, "none"),
    ],
)
def test_haze_of_a_profile_fills_the_entries(straylight, haze):
    body = {"kind": "preset", "name": "myopia", "yellowing": "adapted"}
    body |= {"age_years": AGE, "straylight": straylight}
    form = EyeForm("OD")
    form.load_body(body, "p.json")
    assert (form.source, form.haze, form.yellowing) == ("preset", haze, "adapted")
    digests = {parse_profile(b).digest for b in (body, form.body(age_years=AGE))}
    assert len(digests) == 1


def test_measured_haze_starts_as_that_of_the_choice_before():
    form = EyeForm("OD", source="preset", haze="posterior_subcapsular")
    form.choose_haze("measured", age_years=AGE)
    assert form.body(age_years=AGE)["straylight"] == {"log_s": 1.48}
    form.choose_haze("age", age_years=80.0)
    form.choose_haze("measured", age_years=80.0)
    assert form.media_texts["log_s"] == "1.39"
    form.choose_haze("none", age_years=80.0)
    form.choose_haze("measured", age_years=30.0)
    assert form.media_texts["log_s"] == "1.39"  # as it was typed last


def test_haze_that_the_entries_cannot_show_stays_in_the_profile():
    body = {"kind": "prescription", "sphere_dpt": -1, "straylight": {"pigmentation": 1}}
    form = EyeForm("OD")
    form.load_body(body, "p.json")
    assert form.source == "file"
    assert form.body(age_years=AGE)["straylight"] == {"pigmentation": 1}


def test_a_wrong_straylight_is_said():
    form = EyeForm("OD", haze="measured", media_texts={"log_s": "9"})
    with pytest.raises(ValueError, match=r"9 is out of range; allowed: 0\.5 to 1\.9"):
        form.body(age_years=AGE)
    assert form.haze_text(age_years=AGE) == ""


def test_an_implant_of_a_preset_keeps_its_measured_wavefront():
    form = EyeForm("OD", source="preset", preset="keratoconus", wears_correction=True)
    form.choose_worn("iol")
    profile = parse_profile(form.body(age_years=AGE))
    bare = parse_profile({"kind": "preset", "name": "keratoconus"})
    assert np.array_equal(profile.zernike_um, bare.zernike_um)
