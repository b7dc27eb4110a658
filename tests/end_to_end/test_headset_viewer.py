"""The headset's viewer against a simulated headset: loops, losses, poses.

`make test-headset` runs it against a real OpenXR runtime.
"""

import math
import time

import numpy as np
import pytest

from clients.headset import program
from clients.headset.runtime import (
    EYE_DISTANCE_M,
    EYES,
    DueFrame,
    GazeSample,
    Happening,
    NoRuntime,
    SessionLost,
    SimulatedRuntime,
    angles_of,
    direction_of,
    eye_views,
    matrix_of,
    still,
    swaying,
    turned,
    upright,
)
from clients.headset.stereo_gaze import StereoGaze
from tests.end_to_end.headset_doubles import (
    SIZE_PX,
    Inverting,
    Wall,
    pictures_of,
    viewer_of,
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
    with pytest.raises(ValueError, match="allowed: a unit quaternion"):
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
    look = StereoGaze(age_years=25.0, gaze_range_deg=(20.0, 20.0))
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


class Late(Inverting):
    """Has no eye yet for a while."""

    def __init__(self, ready_after_s):
        super().__init__()
        self.ready_s = time.monotonic() + ready_after_s

    def see(self, frame):
        return super().see(frame) if time.monotonic() >= self.ready_s else None


def test_a_limit_of_time_counts_from_the_first_filtered_frame():
    runtime = SimulatedRuntime(SIZE_PX, rate_hz=200.0)
    started_s = time.monotonic()
    log = viewer_of(runtime, Late(0.6)).run(limit_s=0.3, warm_up_s=20.0)
    assert 0.9 <= time.monotonic() - started_s < 10.0
    assert log.n_filtered > 1
    runtime = SimulatedRuntime(SIZE_PX, rate_hz=200.0)
    log = viewer_of(runtime, Late(60.0)).run(limit_s=0.2, warm_up_s=0.2)
    assert log.n_filtered == 0, "it ends though nothing is filtered"


def test_only_filtered_pictures_are_written(tmp_path, capsys):
    pictures = program._Pictures()
    for ready_after_s in (60.0, 0.0):
        runtime = SimulatedRuntime(SIZE_PX, rate_hz=200.0, on_shown=pictures.keep)
        viewer_of(runtime, Late(ready_after_s)).run(limit_s=0.2)
        pictures.write(tmp_path)
        found = {path.name for path in tmp_path.iterdir()}
        if ready_after_s:
            assert found == set()
            assert "no frame was filtered" in capsys.readouterr().err
    assert found == {"left.png", "right.png"}


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


def test_lengths_of_time_and_sessions_are_python_errors():
    assert issubclass(SessionLost, Exception)
    with pytest.raises(ValueError, match="rate_hz"):
        SimulatedRuntime(rate_hz=0.0)
    with pytest.raises(ValueError, match="size_px"):
        SimulatedRuntime((0, 5))
    assert math.isclose(EYE_DISTANCE_M, 0.063)
