"""The headset's viewer against a simulated headset: loops, losses, poses, eyes.

`make test-headset` runs it against a real OpenXR runtime.
"""

import json
import math
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from clients.headset import program
from clients.headset.controls import Controls
from clients.headset.look import EyeState, LookingEye, RgbdPicture, StereoLook
from clients.headset.poses import angles_of, direction_of, matrix_of, turned, upright
from clients.headset.runtime import (
    EYES,
    DueFrame,
    GazeSample,
    NoRuntime,
    SessionLost,
)
from clients.headset.seeing import LookedAt, SeeingByService, SeeingHere, Seen
from clients.headset.simulated_runtime import (
    EYE_DISTANCE_M,
    Happening,
    SimulatedRuntime,
    eye_views,
    still,
    swaying,
)
from clients.headset.viewer import Viewer
from clients.service_process import CHECKOUT
from filter_service import FilterSettings
from tests.end_to_end.conftest import TIMEOUT_S

SIZE_PX = (40, 36)
WALL_M = 2.0


class Wall:
    """A wall in front of the room's origin, painted by where it is hit.

    Its pictures tell the pose that they were rendered for: red goes with the azimuth of
    a pixel's ray in the room, green with its elevation, blue with the eye.
    """

    def pictures(self, views, size_px):
        return tuple(self._picture(view, size_px) for view in views)

    def _picture(self, view, size_px):
        width, height = size_px
        left, right, up, down = view.tangents
        x = left + (right - left) * (np.arange(width) + 0.5) / width
        y = up + (down - up) * (np.arange(height) + 0.5) / height
        rays = np.stack(np.broadcast_arrays(x, y[:, None], -1.0), axis=-1)
        matrix = matrix_of(view.pose)
        toward = rays @ matrix[:3, :3].T
        depth_m = (-WALL_M - matrix[2, 3]) / toward[..., 2]
        h = np.arctan2(toward[..., 0], -toward[..., 2])
        v = np.arctan2(toward[..., 1], np.hypot(toward[..., 0], toward[..., 2]))
        blue = np.full(h.shape, 60.0 if view.eye == "left" else 180.0)
        color = np.stack([127 + 80 * h, 127 + 80 * v, blue], axis=-1)
        color = np.clip(color, 0, 255).astype(np.uint8)
        seen = np.where(depth_m > 0, depth_m, np.inf).astype(np.float32)
        return RgbdPicture(view, color, seen)


class Inverting:
    """Sees each picture inverted; answers so many frames late."""

    def __init__(self, late=0):
        self.frames, self.late, self.changes = [], late, []

    def change(self, eye, profile):
        self.changes.append((eye, profile))

    def see(self, frame):
        self.frames.append(frame)
        if len(self.frames) <= self.late:
            return None
        frame = self.frames[-1 - self.late]
        return Seen(
            frame,
            tuple(picture.view for picture in frame.pictures),
            tuple(255 - picture.color for picture in frame.pictures),
            tuple(eye.state.focus_dpt for eye in frame.eyes),
            True,
            (),
        )

    def restart(self):
        """What was seen in another session does not come back."""
        self.frames = []

    def close(self):
        """Nothing is held."""


def viewer_of(
    runtime, seeing, *, said=None, keys=str, profiles=None, scenery=None, look=None
):
    opened = iter(runtime if isinstance(runtime, list) else [runtime])

    def open_runtime():
        found = next(opened)
        if isinstance(found, Exception):
            raise found
        return found

    return Viewer(
        open_runtime,
        scenery or Wall(),
        seeing,
        look or StereoLook(age_years=35.0),
        Controls(profiles or {}, seeing.change),
        read_keys=keys,
        say=(said if said is not None else []).append,
    )


def test_poses_turn_left_and_up():
    matrix = matrix_of((1.0, 2.0, 3.0, *turned(30.0, 20.0)))
    ahead = matrix[:3, :3] @ direction_of(0.0, 0.0)
    np.testing.assert_allclose(ahead, direction_of(-30.0, 20.0), atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 3], (1.0, 2.0, 3.0))
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
    assert angles_of(direction_of(12.0, -7.0)) == pytest.approx((12.0, -7.0))
    level = upright(matrix)
    np.testing.assert_allclose(level[:3, 1], (0.0, 1.0, 0.0))
    np.testing.assert_allclose(
        level[:3, :3] @ direction_of(0, 0), direction_of(-30.0, 0.0), atol=1e-12
    )
    with pytest.raises(ValueError, match="no unit quaternion"):
        matrix_of((0.0,) * 7)


def test_a_simulated_head_has_two_eyes_apart():
    left, right = eye_views(swaying(1.0))
    apart = np.subtract(right.pose[:3], left.pose[:3])
    assert np.linalg.norm(apart) == pytest.approx(EYE_DISTANCE_M)
    assert left.tangents[0] == -right.tangents[1]
    assert left.tangents[1] == -right.tangents[0]


@pytest.mark.parametrize("late", [0, 1, 3])
def test_a_picture_is_shown_with_the_pose_that_it_was_rendered_for(late):
    """However late: never with another frame's pose, and with its own depth."""
    shown_all = []
    runtime = SimulatedRuntime(
        SIZE_PX,
        rate_hz=500.0,
        on_shown=lambda due, shown: shown_all.append((due, shown)),
    )
    wall = Wall()
    log = viewer_of(runtime, Inverting(late), scenery=wall).run(max_frames=30)
    assert log.n_filtered == 30
    assert log.n_plain == late
    n_behind = 0
    for due, shown in shown_all[late:]:
        for view in shown:
            expected = wall.pictures([view.view], SIZE_PX)[0]
            np.testing.assert_array_equal(view.color, 255 - expected.color)
            np.testing.assert_array_equal(view.depth_m, expected.depth_m)
            now = eye_views(due.head)[EYES.index(view.view.eye)]
            n_behind += view.view.pose != now.pose
    assert n_behind == (60 if late else 0)


def test_what_nobody_sees_is_not_rendered():
    happening = Happening(should_render=False)
    seeing = Inverting()
    n_frames = [0]

    def keys():
        n_frames[0] += 1
        happening.should_render = n_frames[0] > 20
        return ""

    runtime = SimulatedRuntime(SIZE_PX, rate_hz=500.0, happening=happening)
    log = viewer_of(runtime, seeing, keys=keys).run(max_frames=5)
    assert log.n_filtered == len(seeing.frames) == 5
    assert 15 <= log.n_hidden <= 21


def test_a_lost_session_and_a_missing_headset_are_waited_for(monkeypatch):
    monkeypatch.setattr("clients.headset.viewer.RETRY_S", 0.01)
    first = Happening()
    said, seeing = [], Inverting()

    def keys():
        first.is_lost = len(seeing.frames) == 4
        return ""

    sessions = [
        NoRuntime("no headset"),
        NoRuntime("no headset"),
        SimulatedRuntime(SIZE_PX, rate_hz=500.0, happening=first),
        NoRuntime("it is gone"),
        SimulatedRuntime(SIZE_PX, rate_hz=500.0),
    ]
    log = viewer_of(sessions, seeing, said=said, keys=keys).run(max_frames=12)
    assert log.n_sessions == 2
    assert log.n_filtered == 12
    assert len([line for line in said if line.startswith("no headset")]) == 1
    assert any("is lost" in line for line in said)
    assert any("it is gone" in line for line in said)


def test_a_session_that_the_user_ends_is_not_begun_again():
    happening, seeing, said = Happening(), Inverting(), []

    def keys():  # asked after a frame has begun: the next one does not
        happening.is_ended = len(seeing.frames) == 2
        return ""

    runtime = SimulatedRuntime(SIZE_PX, rate_hz=500.0, happening=happening)
    log = viewer_of([runtime], seeing, said=said, keys=keys).run(max_frames=50)
    assert (log.n_sessions, log.n_filtered) == (1, 3)
    assert said[-1] == "the simulated session was ended"


def test_a_clock_that_starts_again_does_not_stop_the_eyes():
    """As Monado's does when it is started again: to the eyes it is another day."""
    head = still(0.0)
    look = StereoLook(age_years=25.0, gaze_range_deg=(20.0, 20.0))
    pictures = pictures_of(head)

    def gaze_at(at_s, h_deg):
        sample = None if h_deg is None else GazeSample(h_deg, 0.0, at_s)
        due = DueFrame(int(1e9 * at_s), True, eye_views(head), head, sample)
        return look.follow(due, pictures)[0].gaze_deg[0]

    for step in range(10):
        gaze_at(10.0 + 0.1 * step, 5.0)
    assert look.is_tracked
    look.restart()
    assert gaze_at(0.3, None) < 2.0
    assert not look.is_tracked
    assert gaze_at(0.4, -8.0) < -5.0


def test_an_error_in_mid_frame_still_ends_the_frame():
    class Failing(Inverting):
        def see(self, frame):
            raise ArithmeticError("as told")

    runtime = SimulatedRuntime(SIZE_PX, rate_hz=500.0)
    with pytest.raises(ArithmeticError):
        viewer_of(runtime, Failing()).run(max_frames=1)
    assert runtime.begin_frame() is not None, "the last frame was not ended"


def test_a_filter_that_is_too_late_does_not_freeze_the_picture(monkeypatch):
    monkeypatch.setattr("clients.headset.viewer.STALE_S", 0.05)
    shown_all, said = [], []

    class Stuck(Inverting):
        def see(self, frame):
            if not self.frames:
                self.one = super().see(frame)
            return self.one

    runtime = SimulatedRuntime(
        SIZE_PX, rate_hz=100.0, on_shown=lambda due, shown: shown_all.append(shown)
    )
    wall = Wall()
    viewer_of(runtime, Stuck(), said=said, scenery=wall).run(limit_s=0.4)
    last = shown_all[-1][0]
    np.testing.assert_array_equal(
        last.color, wall.pictures([last.view], SIZE_PX)[0].color
    )
    assert len([line for line in said if "is late" in line]) == 1


def test_keys_change_eyes_split_and_end():
    seeing, shown_all = Inverting(), []
    pressed = iter(["", "2", "l", "s", "", "f", "", "s", "q"])
    runtime = SimulatedRuntime(
        SIZE_PX, rate_hz=500.0, on_shown=lambda due, shown: shown_all.append(shown)
    )
    log = viewer_of(runtime, seeing, keys=lambda: next(pressed)).run(max_frames=100)
    names = [(eye, profile["name"]) for eye, profile in seeing.changes]
    assert names == [("left", "myopia"), ("right", "myopia"), ("left", "astigmatism")]
    assert len(shown_all) == 9
    ratios = [shown[0].plain_ratio for shown in shown_all]
    assert ratios[:5] == [0.0, 0.0, 0.0, 0.5, 0.5]
    expected = Wall().pictures([shown_all[5][0].view], SIZE_PX)[0]
    np.testing.assert_array_equal(shown_all[5][0].color, expected.color)
    assert log.n_filtered == 9


def test_a_controller_changes_both_eyes():
    seeing = Inverting()
    happening = Happening(pressed=["next_eye", "on_off"])
    runtime = SimulatedRuntime(SIZE_PX, rate_hz=500.0, happening=happening)
    viewer = viewer_of(runtime, seeing)
    viewer.run(max_frames=2)
    assert [eye for eye, _ in seeing.changes] == ["left", "right"]


def pictures_of(head, depth_of_wall=Wall):
    return depth_of_wall().pictures(eye_views(head), (400, 360))


def test_focus_follows_the_depth_at_the_gaze_and_not_vergence():
    """A wall at 2 m, seen 20 deg aside: the ray is longer than the depth."""
    look = StereoLook(age_years=25.0, gaze_range_deg=(40.0, 30.0))
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
        for eye in StereoLook(age_years=25.0).follow(due, pictures_of(head)):
            found_mm = eye.state.pupil_diameter_mm
            assert found_mm == used_mm if used_mm else 2.0 < found_mm < 5.0


def test_without_a_tracker_eyes_look_straight_ahead():
    head = still(0.0)
    look = StereoLook(age_years=25.0)
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
        look=StereoLook(age_years=30.0, gaze_range_deg=(10.0, 10.0)),
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
    look = StereoLook(age_years=25.0)

    def at(at_s, seen):
        due = DueFrame(int(1e9 * at_s), True, eye_views(head), head)
        return look.follow(due, seen)[0].state.focus_dpt

    asked = at(0.0, pictures)
    look.learn("left", asked, 4.0)
    begun = [at(0.02 * step, near) for step in range(1, 300)]
    assert begun[0] == pytest.approx(4.0, abs=1e-6)
    assert begun[-1] == pytest.approx(5.0, abs=0.05)


def test_how_far_eyes_turn_follows_from_the_tracker_unless_it_is_told():
    with_tracker = SimulatedRuntime(happening=Happening(gaze_deg=(0.0, 0.0)))
    without = SimulatedRuntime()
    for arguments, runtime, expected in (
        ((), with_tracker, (15.0, 10.0)),
        ((), without, (0.0, 0.0)),
        (("--gaze-range", "3,2"), with_tracker, (3.0, 2.0)),
        (("--gaze-range", "0,0"), with_tracker, (0.0, 0.0)),
        (("--settings", '{"gaze_range_deg": [5, 4]}'), without, (5.0, 4.0)),
    ):
        options = program.arguments_of(arguments)
        settings = program.settings_of(options)
        assert program.gaze_range_of(options, settings, runtime) == expected


@pytest.mark.parametrize("with_head", [True, False])
def test_straight_ahead_is_the_heads_own_in_canted_views(with_head):
    """Displays that look 10 deg outwards: ahead is 10 deg inwards in each."""
    head = still(0.0)
    views = tuple(
        replace(view, pose=(*view.pose[:3], *turned(yaw_deg)))
        for view, yaw_deg in zip(eye_views(head), (10.0, -10.0), strict=True)
    )
    due = DueFrame(0, True, views, head if with_head else None)
    wall = Wall().pictures(views, (400, 360))
    left, right = StereoLook(age_years=25.0).follow(due, wall)
    assert left.ahead_deg == left.gaze_deg == pytest.approx((10.0, 0.0), abs=0.01)
    assert right.ahead_deg == right.gaze_deg == pytest.approx((-10.0, 0.0), abs=0.01)


def test_an_eye_learns_from_its_own_pictures_only():
    """The eye before serves until the new one is ready: what it can do is another's."""
    seeing = SeeingHere(
        FilterSettings(
            pupil_range_mm=(4.0, 4.0),
            object_range_dpt=(0.0, 1.0),
            tolerance="loose",
            mode="on-axis",
        ),
        lambda line: None,
    )
    views = [
        replace(view, tangents=(-0.2, 0.2, 0.18, -0.18))
        for view in eye_views(still(0.0))
    ]
    color = np.full((36, 40, 3), 90, np.uint8)
    depth_m = np.full((36, 40), 4.0, np.float32)
    frame = LookedAt(
        DueFrame(0, True, tuple(views)),
        tuple(RgbdPicture(view, color, depth_m) for view in views),
        (LookingEye(EyeState(4.0, 0.0), (0.0, 0.0)),) * 2,
        0.0,
    )

    def until(is_wanted):
        for _ in range(3000):
            seen = seeing.see(frame)
            if seen is not None and is_wanted(seen.used_focus_dpt):
                return seen.used_focus_dpt
            time.sleep(0.005)
        raise AssertionError("in vain")

    try:
        for eye in EYES:
            seeing.change(eye, {"kind": "prescription", "sphere_dpt": -6})
        assert min(until(lambda used: None not in used)) > 5.0
        seeing.change("right", {"kind": "prescription", "sphere_dpt": -1})
        told = seeing.see(frame).used_focus_dpt
        assert told[0] > 5.0 and told[1] is None, "still the eye before"
        assert until(lambda used: used[1] is not None)[1] < 1.5
    finally:
        seeing.close()


def test_what_is_wrong_with_an_eye_is_said_once_and_it_is_asked_for_again(
    start_service,
):
    service = start_service()
    said = []
    seeing = SeeingByService(service.endpoint, FilterSettings(), said.append)
    seeing.change("left", TWO_EYES["left"])
    seeing.change("right", {"kind": "double", "mark": 7, "crash": True})
    changed = []

    def keys():
        killed = [line for line in said if "SIGKILL" in line]
        if killed and not changed:
            changed.append(time.monotonic())
            seeing.change("right", TWO_EYES["right"])
        return ""

    runtime = SimulatedRuntime(SIZE_PX, rate_hz=100.0)
    log = viewer_of(runtime, seeing, said=said, keys=keys).run(
        max_frames=20, limit_s=TIMEOUT_S
    )
    seeing.close()
    assert log.n_filtered == 20
    assert len([line for line in said if "SIGKILL" in line]) == 1


TWO_EYES = {
    "left": {"kind": "double", "mark": 21},
    "right": {"kind": "double", "mark": 42},
}


def test_a_service_filters_both_eyes_and_gives_the_poses_back(start_service):
    service = start_service(filter_ms=8)
    said, shown_all = [], []
    seeing = SeeingByService(service.endpoint, FilterSettings(), said.append)
    for eye, profile in TWO_EYES.items():
        seeing.change(eye, profile)
    runtime = SimulatedRuntime(
        SIZE_PX, rate_hz=120.0, on_shown=lambda due, shown: shown_all.append(shown)
    )
    wall = Wall()
    log = viewer_of(runtime, seeing, said=said, scenery=wall).run(
        max_frames=30, limit_s=TIMEOUT_S
    )
    seeing.close()
    assert log.n_filtered == 30
    n_seen = 0
    for shown in shown_all:
        for view, mark in zip(shown, (21, 42), strict=True):
            expected = wall.pictures([view.view], SIZE_PX)[0]
            if (view.color == expected.color).all():
                continue
            n_seen += 1
            assert (view.color[0, 0] == mark).all()
            np.testing.assert_array_equal(view.color[1:], 255 - expected.color[1:])
            np.testing.assert_array_equal(view.depth_m, expected.depth_m)
    assert n_seen >= 60
    # Newest wins: frames are sent faster than they are filtered.
    assert log.n_repeated + sum(seeing.n_dropped.values()) > 0
    stages = log.summary()["stages_ms"]
    assert stages["filter_ms"]["p50"] > 15.0
    parts = ("scene_ms", "look_ms", "wait_ms", "wire_ms", "service_ms", "filter_ms")
    assert sum(stages[name]["p50"] for name in parts) <= stages["age_ms"]["p50"] * 1.2


def test_nothing_of_a_lost_session_is_shown_in_the_next(start_service, monkeypatch):
    """Another session has another room: an old pose would be anywhere in it."""
    monkeypatch.setattr("clients.headset.viewer.RETRY_S", 0.01)
    service = start_service(filter_ms=30)
    seeing = SeeingByService(service.endpoint, FilterSettings(), lambda line: None)
    for eye, profile in TWO_EYES.items():
        seeing.change(eye, profile)
    first, shown_in = Happening(), [[], []]

    def keys():
        first.is_lost = len(shown_in[0]) > 100
        return ""

    def elsewhere(at_s):
        return (5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

    sessions = [
        SimulatedRuntime(
            SIZE_PX,
            rate_hz=100.0,
            head_at=head_at,
            happening=happening,
            on_shown=lambda due, shown, n=n: shown_in[n].extend(shown),
        )
        for n, (head_at, happening) in enumerate(
            ((swaying, first), (elsewhere, Happening()))
        )
    ]
    viewer = viewer_of(sessions, seeing, keys=keys)
    viewer.run(limit_s=5.0)
    seeing.close()
    assert len(shown_in[1]) > 50
    assert all(view.view.pose[0] > 4.0 for view in shown_in[1])
    marks = {int(view.color[0, 0, 0]) for view in shown_in[1][-10:]}
    assert marks <= {21, 42}, "both eyes are seen in the second session, too"


@pytest.mark.clock
def test_a_service_that_dies_and_comes_back_does_not_freeze_the_picture(
    start_service, tmp_path
):
    bind = f"ipc://{tmp_path}/socket"
    services = [start_service(bind=bind)]
    said, plain_at = [], []
    seeing = SeeingByService(bind, FilterSettings(), said.append)
    for eye, profile in TWO_EYES.items():
        seeing.change(eye, profile)
    wall, n_seen = Wall(), [0, 0]

    def shown(due, views):
        own = eye_views(due.head)[0].pose
        is_plain = (
            views[0].view.pose == own
            and (
                views[0].color == wall.pictures([views[0].view], SIZE_PX)[0].color
            ).all()
        )
        plain_at.append(bool(is_plain))
        n_seen[0] += not is_plain

    def keys():
        if n_seen[0] == 20 and len(services) == 1:
            services[0].kill()
            services.append(None)
            n_seen[1] = len(plain_at)
        elif len(services) == 2 and len(plain_at) > n_seen[1] + 60:
            services[1:] = [start_service(bind=bind), None]
        return "q" if len(services) == 3 and n_seen[0] > 60 else ""

    runtime = SimulatedRuntime(SIZE_PX, rate_hz=100.0, on_shown=shown)
    viewer_of(runtime, seeing, said=said, keys=keys, scenery=wall).run(limit_s=20.0)
    seeing.close()
    gone = plain_at[n_seen[1] + 30 : n_seen[1] + 60]
    assert all(gone), "an old picture stood while there was no service"
    assert n_seen[0] > 60
    assert any("no filter service" in line for line in said)
    assert any("is there" in line for line in said)


def test_in_this_process_each_eye_sees_its_own_profile():
    """Real eyes: a myope of -8 dpt blurs the left picture, the right one stays."""
    said = []
    settings = FilterSettings(
        pupil_range_mm=(4.0, 4.0),
        focus_range_dpt=(0.0, 1.0),
        object_range_dpt=(0.0, 1.0),
        tolerance="loose",
        mode="on-axis",
    )
    seeing = SeeingHere(settings, said.append)
    try:
        seeing.change("left", {"kind": "prescription", "sphere_dpt": -8})
        seeing.change("right", {"kind": "prescription", "sphere_dpt": 0})
        views = [
            replace(view, tangents=(-0.2, 0.2, 0.18, -0.18))
            for view in eye_views(still(0.0))
        ]
        rng = np.random.default_rng(0)
        color = (255 * (rng.random((90, 100, 1)) > 0.5)).astype(np.uint8)
        color = np.repeat(color, 3, axis=2)
        depth_m = np.full((90, 100), 4.0, np.float32)
        frame = LookedAt(
            DueFrame(0, True, tuple(views)),
            tuple(RgbdPicture(view, color, depth_m) for view in views),
            (LookingEye(EyeState(4.0, 0.25), (0.0, 0.0)),) * 2,
            0.0,
        )
        seen = None
        for _ in range(2000):
            seen = seeing.see(frame)
            if seen is not None and seen.is_complete:
                break
            time.sleep(0.01)
        left, right = seen.colors
    finally:
        seeing.close()
    assert np.ptp(right[20:-20, 20:-20]) > 200
    assert np.ptp(left[20:-20, 20:-20]) < 120
    assert seen.used_focus_dpt[0] > 6.5  # its far point
    assert seen.used_focus_dpt[1] == pytest.approx(0.25, abs=0.2)
    assert any(line.startswith("left eye: ready") for line in said)


def run_program(*arguments, timeout_s=120.0):
    return subprocess.run(
        [sys.executable, "-m", "filter_service", "headset", *arguments],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def test_the_command_shows_a_scene_in_a_simulated_headset(tmp_path):
    finished = run_program(
        *("--simulated", "--size", "96x108", "--scene", "primitives", "--frames", "5"),
        *("--left", "emmetropia", "--right", "myopia", "--json"),
        *("--settings", json.dumps({"tolerance": "loose", "mode": "on-axis"})),
        *("--out", str(tmp_path), "--seconds", "90"),
    )
    assert finished.returncode == 0, finished.stderr
    report = json.loads(finished.stdout)
    assert report["filtered"] == 5
    assert report["stages_ms"]["age_ms"]["p50"] > 0
    assert {path.name for path in tmp_path.iterdir()} == {"left.png", "right.png"}


OWN_SCENERY = """
import numpy as np
from clients.headset.look import RgbdPicture

class Grey:
    def pictures(self, views, size_px):
        width, height = size_px
        color = np.full((height, width, 3), 99, np.uint8)
        depth_m = np.full((height, width), 2.0, np.float32)
        return tuple(RgbdPicture(view, color, depth_m) for view in views)

def make(context):
    assert context.version_code >= 430
    return Grey()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_ends_it_with_its_report_and_its_pictures(tmp_path, name):
    command = (
        *(sys.executable, "-m", "filter_service", "headset", "--simulated", "--json"),
        *("--size", "48x54", "--scene", "own_scenery:make", "--out", "pictures"),
        *("--settings", json.dumps({"tolerance": "loose", "mode": "on-axis"})),
    )
    (tmp_path / "own_scenery.py").write_text(OWN_SCENERY)
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        try:
            n_ready = 0
            while n_ready < 2:
                n_ready += "ready after" in running.stderr.readline()
            time.sleep(0.5)
            running.send_signal(getattr(signal, name))
            printed, _ = running.communicate(timeout=30.0)
        finally:
            running.kill()
    assert running.returncode == 0
    assert json.loads(printed)["filtered"] > 0
    assert (tmp_path / "pictures" / "left.png").is_file()


def test_a_program_of_ones_own_renders(tmp_path):
    (tmp_path / "own_scenery.py").write_text(OWN_SCENERY)
    finished = subprocess.run(
        [
            *(sys.executable, "-m", "filter_service", "headset", "--simulated"),
            *("--scene", "own_scenery:make", "--size", "48x54", "--frames", "2"),
            *("--settings", json.dumps({"tolerance": "loose", "mode": "on-axis"})),
            *("--out", "pictures", "--seconds", "60"),
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    from PIL import Image

    seen = np.asarray(Image.open(tmp_path / "pictures" / "left.png"))
    assert seen.shape == (54, 48, 3)
    assert np.abs(seen.astype(int) - 99).max() <= 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scene", "nowhere"), "nowhere"),
        (("--scene", "missing.glb"), "missing.glb"),
        (("--scene", "no_such_module:make"), "no_such_module"),
        (("--size", "5x5"), "WIDTHxHEIGHT"),
        (("--age", "200"), "3 to 120"),
        (("--pupil-mm", "30"), "0.5 to 9"),
        (("--gaze-range", "a,b"), "H,V"),
        (("--settings", '{"nonsense": 1}'), "nonsense"),
        (("--scale", "9"), "0.1 to 2"),
        (("--white-cd-m2", "-1"), "white_cd_m2"),
        (("--profile", "{broken"), "no JSON"),
        (("--left", "{broken"), "--left"),
        (("--right", "missing.json"), "--right missing.json"),
        (("--frames", "0"), "--frames is 0"),
        (("--scene", "math:sqrt"), "math:sqrt: TypeError"),
    ],
)
def test_a_wrong_argument_is_named(arguments, words):
    finished = run_program("--simulated", "--seconds", "1", *arguments)
    assert finished.returncode == 2, finished.stderr
    assert words in finished.stderr
    assert "Traceback" not in finished.stderr


def test_the_help_teaches():
    finished = run_program("--help")
    assert finished.returncode == 0
    for words in ("--left", "--service", "keys:", "ocufilter headset --simulated"):
        assert words in finished.stdout


def test_lengths_of_time_and_sessions_are_python_errors():
    assert issubclass(SessionLost, Exception)
    with pytest.raises(ValueError, match="rate_hz"):
        SimulatedRuntime(rate_hz=0.0)
    with pytest.raises(ValueError, match="size_px"):
        SimulatedRuntime((0, 5))
    assert math.isclose(EYE_DISTANCE_M, 0.063)
