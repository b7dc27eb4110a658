"""What is shown where: nothing covers, cuts or hides anything else."""

import pytest

SIZES = {"desk": (1400, 900), "phone": (390, 844)}
ROWS = 12

RECTANGLES = """selector => [...document.querySelectorAll(selector)]
  .map(element => element.getBoundingClientRect())
  .map(({left, right, top, bottom}) => ({left, right, top, bottom}))"""


def rectangles(page, selector):
    """Return where the elements are in the window."""
    return page.page.evaluate(RECTANGLES, selector)


def overlap_px(a, b):
    """Return the height of what two rectangles have in common; 0 if nothing."""
    if min(a["right"], b["right"]) <= max(a["left"], b["left"]):
        return 0.0
    return max(0.0, min(a["bottom"], b["bottom"]) - max(a["top"], b["top"]))


def _chart_of_both(page):
    number = page.number()
    page.choose("Letter chart")
    page.choose("Both")
    page.settle(after=number, eye="OS")
    page.page.locator(".oc-caption").nth(1).wait_for()


def test_the_picture_never_lies_over_the_figures(page):
    number = page.number()
    page.choose("Both")
    page.settle(after=number, eye="OS")
    page.wear("Progressive spectacles")  # a long left column
    page.page.locator(".oc-figure img").wait_for()
    height_px = page.page.evaluate("document.documentElement.scrollHeight")
    for top_px in range(0, height_px, 150):
        page.page.evaluate(f"window.scrollTo(0, {top_px})")
        (figures,) = rectangles(page, "section[aria-label=Figures]")
        for card in rectangles(page, ".oc-middle > section"):
            assert overlap_px(figures, card) == 0.0


@pytest.mark.parametrize("size", SIZES)
def test_every_row_has_its_whole_label_and_nothing_covers_it(page, size):
    width_px, height_px = SIZES[size]
    page.page.set_viewport_size({"width": width_px, "height": height_px})
    _chart_of_both(page)
    page.page.mouse.move(0, 0)
    views = rectangles(page, ".oc-view")
    labels = rectangles(page, ".oc-marks li:not(.oc-marks-head)")
    assert len(labels) == 2 * ROWS
    for k, label in enumerate(labels):
        view = views[k // ROWS]
        assert view["left"] <= label["left"] < label["right"] <= view["right"]
        assert view["top"] - 0.5 <= label["top"]
        assert label["bottom"] <= view["bottom"] + 0.5
        for other in labels[:k]:
            assert overlap_px(label, other) < 1.0
        tags = ".oc-tag, .oc-state"
        for tag in page.page.locator(tags).all():
            if tag.is_visible():
                assert overlap_px(label, tag.evaluate(_ONE)) == 0.0
    page.page.evaluate("document.querySelector('.oc-marks').scrollIntoView()")
    words = page.page.locator(".oc-marks").first.inner_text().split()
    if size == "desk":
        assert words[:2] == ["logMAR", "dec."]
        assert words[2::2][0] == "1.0"
        assert words[2::2][-1] == "−0.1"
    else:  # both would lie over the letters
        assert words == ["dec.", *(f"{10 ** -(1 - 0.1 * k):.2f}" for k in range(ROWS))]
    letters = page.page.evaluate(
        "[...document.querySelectorAll('.oc-leaders line')].map(line => "
        "line.getBoundingClientRect().left)"
    )
    assert max(letters) < min(label["left"] for label in labels[ROWS - 1 :: ROWS]) or (
        size == "desk"
    )
    for caption in page.page.locator(".oc-caption").all():
        assert "reads about the line logMAR" in caption.inner_text()


_ONE = """element => {
  const {left, right, top, bottom} = element.getBoundingClientRect();
  return {left, right, top, bottom};
}"""


def test_the_focus_ring_of_a_slider_does_not_cross_a_label(page):
    for slider in page.page.locator(".oc-sliders input[type=range]").all():
        if slider.is_disabled():
            continue
        page.page.keyboard.press("Tab")  # rings are for the keyboard
        slider.focus()
        ring = slider.evaluate(_ONE)
        width_px = slider.evaluate(
            "e => parseFloat(getComputedStyle(e).outlineWidth)"
            " + parseFloat(getComputedStyle(e).outlineOffset)"
        )
        assert width_px > 0.0
        ring["top"] -= width_px
        ring["bottom"] += width_px
        for head in rectangles(page, ".oc-sliders .oc-slider-head"):
            assert overlap_px(ring, head) == 0.0


def test_a_scene_without_a_file_says_so_in_place(page):
    for scene, text in (
        ("Photo", "No photo yet: upload one"),
        ("3D file", "No 3D file yet: upload one"),
    ):
        page.choose(scene)
        page.page.locator(".oc-view").get_by_text(text).wait_for()
        assert not page.page.locator(".oc-view canvas").first.is_visible()
        page.choose("Picture")
        page.page.locator(".q-notification").get_by_text(text).wait_for()
        number = page.number()
        page.choose("Courtyard")
        page.settle(after=number)
        assert page.page.locator(".oc-view canvas").first.is_visible()


def test_the_age_is_beside_the_prescription(page):
    age = page.page.locator("section[aria-label=Eye] input[data-name=age_years]")
    assert age.count() == 1
    assert page.page.locator("input[data-name=age_years]").count() == 1
