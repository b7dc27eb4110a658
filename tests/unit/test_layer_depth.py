"""Depth buffers of OpenXR programs: right ones exactly, wrong ones recognized."""

import math

import numpy as np
import pytest

from clients.openxr_layer.frame_images import (
    DepthRange,
    corrected_range,
    planar_depth,
)

WIDTH_PX, HEIGHT_PX = 64, 48


def scene_m(near_m=0.4, far_m=30.0):
    """Planar depth of a room: a floor that recedes, and an object in front of it."""
    rows = np.linspace(0.0, 1.0, HEIGHT_PX)[:, None] * np.ones(WIDTH_PX)
    depth_m = 1.0 / (1.0 / far_m + rows * (1.0 / near_m - 1.0 / far_m))
    depth_m[10:20, 10:20] = 0.7
    return depth_m


def projected(depth_m, near_m, far_m):
    """Depth buffer by OpenGL's projection matrix, in double precision.

    Window depth is 0.5 + 0.5 z_clip / w_clip, with the third row of glFrustum.
    """
    if math.isinf(far_m):
        a, b = -1.0, -2.0 * near_m
    else:
        a = -(far_m + near_m) / (far_m - near_m)
        b = -2.0 * far_m * near_m / (far_m - near_m)
    return 0.5 + 0.5 * (-a * depth_m + b) / depth_m


RANGES = [(0.1, 100.0), (0.01, 1000.0), (0.05, math.inf)]


@pytest.mark.parametrize(("near_m", "far_m"), RANGES)
@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.25, 0.75)])
def test_depth_of_a_projection(near_m, far_m, low, high):
    depth_m = scene_m()
    values = (low + (high - low) * projected(depth_m, near_m, far_m)).astype(np.float32)
    given = DepthRange(low, high, near_m, far_m)
    found_m, note = planar_depth(values, given, (WIDTH_PX, HEIGHT_PX))
    assert note == ""
    assert found_m.dtype == np.float32
    # The float32 buffer itself resolves 1/z to 2^-24 of the range.
    error_dpt = np.abs(1.0 / found_m - 1.0 / depth_m).max()
    assert error_dpt <= 4.0 * 2.0**-24 / near_m / (high - low)


@pytest.mark.parametrize(("near_m", "far_m"), RANGES)
def test_reversed_depth_of_a_projection(near_m, far_m):
    depth_m = scene_m()
    values = (1.0 - projected(depth_m, near_m, far_m)).astype(np.float32)
    given = DepthRange(0.0, 1.0, far_m, near_m)
    found_m, note = planar_depth(values, given, (WIDTH_PX, HEIGHT_PX))
    assert note == ""
    assert np.abs(1.0 / found_m - 1.0 / depth_m).max() <= 4.0 * 2.0**-24 / near_m


def test_background_is_at_the_far_plane():
    values = projected(scene_m(), 0.1, math.inf).astype(np.float32)
    values[:5] = 1.0
    given = DepthRange(0.0, 1.0, 0.1, math.inf)
    found_m, _ = planar_depth(values, given, (WIDTH_PX, HEIGHT_PX))
    assert np.isinf(found_m[:5]).all()
    values = projected(scene_m(), 0.1, 100.0).astype(np.float32)
    values[:5] = 1.0
    given = DepthRange(0.0, 1.0, 0.1, 100.0)
    found_m, _ = planar_depth(values, given, (WIDTH_PX, HEIGHT_PX))
    np.testing.assert_allclose(found_m[:5], 100.0, rtol=1e-3)


@pytest.mark.parametrize(("near_m", "far_m"), RANGES)
@pytest.mark.parametrize("is_reversed", [False, True])
def test_swapped_planes_are_corrected(near_m, far_m, is_reversed):
    depth_m = scene_m()
    values = projected(depth_m, near_m, far_m)
    if is_reversed:
        values, planes = 1.0 - values, (near_m, far_m)  # wrong: it is the other way
    else:
        planes = (far_m, near_m)
    given = DepthRange(0.0, 1.0, *planes)
    found_m, note = planar_depth(
        values.astype(np.float32), given, (WIDTH_PX, HEIGHT_PX)
    )
    assert "swapped" in note
    assert np.abs(1.0 / found_m - 1.0 / depth_m).max() <= 4.0 * 2.0**-24 / near_m


def test_a_hand_close_to_the_eyes_is_not_taken_for_swapped_planes():
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), 0.25)
    depth_m[:4] = 3.0
    values = projected(depth_m, 0.1, 100.0).astype(np.float32)
    given = DepthRange(0.0, 1.0, 0.1, 100.0)
    found_m, note = planar_depth(values, given, (WIDTH_PX, HEIGHT_PX))
    assert note == ""
    np.testing.assert_allclose(found_m, depth_m, rtol=1e-4)


GOOD = DepthRange(0.0, 1.0, 0.1, 100.0)


@pytest.mark.parametrize(
    ("given", "note"),
    [
        (GOOD._replace(near_m=0.0), "planes are at 0 and 100 m"),
        (GOOD._replace(near_m=math.nan), "planes are at nan"),
        (GOOD._replace(far_m=-1.0), "planes are at 0.1 and -1 m"),
        (GOOD._replace(near_m=100.0), "both its planes are at 100 m"),
        (GOOD._replace(min_depth=1.0, max_depth=0.0), "range of the buffer is 1 to 0"),
        (GOOD._replace(max_depth=2.0), "range of the buffer is 0 to 2"),
        (GOOD._replace(min_depth=math.nan), "range of the buffer is nan"),
    ],
)
def test_wrong_numbers(given, note):
    values = projected(scene_m(), 0.1, 100.0).astype(np.float32)
    found_m, said = planar_depth(values, given, (WIDTH_PX, HEIGHT_PX))
    assert found_m is None
    assert note in said


@pytest.mark.parametrize(
    ("value", "note"),
    [
        (0.0, "all its values are 0"),
        (1.0, "all its values are 1"),
        (math.nan, "out of range"),
        (math.inf, "out of range"),
        (-0.5, "out of range"),
    ],
)
def test_buffers_without_depth(value, note):
    values = np.full((HEIGHT_PX, WIDTH_PX), value, np.float32)
    found_m, said = planar_depth(values, GOOD, (WIDTH_PX, HEIGHT_PX))
    assert found_m is None
    assert note in said


def test_few_invalid_values_are_missing_depth():
    depth_m = scene_m()
    values = projected(depth_m, 0.1, 100.0).astype(np.float32)
    values[0, :9] = math.nan
    found_m, note = planar_depth(values, GOOD, (WIDTH_PX, HEIGHT_PX))
    assert note == ""
    assert (found_m[0, :9] == 0.0).all()
    assert (found_m[1:] > 0.0).all()


def test_another_size_is_resampled():
    depth_m = scene_m()
    values = projected(depth_m, 0.1, 100.0).astype(np.float32)[::2, ::2]
    found_m, note = planar_depth(values, GOOD, (WIDTH_PX, HEIGHT_PX))
    assert note == ""
    assert found_m.shape == depth_m.shape
    np.testing.assert_allclose(found_m[::2, ::2], depth_m[::2, ::2], rtol=1e-3)
    np.testing.assert_array_equal(found_m[::2, ::2], found_m[1::2, 1::2])


def test_noise_is_no_depth():
    values = np.random.default_rng(1).random((HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    found_m, note = planar_depth(values, GOOD, (WIDTH_PX, HEIGHT_PX))
    assert found_m is None
    assert "unrelated" in note


def test_a_photograph_is_depth():
    # Depth by stereo of a real room, with noise and holes.
    data = pytest.importorskip("skimage.data")
    _, _, disparity_px = data.stereo_motorcycle()
    depth_m = np.where(np.isfinite(disparity_px), 994.978 * 0.193001, np.nan)
    depth_m = depth_m / (disparity_px + 31.086)  # calibration of the Middlebury set
    values = projected(depth_m, 0.1, 100.0).astype(np.float32)
    height_px, width_px = values.shape
    found_m, note = planar_depth(values, GOOD, (width_px, height_px))
    assert note == ""
    is_known = np.isfinite(depth_m)
    np.testing.assert_allclose(found_m[is_known], depth_m[is_known], rtol=2e-4)


def test_depth_of_qt():
    # Read from Qt 6.12 on Monado: surfaces at these depths, planes at "5 and 2000 m".
    depth_m = np.repeat([[0.45, 2.30, 5.995]], 20, axis=1)
    values = np.repeat([[0.945558, 0.990356, 0.997073]], 20, axis=1).astype(np.float32)
    meant, note = corrected_range(DepthRange(0.0, 1.0, 5.0, 2000.0), "Qt")
    assert "centimeters" in note
    found_m, _ = planar_depth(values, meant, (60, 1))
    np.testing.assert_allclose(1.0 / found_m, 1.0 / depth_m, atol=2e-5)
    as_stated = DepthRange(0.0, 1.0, 0.05, 20.0)
    assert corrected_range(as_stated, "Qt") == (as_stated, "")
    assert corrected_range(DepthRange(0.0, 1.0, 5.0, 2000.0), "other")[1] == ""


def test_a_wall_across_the_view_is_depth():
    values = projected(np.full((HEIGHT_PX, WIDTH_PX), 2.0), 0.1, 100.0)
    found_m, note = planar_depth(values.astype(np.float32), GOOD, (WIDTH_PX, HEIGHT_PX))
    assert note == ""
    np.testing.assert_allclose(found_m, 2.0, rtol=1e-5)


def test_values_at_the_near_plane_are_missing_depth():
    depth_m = scene_m()
    values = projected(depth_m, 0.1, 100.0).astype(np.float32)
    values[:, 1::2] = 0.0
    found_m, note = planar_depth(values, GOOD, (WIDTH_PX, HEIGHT_PX))
    assert note == ""
    assert (found_m[:, 1::2] == 0.0).all()
    np.testing.assert_allclose(found_m[:, ::2], depth_m[:, ::2], rtol=1e-3)
