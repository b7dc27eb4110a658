"""The person looks: near and far, through a progressive lens, at the chart."""

import json
import re

import pytest


def _chart(page):
    number = page.number()
    page.choose("Letter chart")
    page.settle(after=number)


def _caption(page, text):
    page.page.locator(".oc-caption").get_by_text(re.compile(text)).wait_for()


def test_reading_goes_through_the_addition_and_far_back(page):
    page.press("age_years", "PageUp", 4)  # 70 years: no accommodation
    _chart(page)
    number = page.number()
    page.wear("Progressive spectacles")
    page.settle(after=number)
    page.page.get_by_role("button", name="Reading").click()
    page.page.locator("input[data-name=gaze_v_deg]").and_(
        page.page.locator("[aria-valuetext='-29°']")
    ).wait_for()
    assert page.slider("distance_dpt").input_value() == "2.5"
    assert page.slider("focus_dpt").input_value() == "2.5"
    # 2 dpt of the addition: half a diopter is left
    _caption(page, r"logMAR (−0\.1|0\.[0-5])")
    number = page.number()
    page.entry("add_dpt").fill("0.25")
    page.settle(after=number)
    _caption(page, r"logMAR (1\.0|0\.[6-9])|none of these rows")
    page.page.get_by_role("button", name="Far").click()
    page.page.locator("[aria-valuetext='0°'][data-name=gaze_v_deg]").wait_for()
    _caption(page, r"logMAR (−0\.1|0\.[0-2])")


def test_the_eye_looks_at_a_distance_in_a_scene(page):
    number = page.number()
    page.choose("40 cm")
    assert page.settle(after=number)["wanted_focus_dpt"] == 2.5
    assert page.slider("distance_dpt").is_disabled()
    page.page.locator(".oc-sight").get_by_text("at 40 cm").wait_for()


def test_the_gaze_reaches_from_45_deg_down_to_30_deg_up(page):
    slider = page.slider("gaze_v_deg")
    assert (slider.get_attribute("min"), slider.get_attribute("max")) == ("-45", "30")
    number = page.number()
    page.press("gaze_v_deg", "Home", 1)
    page.settle(after=number)


def test_the_chart_stays_on_the_fovea_when_the_eye_turns(page):
    _chart(page)
    before, number = page.seen(), page.number()
    page.press("gaze_h_deg", "Home", 1)
    page.settle(after=number)
    assert abs(page.seen().astype(int) - before).mean() < 0.1


def test_the_focus_follows_the_distance(page):
    _chart(page)
    number = page.number()
    page.press("distance_dpt", "PageUp", 2)
    told = page.settle(after=number)
    assert told["wanted_focus_dpt"] == pytest.approx(1.25)
    page.press("focus_dpt", "Home", 1)
    number = page.number()
    page.press("distance_dpt", "PageUp", 1)
    told = page.settle(after=number)
    assert told["wanted_focus_dpt"] == 0.0


def test_an_eye_that_reads_no_row_is_told(page):
    _chart(page)
    page.entry("sphere_dpt").fill("-8")
    _caption(page, "Right eye: reads none of these lines")


def test_the_focus_of_a_click_has_two_decimals(page):
    page.press("age_years", "End", 1)
    box, number = page.box(), page.number()
    page.page.mouse.click(
        box["x"] + 0.35 * box["width"], box["y"] + 0.84 * box["height"]
    )
    page.settle(after=number)
    note = page.page.locator(".oc-note").filter(has_text="The eye cannot focus on")
    note.first.wait_for()
    text = note.first.inner_text()
    focus = page.slider("focus_dpt")
    assert re.fullmatch(r"\d\.\d{1,2}", focus.input_value())
    assert re.match(r"(Slightly b|B)lurred at .*: predicted acuity 0\.\d\d\.", text)


def _worn_sphere(page, sphere_dpt):
    """Wait until the correction has a sphere."""
    page.page.wait_for_function(
        f"parseFloat(document.querySelector("
        f"'input[data-worn][data-name=sphere_dpt]')?.value) === {sphere_dpt}"
    )


def test_correct_fully_keeps_a_progressive_lens(page):
    page.entry("sphere_dpt").fill("-2")
    page.wear("Progressive spectacles")
    _worn_sphere(page, -2)  # from the prescription
    page.page.locator("input[data-worn][data-name=add_dpt]").fill("1.5")
    page.entry("sphere_dpt").fill("-3")
    page.page.wait_for_timeout(600)
    page.choose("Correct fully")
    _worn_sphere(page, -3)
    add = page.page.locator("input[data-worn][data-name=add_dpt]")
    assert float(add.input_value()) == 1.5


def test_a_profile_of_the_left_eye_is_loaded_there(page):
    page.choose("File")
    body = {"kind": "prescription", "sphere_dpt": -4, "eye_side": "OS"}
    page.page.locator(".oc-eye input[type=file]").first.set_input_files(
        {
            "name": "left.json",
            "mimeType": "application/json",
            "buffer": json.dumps(body).encode(),
        }
    )
    page.page.get_by_text("left.json is a profile of the left eye").wait_for()
    page.page.get_by_role("button", name="Left eye", pressed=True).wait_for()
    left = page.page.locator("[data-eye-panel=OS]")
    left.get_by_text("Loaded: left.json").wait_for()
    assert left.locator("input[data-name=sphere_dpt]").input_value() == "-4.00"


def test_a_typed_prescription_is_taken_by_enter(page):
    number = page.number()
    entry = page.entry("sphere_dpt")
    entry.fill("")
    entry.press_sequentially("-3.5 -1.25", delay=30)
    page.page.wait_for_timeout(900)  # a pause in the middle
    assert page.page.locator(".oc-entry.q-field--error").count() == 0
    assert page.page.locator(".oc-problem:visible").count() == 0
    entry.press_sequentially(" x 80", delay=30)
    entry.press("Enter")
    page.settle(after=number)
    page.page.wait_for_function(
        "['sphere_dpt', 'cylinder_dpt', 'axis_deg'].map(name => "
        "document.querySelector(`input[data-name=${name}]`).value).join(' ')"
        " === '-3.50 -1.25 80'"
    )
    page.entry("sphere_dpt").fill("-3.5 -1.25")
    page.entry("sphere_dpt").press("Enter")
    page.page.get_by_text("“-3.5 -1.25” is not a number").first.wait_for()


def test_a_pasted_prescription_fills_its_entries(page):
    page.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.page.evaluate("navigator.clipboard.writeText('-3.5 -1.25 x 80')")
    number = page.number()
    page.entry("sphere_dpt").focus()
    page.page.keyboard.press("Control+a")
    page.page.keyboard.press("Control+v")
    page.settle(after=number)
    page.page.wait_for_function(
        "['sphere_dpt', 'cylinder_dpt', 'axis_deg'].map(name => "
        "document.querySelector(`input[data-name=${name}]`).value).join(' ')"
        " === '-3.50 -1.25 80'"
    )
