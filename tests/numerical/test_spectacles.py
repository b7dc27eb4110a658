"""The size of the world through worn spectacles."""

import numpy as np
import pytest

from estimator.profiles.parse import ProfileError, parse_profile
from filter_service.camera import Camera
from filter_service.rendering.media_effects import (
    MediaEffects,
    seen_through,
    spectacle_magnification,
)
from filter_service.rgbd_view import RgbdView

CAMERA = Camera.from_fov(40.0, width_px=160, height_px=120)


def profile(worn, **more):
    return parse_profile(
        {
            "kind": "prescription",
            "sphere_dpt": -6.0,
            "correction": worn,
            "spectacle_magnification": True,
            **more,
        }
    )


def view_of(color, depth_m=None):
    if depth_m is None:
        depth_m = np.ones(color.shape[:2], np.float32)
    return RgbdView(color, depth_m, CAMERA.tangents)


@pytest.mark.parametrize(
    ("sphere_dpt", "vertex_mm", "expected"),
    [(-6.0, 12.0, 0.917), (-6.0, 0.0, 0.982), (4.0, 14.0, 1.073), (-10.0, 12.0, 0.869)],
)
def test_a_sphere_magnifies_by_its_power_and_distance(sphere_dpt, vertex_mm, expected):
    """1 / (1 - L F), L from the lens to the entrance pupil (textbook)."""
    found = spectacle_magnification(
        profile({"sphere_dpt": sphere_dpt, "vertex_mm": vertex_mm})
    )
    assert np.array(found) == pytest.approx(expected * np.eye(2), abs=5e-4)


def test_a_cylinder_magnifies_by_its_meridians():
    """-4 dpt along the vertical alone: minus cylinder, axis horizontal."""
    correction = {
        "sphere_dpt": 0.0,
        "cylinder_dpt": -4.0,
        "axis_deg": 180.0,
        "vertex_mm": 12.0,
    }
    found = np.array(spectacle_magnification(profile(correction)))
    assert found == pytest.approx(np.diag([1.0, 1.0 / (1.0 + 0.01505 * 4.0)]), abs=1e-9)
    oblique = np.array(
        spectacle_magnification(profile(correction | {"axis_deg": 45.0}))
    )
    # The examiner's 45 deg is the wearer's 135: the lens minifies from lower left to
    # upper right.
    assert oblique[0, 1] == pytest.approx(oblique[1, 0])
    assert oblique[0, 1] < 0.0
    assert np.linalg.det(oblique) == pytest.approx(np.linalg.det(found))


def test_lines_move_by_the_magnification():
    color = np.zeros((120, 160, 3), np.float32)
    color[:, 120] = 1.0
    color[20] = 1.0
    found = seen_through(view_of(color), ((0.9, 0.0), (0.0, 0.9)))
    columns, rows = found.color[60, :, 0], found.color[:, 60, 0]
    column = float((np.arange(160) * columns).sum() / columns.sum())
    row = float((np.arange(120) * rows).sum() / rows.sum())
    assert column == pytest.approx(0.9 * (120 - 79.5) + 79.5, abs=0.06)
    assert row == pytest.approx(0.9 * (20 - 59.5) + 59.5, abs=0.06)


def test_no_magnification_changes_nothing_and_depth_is_never_mixed(rng):
    color = rng.integers(0, 256, (120, 160, 3), np.uint8)
    depth_m = np.where(rng.random((120, 160)) < 0.5, 1.0, 7.0).astype(np.float32)
    same = seen_through(view_of(color, depth_m), ((1.0, 0.0), (0.0, 1.0)))
    assert np.array_equal(same.depth_m, depth_m)
    encoded = np.where(
        same.color <= 0.0031308,
        12.92 * same.color,
        1.055 * same.color ** (1 / 2.4) - 0.055,
    )
    assert np.array_equal(np.round(255.0 * encoded), color)
    smaller = seen_through(view_of(color, depth_m), ((0.8, 0.0), (0.0, 0.8)))
    assert set(np.unique(smaller.depth_m)) == {1.0, 7.0}


def test_it_is_off_unless_asked_for():
    correction = {"sphere_dpt": -6.0, "vertex_mm": 12.0}
    off = parse_profile(
        {"kind": "prescription", "sphere_dpt": -6.0, "correction": correction}
    )
    assert MediaEffects.of(off, "common") is None
    assert MediaEffects.of(profile(correction), "common").magnification_ratio


@pytest.mark.parametrize("more", [{"spectacle_magnification": 1}, {"correction": None}])
def test_a_magnification_without_a_lens_or_a_word_is_refused(more):
    with pytest.raises(ProfileError, match="magnification"):
        profile({"sphere_dpt": -6.0}, **more)
