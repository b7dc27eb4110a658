"""Which cameras share a store: by pixel size on axis, by the whole image off it."""

import numpy as np
import pytest

from filter_service.camera import Camera, distinct_cameras, is_same_camera
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
