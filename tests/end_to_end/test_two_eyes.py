"""A stereo frame through two profiles: each view through its own eye."""

import os
import signal
import time

import msgpack
import numpy as np
import pytest

from clients.filter_client import FilterClient, FilteredFrame
from filter_service import ViewState, errors, plan_views
from filter_service.messages import (
    Accepted,
    Dropped,
    Frame,
    ProfileRequest,
    Progress,
    Ready,
    Result,
    ResultView,
    SharedPlaces,
    ViewHeader,
    body_of_eye,
    decode_reply,
    decode_request,
    encode,
)
from filter_service.wire.message import MAX_HEADER_BYTES, Limits
from tests.end_to_end.conftest import TIMEOUT_S, make_view, small_frame
from tests.end_to_end.test_lifecycle import wait_until

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
LEFT_POSE = (-0.03, 1.6, 2.0, 0.0, 0.6, 0.0, 0.8)
RIGHT_POSE = (0.03, 1.6, 2.0, 0.0, 0.6, 0.0, 0.8)
EYES = (ViewState("left", pose=LEFT_POSE), ViewState("right", pose=RIGHT_POSE))


def double(mark, **more):
    return {"kind": "double", "mark": mark, **more}


def marks_of(reply):
    return [int(color[0, 0, 0]) for color in reply.colors]


@pytest.fixture
def pair():
    """Two views that differ in their picture and their camera, as a headset's do."""
    left = make_view(64, 36, seed=1)
    right = make_view(48, 40, seed=2)
    return left, right


@pytest.fixture
def two_eyes(client, pair):
    for eye, mark, view in zip(("left", "right"), (11, 22), pair, strict=True):
        client.set_profile(double(mark), eye=eye, views=[view])
    return client


def test_each_view_goes_through_its_own_eye_and_comes_back_with_its_pose(
    two_eyes, pair
):
    states = (
        ViewState("left", gaze_deg=(2.0, -1.0), pose=LEFT_POSE),
        ViewState("right", 5.0, 1.25, (-2.0, -1.0), RIGHT_POSE),
    )
    reply = two_eyes.filter(pair, **SEE, states=states, display_time_ns=2**62 + 1)
    for color, view in zip(reply.colors, pair, strict=True):
        np.testing.assert_array_equal(color[1:], 255 - view.color[1:])
    assert marks_of(reply) == [11, 22]
    left, right = reply.views
    assert (left.eye, left.pupil_diameter_mm, left.focus_dpt) == ("left", 4.0, 0.5)
    assert (right.eye, right.pupil_diameter_mm, right.focus_dpt) == ("right", 5.0, 1.25)
    assert (left.gaze_deg, right.gaze_deg) == ((2.0, -1.0), (-2.0, -1.0))
    assert (left.pose, right.pose) == (LEFT_POSE, RIGHT_POSE)
    assert reply.display_time_ns == 2**62 + 1
    assert left.profile_id == reply.profile_id != right.profile_id


def test_the_left_eye_is_a_left_one_unless_its_profile_says_otherwise():
    assert body_of_eye({"kind": "preset"}, "left")["eye_side"] == "OS"
    assert body_of_eye({"eye_side": "OD"}, "left")["eye_side"] == "OD"
    assert "eye_side" not in body_of_eye({"kind": "preset"}, "right")


def test_the_order_of_views_is_the_frames_own(two_eyes, pair):
    reply = two_eyes.filter(pair[::-1], **SEE, states=EYES[::-1])
    assert marks_of(reply) == [22, 11]
    assert [view.eye for view in reply.views] == ["right", "left"]


def test_generations_count_for_each_eye_and_one_changes_alone(two_eyes, pair):
    before = two_eyes.filter(pair, **SEE, states=EYES).views
    accepted = two_eyes.set_profile(double(33, build_s=0.3), eye="right", wait=False)
    assert isinstance(accepted, Accepted)
    assert (accepted.eye, accepted.generation) == ("right", before[1].generation + 1)
    marks, said = [], []
    deadline_s = time.monotonic() + TIMEOUT_S
    while (not marks or marks[-1] != [11, 33]) and time.monotonic() < deadline_s:
        if not two_eyes.n_unanswered:
            two_eyes.submit(pair, **SEE, states=EYES)
        for event in two_eyes.poll(0.2):
            if isinstance(event, FilteredFrame):
                marks.append(marks_of(event))
                views = event.views
                assert views[0].generation == before[0].generation
                assert (
                    views[1].generation
                    == {
                        22: before[1].generation,
                        33: accepted.generation,
                    }[marks[-1][1]]
                )
            else:
                said.append(event)
    assert marks[0] == [11, 22], "the old eye did not serve meanwhile"
    assert marks[-1] == [11, 33]
    assert {e.eye for e in said if isinstance(e, Progress | Ready)} == {"right"}


def test_profiles_of_two_eyes_do_not_cancel_each_other(client, pair):
    for eye, mark, view in zip(("left", "right"), (1, 2), pair, strict=True):
        client.set_profile(double(mark, build_s=0.2), eye=eye, views=[view], wait=False)
    reply = client.filter(pair, **SEE, states=EYES)
    assert marks_of(reply) == [1, 2]


def test_a_frame_waits_until_all_its_eyes_are_prepared(client, pair):
    client.set_profile(double(1), eye="left", views=[pair[0]])
    client.set_profile(double(2, build_s=0.5), eye="right", views=[pair[1]], wait=False)
    client.submit(pair, **SEE, states=EYES)
    events = []
    while not any(isinstance(e, Dropped) for e in events):
        events += client.poll(TIMEOUT_S)
    (dropped,) = [e for e in events if isinstance(e, Dropped)]
    assert dropped.reason == "preparing"
    assert marks_of(client.filter(pair, **SEE, states=EYES)) == [1, 2]


def test_an_eye_without_a_profile_is_named(client, pair):
    client.set_profile(double(5), views=list(pair))
    assert marks_of(client.filter(pair, **SEE)) == [5, 5]
    client.set_profile(double(6), eye="left", views=[pair[0]])
    with pytest.raises(errors.NoProfile, match="eye right") as caught:
        client.filter(pair, **SEE, states=EYES)
    assert caught.value.field == "views[1].eye"
    assert marks_of(client.filter(pair, **SEE)) == [5, 5]


def test_frames_that_are_refused_for_one_eye_prepare_the_other(client, pair):
    """They say which camera the right eye sees by, whatever the left one lacks."""
    with pytest.raises(errors.NoProfile):
        client.filter(pair, **SEE, states=EYES)
    for eye in ("right", "left"):
        accepted = client.set_profile(double(3), eye=eye, wait=False)
        assert accepted.n_cameras == 1, eye
    assert marks_of(client.filter(pair, **SEE, states=EYES)) == [3, 3]


def test_in_process_an_eye_that_is_not_there_is_named(pair):
    see = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
    with pytest.raises(errors.NoProfile, match="eye right") as caught:
        plan_views({}.get, pair, (ViewState("right"), ViewState("left")), **see)
    assert caught.value.field == "views[0].eye"
    with pytest.raises(errors.BadMessage, match="2, as views"):
        plan_views({}.get, pair, (ViewState("right"),), **see)


def test_a_value_of_ones_own_may_be_the_frames(client, pair):
    client.set_profile(double(5), views=list(pair))
    states = (ViewState(pupil_diameter_mm=4.0), ViewState(focus_dpt=0.5))
    assert marks_of(client.filter(pair, **SEE, states=states)) == [5, 5]


def test_one_eye_has_one_pupil_and_one_focus(client, pair):
    client.set_profile(double(5), views=list(pair))
    with pytest.raises(errors.BadMessage, match=r"views\[1\].focus_dpt"):
        client.submit(pair, **SEE, states=(ViewState(), ViewState(focus_dpt=2.0)))
    with pytest.raises(ValueError, match="1 states"):
        client.submit(pair, **SEE, states=(ViewState(),))
    with pytest.raises(ValueError, match="'middle'"):
        client.set_profile(double(5), eye="middle")


def test_wrong_eyes_and_poses_are_named_by_field(shared_service, raw_client):
    raw = raw_client(shared_service)
    raw.begin()
    for change, field in (
        ({"eye": "third"}, "views[0].eye"),
        ({"pose": [0.0] * 6}, "views[0].pose"),
        ({"pose": [0.0] * 6 + [1e12]}, "views[0].pose[6]"),
        ({"pupil_diameter_mm": 20.0}, "views[0].pupil_diameter_mm"),
        ({"gaze_deg": [0.0, 90.0]}, "views[0].gaze_deg[1]"),
    ):
        frame = small_frame(1)
        parts = encode(frame)
        header = frame.fields() | {"type": "frame", "version": 1}
        header["views"] = [header["views"][0] | change]
        raw.send([msgpack.packb(header), *parts[1:]])
        reply = raw.receive()
        assert (reply.code, reply.field) == ("bad_message", field)


@pytest.mark.clock
@pytest.mark.parametrize("name", ["front-end", "render"])
def test_both_eyes_are_there_again_after_a_process_is_killed(start_service, pair, name):
    service = start_service()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        for eye, mark, view in zip(("left", "right"), (11, 22), pair, strict=True):
            client.set_profile(double(mark), eye=eye, views=[view])
        before = client.filter(pair, **SEE, states=EYES).views
        pid = service.pids()[name]
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: service.pids().get(name, pid) != pid)
        deadline_s = time.monotonic() + TIMEOUT_S
        while True:
            try:
                reply = client.filter(pair, **SEE, states=EYES, timeout_s=1.0)
                break
            except errors.FilterError:
                assert time.monotonic() < deadline_s
        assert marks_of(reply) == [11, 22]
        for old, new in zip(before, reply.views, strict=True):
            assert new.profile_id == old.profile_id
            assert new.generation >= old.generation
        assert client.hello().profile_ids.keys() <= {"left", "right"}


@pytest.mark.clock
def test_both_eyes_are_sent_again_to_a_new_service(start_service, pair, tmp_path):
    bind = f"ipc://{tmp_path}/socket"
    first = start_service(bind=bind)
    with FilterClient(bind, timeout_s=TIMEOUT_S) as client:
        for eye, mark, view in zip(("left", "right"), (11, 22), pair, strict=True):
            client.set_profile(double(mark), eye=eye, views=[view])
        assert first.stop(TIMEOUT_S) == 0
        start_service(bind=bind)
        reply = client.filter(pair, **SEE, states=EYES)
        assert marks_of(reply) == [11, 22]


def test_the_fullest_headers_fit(pair):
    """Eight views with everything, notes and stages too."""
    states = [
        ViewState("left", 4.125, 1.1, (10.1, 20.2), (1.1,) * 7),
        ViewState("right", 5.125, 1.2, (11.1, 21.2), (1.2,) * 7),
    ] * 4
    views = tuple(
        ViewHeader.of(pair[0].camera, has_hidden=True, state=state) for state in states
    )
    places = SharedPlaces(2**40, (2**40,) * 32, 2**40, (2**40,) * 8)
    frame = Frame(2**52, views, 4.1, 1.1, (1.1, 2.2), memory=places)
    parts = encode(frame)
    assert decode_request(parts, Limits(max_views=8)) == frame
    of_view = ResultView(
        *(4096, 4096),
        eye="right",
        profile_id=2**52,
        generation=2**52,
        is_complete=True,
        pupil_diameter_mm=1.1,
        focus_dpt=1.1,
        gaze_deg=(1.1, 1.1),
        pose=(1.1,) * 7,
    )
    result = Result(
        *(2**52, 2**52, 2**52, (of_view,) * 8, 1.1, 1.1, 2**52, 2**52, 1.1),
        {f"a_stage_of_the_{n}_ms": 1.1 for n in range(24)},
        notes=["x" * 400] * 20,
        display_time_ns=2**62,
        in_memory=True,
    )
    parts = encode(result)
    assert len(parts[0]) <= MAX_HEADER_BYTES
    assert decode_reply(parts) == result


def test_a_profile_request_names_its_eye():
    request = ProfileRequest(3, {"kind": "preset"}, eye="left")
    assert decode_request(encode(request)).eye == "left"
    with pytest.raises(errors.BadMessage, match="eye"):
        decode_request(encode(ProfileRequest(3, {}, eye="nobody")))
