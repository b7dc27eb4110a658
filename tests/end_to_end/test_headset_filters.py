"""Headset frames through real eyes here, and through a service."""

import time
from dataclasses import replace

import numpy as np
import pytest

from clients.headset.runtime import (
    EYES,
    DueFrame,
    Happening,
    SimulatedRuntime,
    eye_views,
    still,
    swaying,
)
from clients.headset.stereo_filter import (
    SAY_AGAIN_S,
    LocalFilter,
    LogOnce,
    ServiceFilter,
    StereoFrame,
)
from clients.headset.stereo_gaze import EyeAndGaze, RgbdPicture
from filter_service import FilterSettings
from filter_service.messages import State
from tests.end_to_end.conftest import TIMEOUT_S
from tests.end_to_end.headset_doubles import (
    SIZE_PX,
    Wall,
    viewer_of,
)


def test_an_eye_learns_from_its_own_pictures_only():
    """The eye before serves until the new one is ready: what it can do is another's."""
    seeing = LocalFilter(
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
    frame = StereoFrame(
        DueFrame(0, True, tuple(views)),
        tuple(RgbdPicture(view, color, depth_m) for view in views),
        (EyeAndGaze(State(4.0, 0.0), (0.0, 0.0)),) * 2,
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
    seeing = LocalFilter(settings, said.append)
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
        frame = StereoFrame(
            DueFrame(0, True, tuple(views)),
            tuple(RgbdPicture(view, color, depth_m) for view in views),
            (EyeAndGaze(State(4.0, 0.25), (0.0, 0.0)),) * 2,
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


TWO_EYES = {
    "left": {"kind": "double", "mark": 21},
    "right": {"kind": "double", "mark": 42},
}


def test_a_service_filters_both_eyes_and_gives_the_poses_back(shared_service):
    said, shown_all = [], []
    seeing = ServiceFilter(shared_service.endpoint, FilterSettings(), said.append)
    for eye, profile in TWO_EYES.items():
        seeing.change(eye, profile | {"filter_ms": 8})
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


@pytest.mark.clients
def test_nothing_of_a_lost_session_is_shown_in_the_next(shared_service, monkeypatch):
    """Another session has another room: an old pose would be anywhere in it."""
    monkeypatch.setattr("clients.headset.viewer.RETRY_S", 0.01)
    seeing = ServiceFilter(shared_service.endpoint, FilterSettings(), lambda line: None)
    for eye, profile in TWO_EYES.items():
        seeing.change(eye, profile | {"filter_ms": 30})
    first, shown_in = Happening(), [[], []]

    def keys():
        first.is_lost = len(shown_in[0]) > 100
        return "q" if len(shown_in[1]) > 100 and last_marks() <= {21, 42} else ""

    def last_marks():
        return {int(view.color[0, 0, 0]) for view in shown_in[1][-10:]}

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
    viewer.run(limit_s=TIMEOUT_S)
    seeing.close()
    assert len(shown_in[1]) > 50
    assert all(view.view.pose[0] > 4.0 for view in shown_in[1])
    assert last_marks() <= {21, 42}, "both eyes are seen in the second session, too"


@pytest.mark.clients
@pytest.mark.clock
def test_a_service_that_dies_and_comes_back_does_not_freeze_the_picture(
    start_service, tmp_path
):
    bind = f"ipc://{tmp_path}/socket"
    services = [start_service(bind=bind)]
    said, plain_at = [], []
    seeing = ServiceFilter(bind, FilterSettings(), said.append)
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
    assert any("connected to the filter service" in line for line in said)


@pytest.mark.clients
def test_what_is_wrong_with_an_eye_is_said_once_and_it_is_asked_for_again(
    shared_service,
):
    said = []
    seeing = ServiceFilter(shared_service.endpoint, FilterSettings(), said.append)
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


def test_a_line_is_said_again_after_a_while_only(monkeypatch):
    now_s, said = [0.0], []
    monkeypatch.setattr("time.monotonic", lambda: now_s[0])
    say = LogOnce(said.append)
    for now_s[0] in np.arange(0.0, 2.5 * SAY_AGAIN_S, 0.5):
        say("gone")
    assert len(said) == 3
    for number in range(1000):
        now_s[0] += SAY_AGAIN_S
        say(f"line {number}")
    assert len(said) == 1003
    assert len(say._said_s) <= 2, "what was said is not kept for ever"
