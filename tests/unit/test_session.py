"""A session's rules without sockets: credit, which eye serves, what is built."""

import pytest

from filter_service.errors import BuildFailed, CreditExceeded, NoProfile
from filter_service.messages import (
    Camera,
    Frame,
    ProfileRequest,
    ProfileSettings,
    ViewHeader,
)
from filter_service.service.build_job import LookAt
from filter_service.service.session import PreparedStore, Session, WaitingFrame

SMALL = Camera(100, 100, (-0.5, 0.5, 0.5, -0.5))  # 10 mrad
LARGE = Camera(200, 200, (-0.5, 0.5, 0.5, -0.5))  # 5 mrad


class Store:
    """Stands for a loaded store."""


def make_session(**changes):
    fields = {
        "session_id": 1,
        "identity": b"a",
        "client": "",
        "credit": 2,
        "max_cameras": 2,
    }
    return Session(**fields | changes)


def frame_of(*cameras, frame_id=0):
    views = tuple(ViewHeader(camera) for camera in cameras)
    return Frame(frame_id, views, pupil_diameter_mm=4.0, focus_dpt=0.0)


def request(profile_id, *cameras):
    return ProfileRequest(profile_id, {}, cameras=cameras)


def build_all(session):
    """Build what the session asks for; return the stores in order."""
    stores = []
    while (following := session.next_build()) is not None:
        stores.append(Store())
        eye, camera = following
        session.put_in_place(eye, PreparedStore(camera, stores[-1]))
    return stores


def test_credit_counts_unanswered_frames_and_the_newest_waits():
    session = make_session()
    frames = [WaitingFrame(frame_of(SMALL, frame_id=i), 0.0, 0.0) for i in range(3)]
    assert session.take_in(frames[0]) is None
    assert session.take_in(frames[1]) is frames[0]
    with pytest.raises(CreditExceeded, match="2 frames are unanswered"):
        session.take_in(frames[2])
    assert session.waiting is frames[1]
    session.n_unanswered -= 1
    assert session.take_in(frames[2]) is frames[1]


def test_a_frame_needs_a_profile():
    with pytest.raises(NoProfile):
        make_session().plan(frame_of(SMALL))


def test_the_old_eye_serves_until_the_new_one_is_ready_and_is_then_given_up():
    session = make_session()
    old = session.add_profile(request(1, SMALL))
    (old_store,) = build_all(session)
    new = session.add_profile(request(2))
    assert new.generation == old.generation + 1
    assert session.plan(frame_of(SMALL)).eye is old
    (new_store,) = build_all(session)
    plan = session.plan(frame_of(SMALL))
    assert (plan.eye, plan.stores) == (new, (new_store,))
    assert session.retired == [old_store]


def test_a_new_camera_is_wanted_while_the_old_eye_serves_the_old_one():
    session = make_session()
    session.add_profile(request(1, SMALL))
    build_all(session)
    assert session.plan(frame_of(LARGE)) is None
    assert session.next_build()[1] == LARGE
    assert session.plan(frame_of(SMALL)) is not None
    build_all(session)
    assert session.plan(frame_of(SMALL, LARGE)) is not None
    assert session.next_build() is None


def test_a_profile_in_preparation_is_replaced_but_not_the_one_in_use():
    session = make_session()
    in_use = session.add_profile(request(1, SMALL))
    build_all(session)
    session.add_profile(request(2, SMALL))
    newest = session.add_profile(request(3, SMALL))
    assert session.eyes == [newest, in_use]
    assert session.retired == []


def test_a_profile_that_never_worked_gives_way_to_the_old_one():
    session = make_session()
    old = session.add_profile(request(1, SMALL))
    build_all(session)
    session.add_profile(request(2, SMALL))
    session.fail_build(*session.next_build(), BuildFailed("no"))
    assert session.plan(frame_of(SMALL)).eye is old
    assert session.next_build() is None


def test_without_an_old_eye_frames_get_the_reason_every_time():
    session = make_session()
    session.add_profile(request(1, SMALL))
    session.fail_build(*session.next_build(), BuildFailed("no"))
    depths = []
    for _ in range(5):
        with pytest.raises(BuildFailed) as caught:
            session.plan(frame_of(SMALL))
        depths.append(len(caught.traceback))
    assert depths == depths[:1] * 5, "the stored error grows with every frame"
    assert session.next_build() is None


def test_only_so_many_cameras_stay_prepared_and_the_least_used_goes():
    session = make_session(max_cameras=2)
    session.add_profile(request(1, SMALL, LARGE))
    _, large_store = build_all(session)
    session.plan(frame_of(SMALL))
    session.plan(frame_of(Camera(300, 100, SMALL.tangents)))
    build_all(session)
    assert session.retired == [large_store]


def test_the_end_frees_all_stores():
    session = make_session()
    session.add_profile(request(1, SMALL, LARGE))
    stores = build_all(session)
    session.end()
    assert session.retired == stores


def preview_of(session):
    """Put a preview of the next build in place; return its store."""
    eye, camera = session.next_build()
    store = Store()
    session.put_in_place(eye, PreparedStore(camera, store, is_complete=False))
    return store


def test_a_preview_serves_until_the_whole_replaces_it_and_only_then_the_old_eye_goes():
    session = make_session()
    session.add_profile(request(1, SMALL))
    (old_store,) = build_all(session)
    new = session.add_profile(request(2))
    preview = preview_of(session)
    plan = session.plan(frame_of(SMALL))
    assert (plan.eye, plan.stores, plan.is_complete) == (new, (preview,), False)
    assert session.next_build() == (new, SMALL), "the whole is still to be built"
    assert session.retired == []
    (whole,) = build_all(session)
    assert session.retired == [preview]
    plan = session.plan(frame_of(SMALL))
    assert (plan.eye, plan.stores, plan.is_complete) == (new, (whole,), True)
    assert session.retired == [preview, old_store]


def test_a_profile_that_fails_after_its_preview_gives_way_to_the_old_one():
    session = make_session()
    old = session.add_profile(request(1, SMALL))
    build_all(session)
    session.add_profile(request(2))
    preview = preview_of(session)
    assert session.plan(frame_of(SMALL)).stores == (preview,)
    session.fail_build(*session.next_build(), BuildFailed("no"))
    assert session.plan(frame_of(SMALL)).eye is old
    assert session.retired == [preview]


def test_a_preview_without_an_old_eye_stays_when_the_whole_fails():
    session = make_session()
    session.add_profile(request(1, SMALL))
    preview = preview_of(session)
    session.fail_build(*session.next_build(), BuildFailed("no"))
    assert session.plan(frame_of(SMALL)).stores == (preview,)
    assert session.next_build() is None
    assert session.unfinished_eye() is None


def test_a_newer_profile_finds_the_preview_in_use_and_no_ending_said():
    session = make_session()
    session.add_profile(request(1, SMALL))
    build_all(session)
    second = session.add_profile(request(2))
    preview = preview_of(session)
    session.plan(frame_of(SMALL))
    assert session.unfinished_eye() is second
    third = session.add_profile(request(3))
    plan = session.plan(frame_of(SMALL))
    assert (plan.eye, plan.stores) == (second, (preview,))
    assert session.eyes == [third, second]
    build_all(session)
    assert session.plan(frame_of(SMALL)).eye is third
    assert session.unfinished_eye() is None


def test_the_second_view_of_a_pair_needs_its_own_store_over_the_field_only():
    left = Camera(100, 100, (-0.6, 0.4, 0.5, -0.5))
    right = Camera(100, 100, (-0.4, 0.6, 0.5, -0.5))
    for settings, cameras in (
        (ProfileSettings(mode="on-axis"), (left,)),
        (ProfileSettings(mode="quality"), (left, right)),
    ):
        session = make_session()
        eye = session.add_profile(
            ProfileRequest(1, {}, settings, cameras=(left, right))
        )
        assert eye.wanted == cameras
        build_all(session)
        assert session.plan(frame_of(left, right)) is not None


def test_what_the_last_frame_looked_at_is_remembered():
    session = make_session()
    session.add_profile(request(1, SMALL))
    assert session.look_at is None
    session.plan(frame_of(SMALL))
    assert session.look_at == LookAt(4.0, 0.0)
