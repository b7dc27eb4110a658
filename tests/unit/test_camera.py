"""Which cameras share a store: by pixel size on axis, by the whole image off it."""

import math

import numpy as np
import pytest

from filter_service.camera import (
    Camera,
    camera_of,
    distinct_cameras,
    is_same_camera,
)
from filter_service.errors import BadMessage
from filter_service.rgbd_view import RgbdView, as_views
from tests.grid_specs import grid_spec

CAMERA = Camera(200, 100, (-0.5, 0.5, 0.25, -0.25))  # 5 mrad

LIKE = Camera(200, 100, (-0.5002, 0.5002, 0.2501, -0.2501))  # 0.04 % wider
COARSER = Camera(200, 100, (-0.501, 0.501, 0.25, -0.25))  # 0.2 % wider
SHIFTED = Camera(200, 100, (-0.6, 0.4, 0.25, -0.25))
CROPPED = Camera(100, 100, (-0.25, 0.25, 0.25, -0.25))


@pytest.mark.parametrize(
    ("other", "on_axis", "over_the_field"),
    [
        (CAMERA, True, True),
        (LIKE, True, True),
        (COARSER, False, False),
        (SHIFTED, True, False),
        (CROPPED, True, False),
    ],
)
def test_what_a_store_serves_depends_on_its_mode(other, on_axis, over_the_field):
    assert is_same_camera(CAMERA, other, follows_field=False) == on_axis
    assert is_same_camera(CAMERA, other, follows_field=True) == over_the_field
    assert grid_spec(CAMERA).serves(other) == on_axis
    assert grid_spec(CAMERA, mode="dynamic").serves(other) == over_the_field


def test_cameras_that_share_a_store_are_counted_once():
    cameras = [CAMERA, LIKE, SHIFTED, COARSER]
    assert distinct_cameras(cameras, follows_field=False) == (CAMERA, COARSER)
    assert distinct_cameras(cameras, follows_field=True) == (CAMERA, SHIFTED, COARSER)


def test_sizes_from_numpy_become_numbers_that_travel():
    camera = Camera(np.int64(200), np.int32(100), CAMERA.tangents)
    assert camera == CAMERA
    assert (type(camera.width_px), type(camera.height_px)) == (int, int)


def test_sides_of_several_images_are_named():
    """Of 2 images of 129 rows, taken for one of 2 rows and 129 columns."""
    images = np.zeros((2, 129, 100, 3))
    height_px, width_px = images.shape[:2]
    with pytest.raises(ValueError, match=r"50 deg reaches 88\.1 deg .* of 129x2 px"):
        Camera.from_fov(50.0, width_px=width_px, height_px=height_px)


COLOR, DEPTH_M = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32)


@pytest.mark.parametrize(
    ("color", "depth_m", "said"),
    [
        (COLOR, 2.0, r"depth: it is 2\.0 \(allowed: an array \(height, width\)\)"),
        (COLOR, DEPTH_M.tolist(), r"depth: it is \[\[1\.0, "),
        (COLOR, DEPTH_M[None], r"depth: it is float32 of shape \(1, 4, 6\)"),
        (COLOR, np.ma.masked_equal(DEPTH_M, 1.0), "masked array with 24 masked values"),
        (np.ma.array(COLOR), DEPTH_M, r"color: it is a masked array .*filled\(0\)"),
        (COLOR[None], DEPTH_M, r"color: it has shape \(1, 4, 6, 3\)"),
        (COLOR.tolist(), DEPTH_M, "color: a list of list"),
        (None, DEPTH_M, "color: a NoneType"),
    ],
)
def test_what_is_no_image_is_refused_by_name(color, depth_m, said):
    camera = Camera.from_fov(50.0, width_px=6, height_px=4)
    with pytest.raises(ValueError, match=said):
        as_views(color, depth_m, camera)


def test_a_hidden_layer_is_an_array_too():
    tangents = Camera.from_fov(50.0, width_px=6, height_px=4).tangents
    with pytest.raises(ValueError, match=r"hidden_depth: it is 2\.0"):
        RgbdView(COLOR, DEPTH_M, tangents, "planar", COLOR, 2.0)
    with pytest.raises(ValueError, match="hidden_color: it is a masked array"):
        RgbdView(COLOR, DEPTH_M, tangents, "planar", np.ma.array(COLOR), DEPTH_M)


def test_a_camera_of_a_stream_is_checked_once_and_an_invalid_one_every_time():
    tangents = (-1.0, 1.0, 0.5, -0.5)
    assert camera_of(8, 4, tangents) == Camera(8, 4, tangents)
    assert camera_of(8, 4, tangents) is camera_of(8, 4, tuple(tangents))
    assert camera_of(8, 4, [-1, 1, 0.5, -0.5]) == Camera(8, 4, tangents)
    for invalid in ((8.0, 4, tangents), (8, 4, (-1.0, True, 0.5, -0.5))):
        for _ in range(2):
            with pytest.raises(BadMessage):
                camera_of(*invalid)
    for _ in range(2):
        with pytest.raises(BadMessage, match="tangents"):
            camera_of(8, 4, (1.0, -1.0, 0.5, math.nan))
