"""Pictures to look at: photos, depth, the chart, and places in them."""

import io
import json
import math

import numpy as np
import pytest
from PIL import Image

from clients.web.picture import (
    chart_picture,
    coarser,
    gltf_picture,
    linear_from_srgb8,
    photo_picture,
    picture_of,
)
from filter_service import RgbdView
from tests.unit.web_parts import a_picture

FLAT = {"width_deg": 40.0, "distance_dpt": 0.5}


def _png(color):
    file = io.BytesIO()
    Image.fromarray(color).save(file, "png")
    return file.getvalue()


def _npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


NARROW = _png(np.zeros((3200, 16, 3), np.uint8))


@pytest.fixture
def color():
    return np.random.default_rng(3).integers(0, 256, (40, 64, 3), np.uint8)


def test_a_flat_photo_stands_where_it_is_put(color):
    picture = photo_picture("p.png", _png(color), **FLAT)
    np.testing.assert_array_equal(picture.view.color, color)
    assert np.all(picture.view.depth_m == 2.0)
    assert math.degrees(2 * math.atan(picture.view.tangents[1])) == pytest.approx(40.0)
    assert np.all(picture.at(0.0).view.depth_m == np.inf)
    assert np.all(picture.at(4.0).small.depth_m == 0.25)


def test_a_photo_with_depth_keeps_it(color):
    depth_m = np.linspace(0.3, 9.0, 40 * 64).reshape(40, 64).astype(np.float32)
    picture = photo_picture(
        "p.png", _png(color), depth=("d.npy", _npy(depth_m)), **FLAT
    )
    np.testing.assert_array_equal(picture.view.depth_m, depth_m)
    assert picture.at(3.0) is picture  # has distances of its own


@pytest.mark.parametrize(
    ("photo", "depth", "said"),
    [
        (("n.png", NARROW), None, "'n.png': 16 × 3200 px; allowed: 16 or more"),
        (
            ("p.png", b"no picture"),
            None,
            "'p.png': not a picture; allowed: a JPEG, PNG",
        ),
        (None, ("d.npy", b"junk"), "d.npy"),
        (None, ("d.txt", b"1"), r"allowed.*\.npy"),
        (
            None,
            ("d.npy", "small"),
            "'d.npy': 8 × 8 px; allowed: the size of the photo",
        ),
    ],
)
def test_files_that_are_no_pictures_are_refused_with_what_is_allowed(
    color, photo, depth, said
):
    if depth is not None and depth[1] == "small":
        depth = (depth[0], _npy(np.ones((8, 8), np.float32)))
    name, content = photo or ("p.png", _png(color))
    with pytest.raises(ValueError, match=said) as refused:
        photo_picture(name, content, depth=depth, **FLAT)
    assert "/ocufilter-" not in str(refused.value)


def test_notes_on_the_files_of_a_photo_go_with_its_picture(color):
    rgba = np.dstack([color, np.full(color.shape[:2], 255, np.uint8)])
    rgba[: len(rgba) // 2, :, 3] = 0
    depth = ("d.npy", _npy(np.full(color.shape[:2], 1500, np.uint16)))
    where = {"width_deg": 40.0, "distance_dpt": 1.0}
    picture = photo_picture("p.png", _png(rgba), **where, depth=depth)
    transparent, integers = picture.notes
    assert transparent.startswith("'p.png': 50 % of the pixels are transparent")
    assert "integers are millimeters" in integers
    assert not picture.view.color[0].any()
    np.testing.assert_allclose(picture.view.depth_m, 1.5)
    assert not photo_picture("p.png", _png(color), **where).notes
    assert photo_picture("p.png", _png(rgba), **where).at(2.0).notes == (transparent,)


def test_a_large_photo_is_made_smaller():
    picture = photo_picture(
        "p.png", _png(np.full((1000, 1501, 3), 90, np.uint8)), **FLAT
    )
    assert picture.view.color.shape == (640, 960, 3)
    assert picture.small.color.shape == (320, 480, 3)
    assert np.all(picture.view.color == 90)


def test_a_large_photo_fills_the_picture_and_keeps_its_light():
    color = np.zeros((1080, 1440, 3), np.uint8)  # one and a half times too large
    color[::2] = 255
    seen = photo_picture("p.png", _png(color), **FLAT).view.color
    assert seen.shape == (720, 960, 3)
    assert 100 < seen.min() < seen.max() < 230  # no row is left out
    assert linear_from_srgb8(seen).mean() == pytest.approx(0.5, abs=0.01)
    portrait = np.full((1500, 1000, 3), 90, np.uint8)
    upright = photo_picture("p.png", _png(portrait), **FLAT).view
    assert (upright.width_px, upright.height_px) == (480, 720)


def test_fewer_pixels_keep_light_nearest_depth_and_directions():
    color = np.zeros((4, 6, 3), np.uint8)
    color[:2, :2] = [[[0], [255]], [[255], [0]]]
    depth_m = np.arange(24, dtype=np.float32).reshape(4, 6)
    view = coarser(RgbdView(color, depth_m, (-0.3, 0.3, 0.2, -0.2)), 2)
    assert view.color[0, 0].tolist() == [188] * 3  # half of the light, as sRGB
    assert view.depth_m.tolist() == [[1, 2, 4], [12, 14, 16]]  # 0 is missing
    assert view.tangents == pytest.approx((-0.3, 0.3, 0.2, -0.2))


def test_a_place_has_a_direction_for_the_eye_that_looks():
    picture = a_picture()
    right = picture.view.tangents[1]
    middle = picture.scene_point(0.5, 0.5)
    assert middle.direction_deg((0.0, 0.0)) == pytest.approx((0.0, 0.0))
    edge = picture.scene_point(1.0, 0.5)
    assert edge.direction_deg((0.0, 0.0))[0] == pytest.approx(
        math.degrees(math.atan(right))
    )
    # an eye that looks there has it in the middle of its field
    top = picture.scene_point(0.8, 0.1)
    h_deg, v_deg = top.direction_deg((0.0, 0.0))
    assert top.direction_deg((h_deg, v_deg)) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert middle.distance_dpt == pytest.approx(0.5)


def test_the_chart_is_as_large_at_every_distance():
    near, far = chart_picture(4.0), chart_picture(0.0)
    np.testing.assert_array_equal(near.view.color, far.view.color)
    assert np.all(near.view.depth_m == 0.25)
    assert np.all(far.view.depth_m == np.inf)
    assert near.view.color.min() == 0
    assert near.view.color.max() == 255


def test_a_scene_of_another_kind_is_refused():
    with pytest.raises(ValueError, match=r"'s.obj': not a scene; allowed: .glb, .gltf"):
        gltf_picture("s.obj", b"")


def test_the_small_picture_is_small_enough():
    view = RgbdView(
        np.zeros((50, 961, 3), np.uint8), np.ones((50, 961), np.float32), (-1, 1, 1, -1)
    )
    assert picture_of("x", view).small.width_px == 320


def test_a_photo_is_known_by_its_content(color):
    """Whatever its name; of other formats some readers start programs."""
    for kind in ("eps", "pcx", "ppm", "ico"):
        file = io.BytesIO()
        Image.fromarray(color).save(file, kind)
        with pytest.raises(ValueError, match=r"not a picture; allowed: a JPEG, PNG"):
            photo_picture("photo.png", file.getvalue(), **FLAT)


def test_a_photo_of_few_bytes_and_many_pixels_is_not_read():
    file = io.BytesIO()
    Image.new("1", (10_000, 7_000)).save(file, "png")
    assert len(file.getvalue()) < 20_000
    with pytest.raises(ValueError, match="10000x7000 px; allowed: at most"):
        photo_picture("photo.png", file.getvalue(), **FLAT)


@pytest.mark.parametrize("name", ["d.png\0.npy\0", "d." + 300 * "x", "d", "d./../x"])
def test_a_depth_of_another_name_is_not_written(color, name):
    with pytest.raises(ValueError, match=r"is not a depth file; allowed: \.npy, \.png"):
        photo_picture("p.png", _png(color), depth=(name, b"1"), **FLAT)


def _gltf(**header):
    return json.dumps({"asset": {"version": "2.0"}, **header}).encode()


def _glb(text):
    text += b" " * (-len(text) % 4)
    sizes = [n.to_bytes(4, "little") for n in (2, 20 + len(text), len(text))]
    return b"glTF" + b"".join(sizes) + b"JSON" + text


@pytest.mark.parametrize(
    "uri",
    [
        "file:///etc/passwd",
        "/etc/passwd",
        "../../../../etc/passwd",
        "beside.bin",
        "http://127.0.0.1/x",
        "DATA:,x",
        " data:,x",
        "",
    ],
)
@pytest.mark.parametrize("part", ["buffers", "images", "extensions"])
def test_a_scene_does_not_read_other_files(uri, part):
    place = {"uri": uri, "byteLength": 9}
    text = _gltf(**{part: {"x": [place]} if part == "extensions" else [place]})
    for name, content in (("s.gltf", text), ("s.glb", _glb(text)), ("s.glb", text)):
        with pytest.raises(ValueError, match="refers to another file"):
            gltf_picture(name, content)


@pytest.mark.parametrize(
    "text", [b"", b"[" * 100_000, b'{"a":' * 100_000, b"\xff\xfe", b"glTF", b"{"]
)
def test_a_scene_that_is_none_is_refused_before_anything_is_started(text):
    for name, content in (("s.gltf", text), ("s.glb", _glb(text))):
        with pytest.raises(ValueError, match="not a glTF file"):
            gltf_picture(name, content)
