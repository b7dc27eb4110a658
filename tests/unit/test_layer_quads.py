"""Quad layers are drawn into pictures as a ray through each pixel meets them."""

import math

import numpy as np
import pytest

from clients.headset.runtime import EyeView, turned
from clients.headset.stereo_gaze import RgbdPicture
from clients.openxr_layer import wire
from clients.openxr_layer.quads import Quad, draw_quads, light_of

SIZE_PX = (40, 30)
TANGENTS = (-0.8, 0.7, 0.6, -0.5)
BEHIND_M = 3.0


def turn(quaternion, vector):
    """Rotate a vector: v + 2 q x (q x v + w v)."""
    *axis, w = quaternion
    inner = np.cross(axis, vector) + w * np.array(vector)
    return np.array(vector) + 2.0 * np.cross(axis, inner)


def linear(code):
    """Decode a byte of sRGB (IEC 61966-2-1)."""
    value = code / 255.0
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def srgb(light):
    """Encode light as a byte of sRGB."""
    light = min(max(light, 0.0), 1.0)
    value = 12.92 * light if light <= 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055
    return round(255.0 * value)


def sampled(light, across, down):
    """Return an image between its pixels, from the four around a point."""
    height_px, width_px = light.shape[:2]
    total = np.zeros(4)
    x, y = across * width_px - 0.5, down * height_px - 0.5
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            weight = (1.0 - abs(x - column)) * (1.0 - abs(y - row))
            pixel = light[
                min(max(row, 0), height_px - 1), min(max(column, 0), width_px - 1)
            ]
            total += weight * pixel
    return total


def over_by_rays(color, depth_m, view, quad):
    """Draw a quad into bytes of sRGB and planar depth, ray by ray."""
    color, depth_m = color.copy(), depth_m.copy()
    height_px, width_px = depth_m.shape
    left, right, up, down = view.tangents
    right_side, upper_side, front = (turn(quad.pose[3:], axis) for axis in np.eye(3))
    center, eye = np.array(quad.pose[:3]), np.array(view.pose[:3])
    for row in range(height_px):
        for column in range(width_px):
            x = left + (column + 0.5) / width_px * (right - left)
            y = up - (row + 0.5) / height_px * (up - down)
            ray = turn(view.pose[3:], (x, y, -1.0))
            if not ray @ front < 0.0:
                continue
            far_m = ((center - eye) @ front) / (ray @ front)
            point = eye + far_m * ray - center
            u = point @ right_side / quad.size_m[0] + 0.5
            v = point @ upper_side / quad.size_m[1] + 0.5
            if far_m <= 1e-3 or not (0 <= u <= 1 and 0 <= v <= 1):
                continue
            *light, alpha = sampled(quad.light.astype(float), u, 1.0 - v)
            for channel in range(3):
                behind = linear(color[row, column, channel])
                color[row, column, channel] = srgb(
                    light[channel] + (1.0 - alpha) * behind
                )
            if alpha >= 0.5:
                depth_m[row, column] = far_m
    return color, depth_m


def some_light(seed=0, alpha=None):
    random = np.random.default_rng(seed)
    raw = random.integers(0, 256, (6, 9, 4)).astype(np.uint8)
    if alpha is not None:
        raw[..., 3] = alpha
    flags = wire.TOP_FIRST | wire.IS_BLENDED | wire.IS_UNPREMULTIPLIED
    return light_of(raw, wire.SRGB8, flags)


def picture(eye="left"):
    random = np.random.default_rng(1)
    width_px, height_px = SIZE_PX
    color = random.integers(0, 256, (height_px, width_px, 3)).astype(np.uint8)
    depth_m = np.full((height_px, width_px), BEHIND_M, np.float32)
    pose = (0.1, 0.2, 0.3, *turned(12.0, -5.0))
    return RgbdPicture(EyeView(eye, pose, TANGENTS), color, depth_m)


CASES = {
    "ahead": ((0.0, 0.0, -1.0, *turned(0.0)), (0.6, 0.4)),
    "oblique": ((-0.2, 0.3, -1.5, *turned(50.0, 20.0)), (1.4, 0.8)),
    "past the edge": ((0.9, 0.6, -1.0, *turned(-20.0)), (1.0, 0.8)),
    "through the plane of the eye": ((0.6, 0.2, 0.3, *turned(-80.0)), (4.0, 1.0)),
    "from behind": ((0.0, 0.0, -1.0, *turned(180.0)), (0.6, 0.4)),
    "behind the eye": ((0.0, 0.0, 2.0, *turned(0.0)), (0.6, 0.4)),
}


@pytest.mark.parametrize("alpha", [255, 40, None])
@pytest.mark.parametrize("case", CASES)
def test_a_quad_is_where_rays_meet_it(case, alpha):
    pose, size_m = CASES[case]
    quad = Quad(pose, size_m, some_light(alpha=alpha), ("left", "right"))
    found = picture()
    before = found.color.copy()
    color, depth_m = over_by_rays(found.color, found.depth_m, found.view, quad)
    draw_quads(found, [quad])
    # Where a ray meets the very edge, rounding decides.
    differs = np.abs(found.color.astype(int) - color).max(axis=2) > 1
    assert differs.sum() <= 1
    same_m = np.isclose(found.depth_m, depth_m, rtol=1e-5)
    assert (~same_m).sum() <= 1
    is_hidden = case in ("from behind", "behind the eye")
    assert (found.color == before).all() == is_hidden


def test_eyes_that_do_not_see_a_quad():
    quad = Quad(*CASES["ahead"], some_light(), ("right",))
    found = picture("left")
    before = found.color.copy()
    draw_quads(found, [quad])
    np.testing.assert_array_equal(found.color, before)
    assert (found.depth_m == BEHIND_M).all()


def test_the_upper_of_two_quads_hides_the_lower():
    pose, size_m = CASES["ahead"]
    lower = Quad(pose, size_m, some_light(1, 255), ("left",))
    upper = Quad(pose, size_m, some_light(2, 255), ("left",))
    both, alone = picture(), picture()
    draw_quads(both, [lower, upper])
    draw_quads(alone, [upper])
    np.testing.assert_array_equal(both.color, alone.color)


def test_images_are_upright_with_opacity():
    raw = np.zeros((2, 1, 4), np.uint8)
    raw[0] = (255, 0, 51, 102)  # the first row: blue, green, red
    bgr = wire.IS_BGR | wire.TOP_FIRST
    assert light_of(raw, wire.LINEAR8, bgr)[0, 0] == pytest.approx((0.2, 0, 1, 1))
    blended = light_of(raw, wire.LINEAR8, bgr | wire.IS_BLENDED)
    assert blended[0, 0] == pytest.approx((0.2, 0, 1, 0.4))
    unpremultiplied = bgr | wire.IS_BLENDED | wire.IS_UNPREMULTIPLIED
    given = light_of(raw, wire.LINEAR8, unpremultiplied)
    assert given[0, 0] == pytest.approx((0.08, 0, 0.4, 0.4))
    bottom_first = light_of(raw, wire.LINEAR8, 0)
    assert bottom_first[1, 0] == pytest.approx((1, 0, 0.2, 1))
    packed = np.array([[1023 | 341 << 20 | 2 << 30]], np.uint32)
    ten = light_of(packed, wire.LINEAR10, wire.IS_BLENDED)
    assert ten[0, 0] == pytest.approx((1, 0, 1 / 3, 2 / 3))
    half = light_of(np.full((1, 1, 4), np.nan, np.float16), wire.LINEAR16F, 0)
    assert half[0, 0] == pytest.approx((0, 0, 0, 1))
