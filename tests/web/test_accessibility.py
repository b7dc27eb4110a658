"""WCAG 2.2 AA: axe-core in every state, and the page by keyboard alone."""

import base64
import io
import json

import numpy as np
import pytest
from PIL import Image

from tests.source_tree import ROOT
from tests.web.browser import DRAWN

AXE = ROOT / "tests" / "web" / "node_modules" / "axe-core" / "axe.min.js"
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
GRAVE = ("serious", "critical")


def violations(page):
    """Return what axe-core finds serious or critical, as readable lines."""
    assert AXE.is_file(), "axe-core is missing: sh setup.sh web installs it"
    page.page.add_script_tag(path=str(AXE))
    found = page.page.evaluate(
        "tags => axe.run(document, {runOnly: {type: 'tag', values: tags}})", TAGS
    )
    return [
        f"{item['impact']}: {item['id']}: {node['html'][:160]}"
        for item in found["violations"]
        if item["impact"] in GRAVE
        for node in item["nodes"]
    ]


def _error(page):
    page.entry("sphere_dpt").fill("-99")
    page.page.get_by_text("is out of range").first.wait_for()


def _lens(page):
    number = page.number()
    page.wear("Intraocular lens")
    page.settle(after=number)
    page.pick(".oc-worn-design", "Trifocal")


def _both(page):
    number = page.number()
    page.choose("Both")
    page.settle(after=number, eye="OS")


def _chart(page):
    number = page.number()
    page.choose("Letter chart")
    page.settle(after=number)
    page.page.locator(".oc-marks li").first.wait_for()


def _enlarged(page):
    page.page.locator(".oc-psf img").wait_for()
    page.page.get_by_role("button", name="Enlarge the point of light").click()
    page.page.locator(".oc-enlarged img").wait_for()
    page.page.wait_for_timeout(500)  # it fades in


# what one page shows one after another
STATES = {
    "ready": {
        "at first": lambda page: None,
        "enlarged": _enlarged,
        "closed": lambda page: page.page.keyboard.press("Escape"),
        "photo": lambda page: page.choose("Photo"),
        "preparing": lambda page: page.entry("sphere_dpt").fill("-4"),
        "error": _error,
        "file": lambda page: page.choose("File"),  # instead of the entries
    },
    "worn": {"lens": _lens, "chart": _chart, "both": _both},
}


@pytest.mark.parametrize("states", STATES.values(), ids=STATES)
def test_axe_finds_nothing_serious(page, states):
    for name, show in states.items():
        show(page)
        page.page.wait_for_timeout(300)
        assert violations(page) == [], name


def test_axe_finds_nothing_serious_on_a_phone(page):
    page.page.set_viewport_size({"width": 390, "height": 844})
    page.page.wait_for_timeout(300)
    assert violations(page) == []


def test_the_page_has_landmarks_headings_and_a_language(page):
    assert page.page.locator("html").get_attribute("lang").startswith("en")
    for tag in ("main", "nav", "h1"):
        assert page.page.locator(tag).count() == 1
    assert page.page.get_by_role("heading", level=2).count() >= 3


def test_a_slider_has_role_name_value_and_keys(page):
    slider = page.page.get_by_role("slider", name="Pupil", exact=True)
    assert slider.get_attribute("aria-valuetext") == "3.0 mm"
    slider.focus()
    keys = {"PageUp": 4.0, "ArrowUp": 4.1, "End": 7.0, "Home": 2.0}
    for key, expected in keys.items():
        slider.press(key)
        assert float(slider.input_value()) == pytest.approx(expected), key
        wanted = f"[aria-valuetext='{expected:.1f} mm']"
        page.page.locator(f"input[data-name=pupil_diameter_mm]{wanted}").wait_for()


def test_the_split_has_keys_and_a_picture_has_a_text(page):
    split = page.page.get_by_role("slider", name="Split between the scene")
    split.focus()
    split.press("End")
    assert page.page.evaluate("window.ocufilter.split()") == 100
    split.press("PageDown")
    assert page.page.evaluate("window.ocufilter.split()") == 80
    seen = page.page.get_by_role("img", name="Courtyard as the right eye sees it")
    assert "pupil of 3.0 mm" in seen.get_attribute("aria-label")


def test_preparing_and_the_result_are_announced(page):
    status = page.page.get_by_role("status").first
    number = page.number()
    page.entry("sphere_dpt").fill("-7")
    page.settle(after=number)
    page.page.get_by_text("Right eye: full picture.").wait_for()
    assert status.get_attribute("aria-live") == "polite"


def _tab_to(page, name, *, role, most=60):
    """Press Tab until an element is focused; return it."""
    wanted = page.page.get_by_role(role, name=name, exact=True).first
    for _ in range(most):
        page.page.keyboard.press("Tab")
        if wanted.evaluate("element => element === document.activeElement"):
            return wanted
    raise AssertionError(f"Tab does not reach {name}")


def test_a_prescription_becomes_a_report_by_keyboard_alone(page):
    page.page.evaluate("document.activeElement.blur()")
    number = page.number()
    _tab_to(page, "Sphere", role="textbox")
    page.page.keyboard.press("Control+a")
    page.page.keyboard.type("-2.5")
    _tab_to(page, "Cylinder", role="textbox")
    page.page.keyboard.press("Control+a")
    page.page.keyboard.type("-1")
    _tab_to(page, "Axis", role="textbox")
    page.page.keyboard.press("Control+a")
    page.page.keyboard.type("20")
    page.page.keyboard.press("Tab")
    page.settle(after=number)
    assert page.entry("sphere_dpt").input_value() == "-2.50"
    assert page.entry("cylinder_dpt").input_value() == "-1.00"
    outline = _tab_to(page, "Pupil", role="slider").evaluate(
        "element => getComputedStyle(element).outlineStyle"
    )
    assert outline != "none"
    page.page.keyboard.press("End")
    with page.page.expect_download() as download:
        _tab_to(page, "Report", role="button", most=120)
        page.page.keyboard.press("Enter")
    with open(download.value.path(), encoding="utf-8") as file:
        assert "<html" in file.read()


def test_holding_shows_the_scene(page):
    button = page.page.get_by_role("button", name="Hold to see the scene")
    tag = page.page.locator(".oc-split").first
    button.dispatch_event("pointerdown")
    page.page.wait_for_timeout(100)
    assert tag.evaluate("element => element.style.left") == "100%"
    button.dispatch_event("pointerup")
    page.page.wait_for_timeout(100)
    assert tag.evaluate("element => element.style.left") == "50%"


def test_nothing_moves_for_those_who_ask_for_it(browser, address):
    context = browser.new_context(reduced_motion="reduce")
    tab = context.new_page()
    tab.goto(address)
    tab.locator(".oc-tag").first.wait_for(state="attached")
    assert (
        tab.locator(".oc-tag").first.evaluate(
            "element => parseFloat(getComputedStyle(element).transitionDuration)"
        )
        < 0.001
    )
    context.close()


def test_at_200_percent_nothing_is_cut_off(page):
    # a window of half the size has the same layout as a zoom of 200 %
    page.page.set_viewport_size({"width": 640, "height": 400})
    page.page.wait_for_timeout(300)
    assert page.page.evaluate("document.documentElement.scrollWidth") <= 640


def test_the_smallest_line_read_is_marked(page):
    _chart(page)
    page.page.locator(".oc-marks .oc-read").wait_for()
    texts = page.page.locator(".oc-marks li").all_inner_texts()
    assert [text.split()[0] for text in texts[:3]] == ["logMAR", "1.0", "0.9"]
    assert texts[11].split() == ["0.0", "1.00"]
    sharp = page.page.locator(".oc-marks .oc-read").inner_text()
    number = page.number()
    page.entry("sphere_dpt").fill("-3")
    page.settle(after=number)
    # an eye too strong by 3 dpt reads at most the largest rows
    page.page.wait_for_function(
        "old => document.querySelector('.oc-marks .oc-read')?.innerText !== old",
        arg=sharp,
    )


def test_entries_survive_a_reload_and_are_a_link(browser, page, address):
    number = page.number()
    page.entry("sphere_dpt").fill("-3.5")
    page.press("pupil_diameter_mm", "End", 1)
    page.choose("Letter chart")
    page.settle(after=number)
    page.page.wait_for_function("location.hash.length > 10")
    page.page.wait_for_timeout(1500)
    link = page.page.evaluate("location.hash")
    page.page.reload()
    page.settle()
    for tab in (page, _opened(browser, page, address, link)):
        assert tab.entry("sphere_dpt").input_value() == "-3.50"
        assert tab.slider("pupil_diameter_mm").input_value() == "7"
        tab.page.get_by_role("button", name="Letter chart", pressed=True).wait_for()


def _opened(browser, page, address, link):
    """Open a link in another browser, which has the token."""
    context = browser.new_context()
    tab = type(page)(context.new_page())
    tab.page.goto(address)
    tab.page.goto(address.partition("?")[0] + link)
    tab.page.reload()
    tab.settle()
    return tab


NO_ENTRIES = "The link contains no entries for this page"
BAD_LINKS = [
    ("e30", NO_ENTRIES),
    ({"v": 1, "values": {"age_years": "x"}}, "Age: 'x' is not a number"),
    ("%%%", NO_ENTRIES),
    (
        {"v": 1, "values": {"pupil_diameter_mm": 99}},
        "Pupil: 99 is out of range; allowed: 2 to 7 mm",
    ),
    ("A" * 20_000, NO_ENTRIES),
    (
        {"v": 1, "eyes": {"OD": {"texts": {"sphere_dpt": "-99"}}}},
        "-99 is out of range",
    ),
    ({"v": 1, "eyes": {"OD": {"preset": "x"}}}, "preset 'x' is unknown"),
    (
        {"v": 1, "eyes": {"OD": {"source": "file", "file": "a.json"}}},
        "the profile file 'a.json' is not part of a link",
    ),
]
"""Fragments, and what the page says; no two in a row say the same."""


def test_bad_links_are_explained_and_the_page_works(page, address):
    for fragment, said in BAD_LINKS:
        if isinstance(fragment, dict):
            encoded = base64.urlsafe_b64encode(json.dumps(fragment).encode())
            fragment = encoded.decode().rstrip("=")
        page.page.goto(address.partition("?")[0] + "#" + fragment)
        page.page.reload()
        page.page.get_by_text(said).first.wait_for()
        page.page.wait_for_function(f"({DRAWN}).length > 0")
    page.settle()


def test_a_download_that_is_clicked_too_early_waits(page):
    page.entry("sphere_dpt").fill("-5")
    page.page.wait_for_timeout(450)  # typed, and not yet computed
    with page.page.expect_download() as download:
        page.choose("Picture")
    with Image.open(download.value.path()) as image:
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")), page.seen())


def test_a_file_error_stays_beside_its_upload(page):
    page.choose("Photo")
    upload = page.page.locator(".oc-upload-entry").first
    upload.locator("input[type=file]").set_input_files(
        {"name": "no.png", "mimeType": "image/png", "buffer": b"junk"}
    )
    message = upload.locator("[role=alert]")
    message.get_by_text("no.png").wait_for()
    page.page.wait_for_timeout(1000)
    assert "not a picture" in message.inner_text()
    file = io.BytesIO()
    Image.fromarray(np.full((64, 64, 3), 90, np.uint8)).save(file, "png")
    number = page.number()
    upload.locator("input[type=file]").set_input_files(
        {"name": "ok.png", "mimeType": "image/png", "buffer": file.getvalue()}
    )
    page.settle(after=number)
    assert message.text_content() == ""


def test_no_file_yet_is_not_an_error(page):
    page.choose("File")
    page.page.wait_for_timeout(600)
    assert page.page.get_by_text("no file yet").count() == 0
    assert page.page.get_by_text("No file yet").count() == 0


def test_the_keyboard_stays_where_entries_are_rebuilt(page):
    switch = page.page.get_by_role("switch", name="Wears a correction").first
    switch.focus()
    page.page.keyboard.press("Space")
    page.page.locator(".oc-worn-kind").wait_for()
    page.page.wait_for_function("document.activeElement !== document.body")
    assert switch.evaluate("element => element.contains(document.activeElement)")
    page.page.get_by_role("button", name="Preset", exact=True).first.focus()
    page.page.keyboard.press("Enter")
    page.page.locator(".oc-eye [aria-label=Preset]").first.wait_for()
    page.page.wait_for_function(
        "document.activeElement.getAttribute('aria-pressed') === 'true'"
    )
    assert page.page.evaluate("document.activeElement.innerText") == "Preset"
