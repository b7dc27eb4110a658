"""Where eyes in a headset look: gaze, focus, pupils, trackers."""

from dataclasses import replace

import numpy as np
import pytest

from clients.headset.runtime import (
    EYE_DISTANCE_M,
    DueFrame,
    GazeSample,
    Happening,
    SimulatedRuntime,
    angles_of,
    direction_of,
    eye_views,
    still,
    turned,
)
from clients.headset.stereo_gaze import StereoGaze
from tests.end_to_end.headset_doubles import (
    SIZE_PX,
    WALL_M,
    Inverting,
    Wall,
    pictures_of,
    viewer_of,
)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"age_years": 200.0}, "age_years is 200.0; allowed: 3 to 120"),
        ({"age_years": 25.0, "pupil_diameter_mm": 30.0}, "allowed: 0.5 to 9"),
    ],
)
def test_a_wrong_person_is_refused_before_there_is_a_picture(wrong, said):
    with pytest.raises(ValueError, match=said):
        StereoGaze(**wrong)


def test_focus_follows_the_depth_at_the_gaze_and_not_vergence():
    """A wall at 2 m, seen 20 deg aside: the ray is longer than the depth."""
    look = StereoGaze(age_years=25.0, gaze_range_deg=(40.0, 30.0))
    pictures = pictures_of(still(0.0))
    head = still(0.0)
    for step in range(400):
        at_s = 0.01 * step
        due = DueFrame(
            int(1e9 * at_s),
            True,
            eye_views(head),
            head,
            GazeSample(20.0, 10.0, at_s),
        )
        left, right = look.follow(due, pictures)
    ray = direction_of(20.0, 10.0)
    distance_m = WALL_M / -ray[2]
    assert look.is_tracked
    assert left.state.focus_dpt == pytest.approx(1.0 / distance_m, rel=2e-3)
    assert left.state.focus_dpt == right.state.focus_dpt
    point = distance_m * ray
    for eye, side_m in ((left, -0.5), (right, 0.5)):
        own = point - np.array([side_m * EYE_DISTANCE_M, 0.0, 0.0])
        assert eye.gaze_deg == pytest.approx(angles_of(own), abs=0.02)


def test_a_pupil_that_is_measured_counts_and_the_light_does_not():
    head = still(0.0)
    for measured_mm, used_mm in ((5.5, 5.5), (0.1, 0.5), (None, None)):
        due = DueFrame(0, True, eye_views(head), head, pupil_diameter_mm=measured_mm)
        for eye in StereoGaze(age_years=25.0).follow(due, pictures_of(head)):
            found_mm = eye.state.pupil_diameter_mm
            assert found_mm == used_mm if used_mm else 2.0 < found_mm < 5.0


def test_without_a_tracker_eyes_look_straight_ahead():
    head = still(0.0)
    look = StereoGaze(age_years=25.0)
    left, right = look.follow(
        DueFrame(0, True, eye_views(head), head), pictures_of(head)
    )
    assert not look.is_tracked
    assert left.gaze_deg == right.gaze_deg == (0.0, 0.0)


def test_a_tracker_that_is_lost_is_told_once():
    happening = Happening(gaze_deg=(5.0, 0.0))
    said, seeing = [], Inverting()

    def keys():
        if len(seeing.frames) == 10:
            happening.gaze_deg = None
        return ""

    runtime = SimulatedRuntime(SIZE_PX, rate_hz=100.0, happening=happening)
    viewer_of(
        runtime,
        seeing,
        said=said,
        keys=keys,
        look=StereoGaze(age_years=30.0, gaze_range_deg=(10.0, 10.0)),
    ).run(limit_s=1.0)
    about = [line for line in said if "track" in line]
    assert about == [
        "eyes are tracked",
        "the eye tracker lost the eyes: gaze is straight ahead",
    ]
    # Frames before that look where the tracker saw it, from then on straight ahead.
    gazes = [frame.eyes[0].gaze_deg[0] for frame in seeing.frames]
    assert gazes[5] > 3.0
    ahead = angles_of((EYE_DISTANCE_M / 2, 0, -WALL_M))[0]
    assert gazes[-1] == pytest.approx(ahead, abs=0.05)  # the head sways


def test_the_far_point_is_learnt_from_what_the_filter_says():
    """A myope of 4 dpt looks from far to 5 dpt: the way begins at 4."""
    head = still(0.0)
    pictures = pictures_of(head)
    near = tuple(replace(p, depth_m=np.full_like(p.depth_m, 0.2)) for p in pictures)
    look = StereoGaze(age_years=25.0)

    def at(at_s, seen):
        due = DueFrame(int(1e9 * at_s), True, eye_views(head), head)
        return look.follow(due, seen)

    look.learn(pictures, at(0.0, pictures), (4.0, None))
    begun = [at(0.02 * step, near)[0].state.focus_dpt for step in range(1, 300)]
    assert begun[0] == pytest.approx(4.0, abs=1e-6)
    assert begun[-1] == pytest.approx(5.0, abs=0.05)


@pytest.mark.parametrize("with_head", [True, False])
def test_straight_ahead_is_the_heads_own_in_canted_views(with_head):
    """Displays that look 10 deg outward: ahead is 10 deg inward in each."""
    head = still(0.0)
    views = tuple(
        replace(view, pose=(*view.pose[:3], *turned(yaw_deg)))
        for view, yaw_deg in zip(eye_views(head), (10.0, -10.0), strict=True)
    )
    due = DueFrame(0, True, views, head if with_head else None)
    wall = Wall().pictures(views, (400, 360))
    left, right = StereoGaze(age_years=25.0).follow(due, wall)
    assert left.ahead_deg == left.gaze_deg == pytest.approx((10.0, 0.0), abs=0.01)
    assert right.ahead_deg == right.gaze_deg == pytest.approx((-10.0, 0.0), abs=0.01)
