"""The page in a browser: entries, pictures, split, both eyes, files."""

import io
import json
import re
import urllib.error
import urllib.request

import numpy as np
import pytest
from PIL import Image

from clients.headset.stereo_gaze import StereoGaze
from estimator import parse_profile
from tests.end_to_end.headset_doubles import Inverting
from tests.end_to_end.layer_double import RunningHelper
from tests.web.browser import PageUnderTest


def _change(first, second):
    return np.abs(first.astype(int) - second.astype(int)).mean()


def _detail(picture):
    return np.abs(np.diff(picture.astype(int), axis=1)).mean()


def test_another_prescription_changes_the_picture(page):
    before, scene = page.seen(), page.seen(layer="before")
    assert before.shape == scene.shape == (540, 960, 3)
    number = page.number()
    page.entry("sphere_dpt").fill("-5")
    told = page.settle(after=number)
    after = page.seen()
    assert _change(before, after) > 2.0
    assert _detail(after) < 0.8 * _detail(before)
    kinds = [entry["kind"] for entry in page.drawn() if entry["number"] > number]
    assert kinds[0] == "preview"
    assert kinds[-1] == "full"
    assert told["width_px"] == 960
    np.testing.assert_array_equal(page.seen(layer="before"), scene)


def test_a_slider_moves_the_picture_and_its_words(page):
    before, number = page.seen(), page.number()
    page.press("pupil_diameter_mm", "ArrowRight", 20)
    told = page.settle(after=number)
    shown = page.page.locator(".oc-slider", has_text="Pupil").inner_text()
    assert f"{told['pupil_diameter_mm']:.1f} mm" in shown
    assert _change(before, page.seen()) > 0.1


def test_a_wrong_entry_is_explained_and_the_eye_stays(page):
    before, drawn = page.seen(), page.drawn()
    for text, said in (
        ("abc", "“abc” is not a number; allowed: −30 to 30 dpt"),
        ("-99", "-99 is out of range; allowed: −30 to 30 dpt"),
    ):
        page.entry("sphere_dpt").fill(text)
        page.page.get_by_text(said, exact=True).wait_for()
        page.page.get_by_text("The pictures show the last valid entries.").wait_for()
        page.page.wait_for_timeout(500)
        assert page.drawn() == drawn  # not even a preview of the same eye
        np.testing.assert_array_equal(page.seen(), before)
    number = page.number()
    page.entry("sphere_dpt").fill("-1")
    page.settle(after=number)
    assert page.page.get_by_text(said).count() == 0


def test_half_a_number_is_no_eye(page):
    before, drawn = page.seen(), page.drawn()
    page.entry("sphere_dpt").fill("")
    page.entry("sphere_dpt").press_sequentially("-99", delay=60)
    page.page.get_by_text("is out of range").first.wait_for()
    page.page.wait_for_timeout(800)
    assert page.drawn() == drawn
    np.testing.assert_array_equal(page.seen(), before)


def test_the_split_is_dragged(page):
    number = page.number()
    page.entry("sphere_dpt").fill("-3")  # far from the scene
    page.settle(after=number)
    box = page.box()
    middle_y = box["y"] + box["height"] / 2
    page.page.mouse.move(box["x"] + box["width"] / 2, middle_y)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 0.2 * box["width"], middle_y, steps=8)
    page.page.mouse.up()
    assert page.page.evaluate("window.ocufilter.split()") == pytest.approx(20, abs=0.5)
    shot = _shot(page)
    columns = shot.shape[1]
    scene, seen = (_fitted(page.seen(layer=la), shot) for la in ("before", "after"))
    for part, shown, other in (
        (slice(int(0.02 * columns), int(0.16 * columns)), scene, seen),
        (slice(int(0.3 * columns), int(0.8 * columns)), seen, scene),
    ):
        rows = slice(60, -50)  # between the labels
        is_shown = _change(shot[rows, part], shown[rows, part])
        assert is_shown < _change(shot[rows, part], other[rows, part])


def _shot(page):
    png = page.page.locator(".oc-view").first.screenshot()
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def _fitted(picture, like):
    size = (like.shape[1], like.shape[0])
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BILINEAR))


def test_both_eyes_are_seen_each_with_its_own_entries(page):
    number = page.number()
    page.choose("Both")
    page.settle(after=number, eye="OS")
    page.entry("sphere_dpt", 1).fill("-6")
    page.settle(after=page.number(), eye="OS")
    right, left = page.seen("OD"), page.seen("OS")
    assert _detail(left) < 0.8 * _detail(right)


def test_a_click_focuses_on_what_is_there(page):
    box, number = page.box(), page.number()
    # the menu on the table
    page.page.mouse.click(
        box["x"] + 0.35 * box["width"], box["y"] + 0.84 * box["height"]
    )
    told = page.settle(after=number)
    assert 0.8 < told["wanted_focus_dpt"] < 3.0
    assert told["focus_dpt"] == pytest.approx(told["wanted_focus_dpt"], abs=0.05)


def test_the_point_under_the_pointer_is_drawn(page):
    box = page.box()
    page.page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.5 * box["height"])
    page.page.get_by_text(
        re.compile(r"Half of the point's light lies within")
    ).wait_for()
    png = page.page.locator(".oc-psf img").get_attribute("src")
    assert png.startswith("data:image/png;base64,")


def test_a_trifocal_lens_is_chosen_and_sharper_near_than_a_monofocal_one(page):
    number = page.number()
    page.choose("Letter chart")
    number = page.settle(after=number)["number"]
    page.press("age_years", "PageUp", 4)
    page.press("distance_dpt", "PageUp", 4)
    assert page.slider("distance_dpt").input_value() == "2.25", "each key counts"
    told = page.settle(after=number)
    while told["wanted_focus_dpt"] != 2.25:  # a picture on the way
        told = page.settle(after=told["number"])
    assert page.slider("distance_dpt").input_value() == "2.25", "nothing moved it back"
    number = page.number()
    page.wear("Intraocular lens")
    page.settle(after=number)
    single, number = page.seen(), page.number()
    page.pick(".oc-worn-design", "Trifocal")
    page.settle(after=number)
    assert page.entry("near_add_dpt").input_value() == "+3.32"
    assert _detail(page.seen()) > 1.2 * _detail(single)
    page.entry("near_add_dpt").fill("3.1")
    page.page.get_by_text(re.compile("a ratio of whole numbers up to 4")).wait_for()


def test_the_gaze_goes_through_another_part_of_a_progressive_lens(page):
    number = page.number()
    page.wear("Progressive spectacles")
    told = page.settle(after=number)
    ahead, number = page.seen(), page.number()
    assert told["focus_dpt"] == pytest.approx(told["wanted_focus_dpt"], abs=0.1)
    page.press("gaze_v_deg", "ArrowLeft", 15)
    page.page.wait_for_timeout(1500)  # one of the pictures on the way was full, too
    told = page.settle(after=number)
    # 25.5 mm before the center of rotation that is 6.8 mm down: half of the corridor,
    # half of the addition of 2 dpt, with which nothing farther than 1 m is sharp
    assert told["focus_dpt"] == pytest.approx(1.0, abs=0.15)
    assert _change(ahead, page.seen()) > 0.5


def test_the_tag_of_the_full_picture_goes_away(page):
    tag = page.page.locator(".oc-state").first
    page.page.wait_for_timeout(2500)
    assert tag.evaluate("tag => getComputedStyle(tag).opacity") == "0"


def test_figures_are_drawn(page):
    for name in ("Field", "Section", "Wavefront", "Acuity"):
        page.choose(name)
        page.page.locator(f".oc-figure img[alt={name}]").wait_for()


def test_picture_and_profile_are_downloaded(page):
    page.entry("cylinder_dpt").fill("-1.25")
    page.settle(after=page.number())
    with page.page.expect_download() as download:
        page.choose("Picture")
    with Image.open(download.value.path()) as image:
        np.testing.assert_array_equal(np.asarray(image.convert("RGB")), page.seen())
    with page.page.expect_download() as download:
        page.choose("Profile")
    assert download.value.suggested_filename == "ocufilter_OD.json"
    with open(download.value.path(), encoding="utf-8") as file:
        body = json.load(file)
    assert parse_profile(body).eye_side == "OD"
    assert body["cylinder_dpt"] == -1.25


def test_a_report_is_downloaded(page):
    with page.page.expect_download() as download:
        page.choose("Report")
    with open(download.value.path(), encoding="utf-8") as file:
        text = file.read()
    assert download.value.suggested_filename == "ocufilter_OD.html"
    assert "<html" in text
    assert "Right eye" in text
    assert "data:image/" in text


def test_the_eye_is_shown_in_the_program_of_a_layer(browser, address, layer_socket):
    def no_eyes(_say):
        return Inverting(), StereoGaze(age_years=30.0)

    with RunningHelper(layer_socket, no_eyes) as helper:
        context = browser.new_context(viewport={"width": 1280, "height": 800})
        page = PageUnderTest(context.new_page())
        page.open(address)
        page.entry("cylinder_dpt").fill("-1.25")
        page.settle(after=page.number())
        page.choose("Headset")
        page.page.get_by_text("Sent to the next program").wait_for()
        assert page.errors == []
        context.close()
    ((eye, text),) = helper.changed
    assert eye == "right"
    assert json.loads(text)["cylinder_dpt"] == -1.25


def test_a_profile_file_is_taken_and_a_wrong_one_explained(page):
    page.choose("File")
    upload = page.page.locator(".oc-eye input[type=file]").first
    upload.set_input_files(
        {"name": "p.json", "mimeType": "application/json", "buffer": b'{"kind": "x"}'}
    )
    page.page.get_by_text(re.compile("'x' is unknown; allowed")).wait_for()
    number = page.number()
    body = json.dumps({"kind": "preset", "name": "keratoconus", "age_years": 44})
    upload.set_input_files(
        {"name": "p.json", "mimeType": "application/json", "buffer": body.encode()}
    )
    page.settle(after=number)
    assert "44 years" in page.page.locator(".oc-slider", has_text="Age").inner_text()
    page.page.get_by_text("Keratoconus").wait_for()


def test_a_photo_of_ones_own_is_looked_at(page):
    rows, columns = np.indices((120, 160))
    color = np.stack([rows, columns, rows + columns], -1).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(color).save(file, "png")
    number = page.number()
    page.choose("Photo")
    page.page.locator(".oc-uploads input[type=file]").first.set_input_files(
        {"name": "own.png", "mimeType": "image/png", "buffer": file.getvalue()}
    )
    page.settle(after=number)
    np.testing.assert_array_equal(page.seen(layer="before"), color)


def test_a_portrait_is_seen_whole_and_a_file_of_another_kind_is_refused(page):
    file = io.BytesIO()
    Image.fromarray(np.full((3000, 2000, 3), 90, np.uint8)).save(file, "png")
    page.choose("Photo")
    upload = page.page.locator(".oc-uploads input[type=file]").first
    upload.set_input_files({"name": "a.glb", "mimeType": "", "buffer": b"junk"})
    page.page.get_by_text("Photo: not such a file; allowed: a picture").wait_for()
    number = page.number()
    upload.set_input_files(
        {"name": "own.png", "mimeType": "image/png", "buffer": file.getvalue()}
    )
    told = page.settle(after=number)
    assert (told["width_px"], told["height_px"]) == (480, 720)
    page.page.get_by_text("In use: own.png").wait_for()
    box = page.page.locator(".oc-view").first.bounding_box()
    assert box["height"] < 0.65 * 800
    assert box["width"] / box["height"] == pytest.approx(2 / 3, rel=0.01)


def test_files_that_are_refused_leave_those_of_before_in_use(page):
    photo, depth_m = io.BytesIO(), io.BytesIO()
    Image.fromarray(np.full((120, 160, 3), 90, np.uint8)).save(photo, "png")
    np.save(depth_m, np.full((120, 160), 2.0, np.float32))
    page.choose("Photo")
    uploads = page.page.locator(".oc-uploads input[type=file]")

    def send(which, name, content):
        mime = "image/png" if name.endswith("png") else ""
        files = {"name": name, "mimeType": mime, "buffer": content}
        uploads.nth(which).set_input_files(files)

    number = page.number()
    send(1, "depth.npy", depth_m.getvalue())  # before its photo
    page.page.get_by_text("In use: depth.npy").wait_for()
    send(0, "own.png", photo.getvalue())
    page.settle(after=number)
    page.page.get_by_text("In use: own.png, depth.npy").wait_for()
    send(0, "broken.png", b"junk")
    page.page.get_by_text(re.compile("broken.png.*")).first.wait_for()
    page.page.get_by_text("In use: own.png, depth.npy").wait_for()
    send(1, "broken.npy", b"junk")
    page.page.get_by_text(re.compile("broken.npy.*")).first.wait_for()
    page.page.get_by_text("In use: own.png, depth.npy").wait_for()


def test_a_3d_file_of_ones_own_is_looked_at(page):
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.visual.vertex_colors = [200, 40, 30, 255]
    box = box.export(file_type="glb")
    number = page.number()
    page.choose("3D file")
    page.page.locator(".oc-uploads input[type=file]").first.set_input_files(
        {"name": "box.glb", "mimeType": "model/gltf-binary", "buffer": box}
    )
    page.settle(after=number)
    scene = page.seen(layer="before")
    is_red = scene[..., 0] > 1.5 * scene[..., 1]
    assert is_red[scene.shape[0] // 2, scene.shape[1] // 2]
    assert not is_red[2, 2]
    assert 0.05 < is_red.mean() < 0.8
    assert page.page.evaluate("window.ocufilter.drawn.at(-1).width_px") == 960


def test_on_a_phone_nothing_is_wider_than_the_screen(page):
    page.page.set_viewport_size({"width": 390, "height": 844})
    page.page.wait_for_timeout(300)
    assert page.page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize("query", ["", "?token=wrong"])
def test_without_the_token_nobody_comes_in(address, query):
    root = address.partition("?")[0]
    for path in ("", "_nicegui/x/y", "pictures/x"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(root + path + query)
        assert refused.value.code == 403
        assert b"This page needs its token" in refused.value.read()


def test_a_page_of_another_origin_gets_no_websocket(browser, address):
    context = browser.new_context()
    page = context.new_page()
    page.goto(address)
    root = address.partition("?")[0].replace("http", "ws")
    try_it = """address => new Promise(done => {
      const socket = new WebSocket(address);
      socket.onopen = () => done("open");
      socket.onclose = event => done("closed");
    })"""
    socket = root + "_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    assert page.evaluate(try_it, socket) == "open"
    page.goto("data:text/html,<p>another")
    assert page.evaluate(try_it, socket) == "closed"
    context.close()


def test_two_pages_do_not_disturb_each_other(browser, page, address):
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    other = type(page)(context.new_page())
    other.open(address)
    page.settle()  # on a busy machine another wish may have come since it was opened
    before = page.seen()
    other.entry("sphere_dpt").fill("-8")
    other.settle(after=other.number())
    np.testing.assert_array_equal(page.seen(), before)
    assert other.errors == []
    context.close()
