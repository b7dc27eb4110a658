"""States A and B of one person, scenarios, typed values, sizes of what is pressed."""

import io
import re

import numpy as np
import pytest
from PIL import Image

from clients.scenarios import scenarios
from tests.web.test_accessibility import violations

CROSSING = """() => {
  const inner = [...document.querySelectorAll('main .q-btn__content')]
    .filter(element => element.offsetParent !== null);
  return inner.filter(element => {
    const button = element.closest('.q-btn').getBoundingClientRect();
    const range = document.createRange();
    range.selectNodeContents(element);
    const text = range.getBoundingClientRect();
    return text.left < button.left - 1 || text.right > button.right + 1;
  }).map(element => element.innerText);
}"""
"""Labels that are wider than their buttons."""

B = "[data-eye-panel=OD_B]"

SIZES = """() => [...document.querySelectorAll(
    'main button, main input, main [role=slider], main [role=combobox], nav button')]
  .filter(element => element.offsetParent !== null)
  .map(element => element.closest('.q-field, .q-toggle') ?? element)
  .filter(element => !element.matches('.oc-split'))
  .map(element => {
    const {width, height} = element.getBoundingClientRect();
    return [element.innerText || element.ariaLabel || element.className, width, height];
  })"""


def _compare(page):
    number = page.number()
    page.page.get_by_text("Compare A | B").click()
    page.settle(after=number, eye="OD_B")


def _detail(picture):
    return np.abs(np.diff(picture.astype(int), axis=1)).mean()


def test_two_states_are_behind_one_divider_and_differ_where_they_are_marked(page):
    alone = page.seen()
    _compare(page)
    np.testing.assert_array_equal(
        page.seen("OD_B", "before"), alone
    )  # A is on the left
    number = page.number()
    page.page.locator(f"{B} input[data-name=sphere_dpt]").first.fill("-3")
    page.settle(after=number, eye="OD_B")
    a, b = page.seen("OD_B", "before"), page.seen("OD_B", "after")
    np.testing.assert_array_equal(a, alone)
    assert _detail(b) < 0.8 * _detail(a)
    marked = page.page.locator(f"{B} .oc-differs input[data-name]")
    assert marked.get_attribute("data-name") == "sphere_dpt"
    page.page.get_by_text("From A to B: Sphere: 0.00 dpt → -3.00 dpt.").wait_for()
    assert violations(page) == []
    split = page.page.locator(".oc-split")
    for name, place in (("A", "100%"), ("B", "0%"), ("the scene", "100%")):
        button = page.page.get_by_role("button", name=f"Hold to see {name}", exact=True)
        button.dispatch_event("pointerdown")
        page.page.wait_for_timeout(100)
        assert split.evaluate("element => element.style.left") == place
        scene = page.page.locator("canvas.oc-under")
        assert scene.is_visible() == (name == "the scene")
        button.dispatch_event("pointerup")
    with page.page.expect_download() as download:
        page.choose("Picture")
    assert download.value.suggested_filename == "ocufilter_OD_A_B.png"
    with Image.open(download.value.path()) as image:
        joined = np.asarray(image.convert("RGB"))
    np.testing.assert_array_equal(joined[:540, :960], a)
    np.testing.assert_array_equal(joined[:540, -960:], b)


def test_states_are_exchanged_and_shown_side_by_side(page):
    _compare(page)
    number = page.number()
    page.page.locator(f"{B} input[data-name=sphere_dpt]").first.fill("-3")
    page.settle(after=number, eye="OD_B")
    number = page.number()
    page.choose("Swap")
    page.settle(after=number, eye="OD_B")
    # "-3", or "-3.00" once the entry has lost the focus
    assert float(page.entry("sphere_dpt").input_value()) == -3.0
    page.choose("Side by side")
    page.page.locator(".oc-view[data-eye=OD_B]").wait_for()
    page.page.wait_for_timeout(500)
    assert page.page.locator(".oc-view").count() == 2
    assert _detail(page.seen("OD")) < 0.8 * _detail(page.seen("OD_B"))
    assert page.page.locator(".oc-split").count() == 0  # each is shown whole
    for name, eye in (("A", "OD"), ("B", "OD_B")):
        view = page.page.locator(f".oc-view[data-eye={eye}]")
        assert view.locator(".oc-tag:visible").all_inner_texts() == [name]
        clip = view.locator(".oc-after").evaluate("e => getComputedStyle(e).clipPath")
        assert "100%" not in clip
    for figure in ("Acuity", "Contrast", "Field"):
        page.choose(figure)
        page.page.locator(f".oc-figure img[alt={figure}]").wait_for()
    page.choose("Both")  # eyes instead of states
    page.page.locator(".oc-view[data-eye=OS]").wait_for()
    assert not page.page.get_by_role("switch", name="Compare A | B").is_checked()


def test_a_scenario_sets_scene_conditions_and_states(page):
    number = page.number()
    scenario = scenarios()["reading"]
    page.pick(".oc-scenarios", scenario.title)
    page.settle(after=number, eye="OD_B")
    page.page.get_by_role("button", name="Letter chart", pressed=True).wait_for()
    page.page.get_by_text(scenario.leaves_out).wait_for()
    assert page.slider("distance_dpt").get_attribute("aria-valuetext").endswith("40 cm")
    captions = page.page.locator(".oc-caption")
    captions.nth(1).wait_for()
    lines = [float(text.split()[-1]) for text in captions.all_inner_texts()]
    assert lines[1] > 2.0 * lines[0]  # decimal acuity with the addition
    told = page.page.locator(".oc-sight")
    told.get_by_text("Blurred at 40 cm").wait_for()
    assert re.search(r"B: Sharp at 40 cm: predicted acuity 1\.\d\d", told.inner_text())
    assert page.page.locator(".oc-tag:visible").all_inner_texts() == ["A", "B"]
    page.pick(".oc-notation", "20/20")
    page.page.locator(".oc-marks-head").get_by_text("feet").wait_for()
    cut_off = """() => [...document.querySelectorAll('.oc-marks span')]
      .filter(text => text.scrollWidth > text.clientWidth + 1)
      .map(text => text.innerText)"""
    assert page.page.evaluate(cut_off) == []
    page.choose("Courtyard")
    page.page.get_by_text("Changed since: scene, viewing").wait_for()
    assert page.page.get_by_text(scenario.leaves_out).is_visible()


def test_nothing_is_said_of_the_eye_before(page):
    told = page.page.locator(".oc-sight")
    told.get_by_text("Sharp at").wait_for()
    points = page.page.locator(".oc-psf .oc-outdated")
    points.first.wait_for(state="detached")
    words = """() => {
      const sight = document.querySelector('.oc-sight');
      const point = document.querySelector('.oc-psf [class*=html]') ?? sight;
      window.words = [];
      new MutationObserver(() => window.words.push([
        sight.innerText, document.querySelectorAll('.oc-psf .oc-outdated').length]))
        .observe(document.querySelector('main'),
          { subtree: true, childList: true, characterData: true, attributes: true });
    }"""
    page.page.evaluate(words)
    page.entry("sphere_dpt").fill("-4")
    told.get_by_text("Blurred at").wait_for()
    points.first.wait_for(state="detached")
    shown = page.page.evaluate("window.words")
    sentences = [text for text, _ in shown]
    assert "" in sentences  # nothing, until it is known
    gone = sentences.index("")
    assert not any("Sharp" in text for text in sentences[gone:])
    assert any(outdated for _, outdated in shown[gone:])


def test_a_night_road_sets_the_pupil_and_offers_straylight(page):
    number = page.number()
    page.choose("Night road")
    told = page.settle(after=number)
    assert told["pupil_diameter_mm"] > 5.0
    number = page.number()
    page.choose("Add straylight of this age")
    page.settle(after=number)
    offer = page.page.get_by_role("button", name="Add straylight of this age")
    assert not offer.is_visible()
    page.page.locator(".oc-haze").get_by_text("of the light is scattered").wait_for()


def test_the_focus_stays_at_a_number_that_was_typed(page):
    page.page.get_by_role("button", name="Type Pupil").click()
    page.page.keyboard.press("Control+a")
    page.page.keyboard.type("5 mm")
    page.page.keyboard.press("Enter")
    page.page.wait_for_timeout(200)
    focused = page.page.evaluate("document.activeElement.ariaLabel")
    assert focused == "Type Pupil"


def test_a_distance_is_typed_and_chosen_as_people_say_it(page):
    number = page.number()
    page.choose("Letter chart")
    page.settle(after=number)
    for act in ("typed", "chosen"):
        number = page.number()
        if act == "typed":
            page.page.get_by_role("button", name="Type Distance").click()
            page.page.keyboard.press("Control+a")
            page.page.keyboard.type("40 cm")
            page.page.keyboard.press("Enter")
        else:
            page.choose("6 m")
        wanted = 2.5 if act == "typed" else 0.1667
        told = page.settle(after=number)
        assert told["wanted_focus_dpt"] == pytest.approx(wanted, abs=1e-4)
    page.page.get_by_role("button", name="Type Pupil").click()
    page.page.keyboard.press("Control+a")
    page.page.keyboard.type("wide")
    page.page.keyboard.press("Enter")
    page.page.get_by_text("Pupil: “wide” is not a number").wait_for()


def test_what_a_flat_photo_shows_has_a_distance_that_is_asked_for(page):
    file = io.BytesIO()
    Image.fromarray(np.full((64, 64, 3), 90, np.uint8)).save(file, "png")
    page.choose("Photo")
    number = page.number()
    page.page.locator(".oc-uploads input[type=file]").first.set_input_files(
        {"name": "near.png", "mimeType": "image/png", "buffer": file.getvalue()}
    )
    page.settle(after=number)
    page.page.get_by_text("Choose the distance of what it shows").wait_for()
    number = page.number()
    page.pick(".oc-photo-width .q-select >> nth=1", "Page or close-up, 40 cm")
    told = page.settle(after=number)
    assert told["wanted_focus_dpt"] == pytest.approx(2.5, abs=0.01)
    assert page.page.locator(".oc-ask").inner_text() == ""


def test_what_is_pressed_is_large_enough(page):
    _compare(page)
    for width_px, height_px, least_px in (
        (1400, 900, 24),
        (820, 1180, 44),
        (390, 844, 44),
    ):
        page.page.set_viewport_size({"width": width_px, "height": height_px})
        page.page.wait_for_timeout(500)
        small = [
            (name, width, height)
            for name, width, height in page.page.evaluate(SIZES)
            if min(width, height) < least_px - 0.1
        ]
        assert small == [], width_px
        assert page.page.evaluate(CROSSING) == [], width_px
        assert page.page.evaluate("document.documentElement.scrollWidth") <= width_px


def test_all_controls_are_in_view_on_a_desk(page):
    page.page.set_viewport_size({"width": 1400, "height": 900})
    page.page.evaluate("window.scrollTo(0, 0)")
    page.page.wait_for_timeout(300)
    for area in (".oc-eyes", ".oc-picture", ".oc-sliders"):
        bottom = page.page.locator(area).evaluate(
            "element => element.getBoundingClientRect().bottom"
        )
        assert bottom <= 900, area


def test_help_is_opened_and_has_no_barriers(page):
    for name in ("the eye", "the picture", "viewing conditions", "the figures"):
        page.page.get_by_role("button", name=f"Help: {name}", exact=True).click()
        page.page.get_by_role("dialog", name=f"Help: {name}", exact=True).wait_for()
        page.page.wait_for_timeout(400)
        assert violations(page) == [], name
        page.page.keyboard.press("Escape")
        page.page.wait_for_timeout(400)
    assert page.page.get_by_text("Not a medical device").count() == 2


def test_a_link_shows_both_states_again(page):
    _compare(page)
    number = page.number()
    page.page.locator(f"{B} input[data-name=sphere_dpt]").first.fill("-3")
    page.settle(after=number, eye="OD_B")
    page.page.wait_for_function("location.hash.length > 10")
    page.page.wait_for_timeout(1500)
    page.page.reload()
    page.settle(eye="OD_B")
    entry = page.page.locator(f"{B} input[data-name=sphere_dpt]").first
    assert entry.input_value() == "-3"
