"""An eye that follows what it sees: the pupil the light, the focus the distance."""

import math

import numpy as np
import pytest

from clients.natural_eye import (
    NaturalEye,
    distance_at,
    field_area_deg2,
    luminance_cd_m2,
    planar_depth_at,
)
from clients.pyrender_stream import looking_naturally
from clients.scene_renderer import SceneFrame
from estimator.dynamics import steady_pupil_mm
from filter_service import Camera
from filter_service.messages import State

CAMERA = Camera.from_fov(60.0, width_px=160, height_px=120)


def wall(depth_m, *, gray=128):
    color = np.full((120, 160, 3), gray, np.uint8)
    return color, np.full((120, 160), depth_m, np.float32)


def frame(depth_m, *, gray=128, gaze_deg=None):
    color, depth = wall(depth_m, gray=gray)
    return SceneFrame(
        color, depth, CAMERA.tangents, np.eye(4), State(9.0, 9.0, gaze_deg)
    )


@pytest.mark.parametrize("gray", [0, 10, 128, 255])
def test_luminance_is_that_of_the_display(gray):
    color, _ = wall(1.0, gray=gray)
    level = gray / 255
    linear = level / 12.92 if level <= 0.04045 else ((level + 0.055) / 1.055) ** 2.4
    assert luminance_cd_m2(color, 250.0) == pytest.approx(250.0 * linear, rel=1e-5)


def test_primaries_count_by_their_luminance():
    for channel, share in enumerate((0.2126, 0.7152, 0.0722)):
        color = np.zeros((64, 64, 3), np.uint8)
        color[..., channel] = 255
        assert luminance_cd_m2(color, 100.0) == pytest.approx(100 * share, rel=1e-5)


def test_the_distance_is_along_the_ray():
    _, depth_m = wall(2.0)
    for h_deg, v_deg in ((0.0, 0.0), (20.0, 0.0), (-15.0, 12.0)):
        h, v = math.radians(h_deg), math.radians(v_deg)
        expected = 2.0 / (math.cos(h) * math.cos(v))
        found = distance_at(depth_m, CAMERA, (h_deg, v_deg))
        assert found == pytest.approx(expected, rel=1e-6)


def test_a_thin_thing_before_what_is_looked_at_does_not_count():
    _, depth_m = wall(3.0)
    depth_m[:, 80] = 0.2
    depth_m[60, :] = np.nan
    assert planar_depth_at(depth_m, CAMERA, (0.0, 0.0)) == 3.0


def test_between_two_things_the_nearer_is_looked_at_and_no_mean():
    _, depth_m = wall(4.0)
    depth_m[:, :80] = 0.5
    assert planar_depth_at(depth_m, CAMERA, (0.0, 0.0)) in (0.5, 4.0)


def test_where_nothing_is_known_nothing_is_said():
    _, depth_m = wall(0.0)  # missing
    assert distance_at(depth_m, CAMERA, (0.0, 0.0)) is None
    _, depth_m = wall(np.inf)
    assert distance_at(depth_m, CAMERA, (0.0, 0.0)) == math.inf
    assert distance_at(depth_m, CAMERA, (80.0, 0.0)) is None  # beside the picture


def test_the_area_of_a_field():
    assert field_area_deg2(CAMERA) == pytest.approx(
        60.0 * 2 * math.degrees(math.atan(math.tan(math.radians(30)) * 4 / 3))
    )


def test_an_eye_begins_steady_in_what_it_sees():
    eye = NaturalEye(age_years=40.0, field_area_deg2=2000.0)
    state = eye.look(50.0, 0.0, 7.0)
    assert state.pupil_diameter_mm == pytest.approx(steady_pupil_mm(50.0, 2000.0, 40.0))
    assert state.focus_dpt == 0.0


def test_a_stream_follows_light_and_distance():
    """Far and dark, then near and bright: the focus comes first, the pupil closes."""
    clock = iter(np.arange(0.0, 12.0, 1 / 60))
    far, near = frame(np.inf, gray=20), frame(0.4, gray=250)
    frames = [far] * 60 + [near] * 600
    seen = list(
        looking_naturally(
            iter(frames), NaturalEye(age_years=25.0), clock=lambda: next(clock)
        )
    )
    focus = np.array([f.focus_dpt for f in seen])
    pupil = np.array([f.pupil_diameter_mm for f in seen])
    assert not focus[:60].any()
    moves = int(np.argmax(focus > 0.01)) / 60 - 1.0
    assert 0.33 <= moves <= 0.42  # latency of accommodation, 0.36 s
    assert focus[-1] == pytest.approx(2.5, abs=0.01)
    assert np.all(np.diff(focus) >= 0.0)
    closes = int(np.argmax(pupil < pupil[59] - 0.01)) / 60 - 1.0
    assert 0.2 <= closes <= 0.36
    assert pupil[-1] < pupil[0] - 1.0
    assert seen[0].color is far.color


def moving(eye, distances_dpt, limits_dpt, rate_hz=50):
    """Ask an eye for a second of each distance; answer as a filter with limits does."""
    found = []
    for step, distance_dpt in enumerate(np.repeat(distances_dpt, rate_hz)):
        far_dpt, near_dpt = limits_dpt(step / rate_hz)
        asked = eye.look(50.0, distance_dpt, step / rate_hz).focus_dpt
        used = min(max(asked, far_dpt), near_dpt)
        eye.learn(asked, used)
        found.append(used)
    return np.array(found)


def test_a_far_point_that_moves_with_the_pupil_is_followed_both_ways():
    """5.6 dpt through a wide pupil, 0 through a narrow one, as of a cataract."""
    eye = NaturalEye(pupil_diameter_mm=4.0)
    used = moving(
        eye, [0.0] * 12, lambda at_s: (5.6 if at_s < 4 or at_s >= 8 else 0.0, 20.0)
    )
    assert used[199] == pytest.approx(5.6)
    assert used[399] == pytest.approx(0.0, abs=0.05)
    assert used[-1] == pytest.approx(5.6)


def test_a_way_from_the_far_point_is_gone_without_a_jump():
    """A myope of 2 dpt: latency, then up to 5 dpt and back, steadily."""
    used = moving(
        NaturalEye(pupil_diameter_mm=4.0),
        [0.0] * 2 + [5.0] * 3 + [0.0] * 4,
        lambda at_s: (2.0, 7.0),
    )
    assert used[:100] == pytest.approx(2.0)
    up, down = used[100:250], used[270:]  # after the latency
    assert np.all(np.diff(up) >= -1e-9)
    assert np.all(np.diff(down) <= 1e-9)
    assert up[-1] == pytest.approx(5.0, abs=0.05)
    assert used[-1] == pytest.approx(2.0)
    assert np.abs(np.diff(used)).max() < 0.5


def test_a_near_point_stops_an_old_eye():
    used = moving(
        NaturalEye(pupil_diameter_mm=4.0),
        [0.0] + [3.0] * 4 + [0.0] * 4,
        lambda at_s: (0.0, 0.8),
    )
    assert used[230:250] == pytest.approx(0.8)
    assert used[-1] == pytest.approx(0.0, abs=0.02)
    assert np.all(np.diff(used[260:]) <= 1e-9)


def test_a_fixed_pupil_stays_and_wrong_values_are_named():
    eye = NaturalEye(pupil_diameter_mm=4.5)
    assert eye.look(1.0, 0.0, 0.0).pupil_diameter_mm == 4.5
    assert eye.look(1000.0, 0.0, 5.0).pupil_diameter_mm == 4.5
    for wrong, words in (
        ({"age_years": 2}, "3 to 120"),
        ({"pupil_diameter_mm": 12}, "0.5 to 9"),
    ):
        with pytest.raises(ValueError, match=words):
            NaturalEye(**wrong)
