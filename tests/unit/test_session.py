"""A session's rules without sockets: credit, which eye serves, what is built."""

import pytest

from filter_service.building.jobs import LookAt
from filter_service.camera import Camera
from filter_service.errors import BuildFailed, CreditExceeded, NoProfile
from filter_service.filtering.accepted_profile import PreparedStore
from filter_service.filtering.stream_eyes import StreamEyes
from filter_service.messages import Frame, ViewHeader
from filter_service.service.session import Session, WaitingFrame
from filter_service.settings import DEFAULTS, FilterSettings

SMALL = Camera(100, 100, (-0.5, 0.5, 0.5, -0.5))  # 10 mrad
LARGE = Camera(200, 200, (-0.5, 0.5, 0.5, -0.5))  # 5 mrad


class Store:
    """Stands for a loaded store."""


LOOK_AT = LookAt(pupil_diameter_mm=4.0, focus_dpt=0.0)


def make_stream(**changes):
    return StreamEyes(on_event=lambda event: None, **{"max_cameras": 2} | changes)


def planned(stream, *cameras):
    return stream.plan(cameras, LOOK_AT)


def add(stream, profile_id, *cameras, settings=DEFAULTS):
    return stream.add_profile(None, settings, cameras, profile_id=profile_id)


def build_all(stream):
    """Build what the stream asks for; return the stores in order."""
    stores = []
    while (following := stream.next_build()) is not None:
        stores.append(Store())
        prepared = PreparedStore(following.camera, stores[-1])
        stream.put_in_place(following.eye, prepared)
    return stores


def test_credit_counts_unanswered_frames_and_the_newest_waits():
    session = Session(1, b"a", "", credit=2)
    view = (ViewHeader.of(SMALL),)
    frames = [WaitingFrame(Frame(i, view, 4.0, 0.0), 0.0, 0.0) for i in range(3)]
    assert session.take_in(frames[0]) is None
    assert session.take_in(frames[1]) is frames[0]
    with pytest.raises(CreditExceeded, match="2 frames are unanswered"):
        session.take_in(frames[2])
    assert session.waiting is frames[1]
    session.n_unanswered -= 1
    assert session.take_in(frames[2]) is frames[1]


def test_a_frame_needs_a_profile():
    with pytest.raises(NoProfile):
        planned(make_stream(), SMALL)


def test_the_old_eye_serves_until_the_new_one_is_ready_and_is_then_given_up():
    stream = make_stream()
    old = add(stream, 1, SMALL)
    (old_store,) = build_all(stream)
    new = add(stream, 2)
    assert new.generation == old.generation + 1
    assert planned(stream, SMALL).eye is old
    (new_store,) = build_all(stream)
    plan = planned(stream, SMALL)
    assert (plan.eye, plan.stores) == (new, (new_store,))
    assert stream.retired == [old_store]


def test_a_new_camera_is_wanted_while_the_old_eye_serves_the_old_one():
    stream = make_stream()
    add(stream, 1, SMALL)
    build_all(stream)
    assert planned(stream, LARGE) is None
    assert stream.next_build()[1] == LARGE
    assert planned(stream, SMALL) is not None
    build_all(stream)
    assert planned(stream, SMALL, LARGE) is not None
    assert stream.next_build() is None


def test_a_profile_in_preparation_is_replaced_but_not_the_one_in_use():
    stream = make_stream()
    in_use = add(stream, 1, SMALL)
    build_all(stream)
    add(stream, 2, SMALL)
    newest = add(stream, 3, SMALL)
    assert stream.eyes == [newest, in_use]
    assert stream.retired == []


def test_a_profile_that_never_worked_gives_way_to_the_old_one():
    stream = make_stream()
    old = add(stream, 1, SMALL)
    build_all(stream)
    add(stream, 2, SMALL)
    stream.fail_build(*stream.next_build()[:2], BuildFailed("no"))
    assert planned(stream, SMALL).eye is old
    assert stream.next_build() is None


def test_without_an_old_eye_frames_get_the_reason_every_time():
    stream = make_stream()
    add(stream, 1, SMALL)
    stream.fail_build(*stream.next_build()[:2], BuildFailed("no"))
    depths = []
    for _ in range(5):
        with pytest.raises(BuildFailed) as caught:
            planned(stream, SMALL)
        depths.append(len(caught.traceback))
    assert depths == depths[:1] * 5, "the stored error grows with every frame"
    assert stream.next_build() is None


def test_only_so_many_cameras_stay_prepared_and_the_least_used_goes():
    stream = make_stream(max_cameras=2)
    add(stream, 1, SMALL, LARGE)
    _, large_store = build_all(stream)
    planned(stream, SMALL)
    planned(stream, Camera(300, 100, SMALL.tangents))
    build_all(stream)
    assert stream.retired == [large_store]


def test_the_end_frees_all_stores():
    stream = make_stream()
    add(stream, 1, SMALL, LARGE)
    stores = build_all(stream)
    stream.end()
    assert stream.retired == stores


def preview_of(stream):
    """Put a preview of the next build in place; return its store."""
    eye, camera = stream.next_build()[:2]
    store = Store()
    stream.put_in_place(eye, PreparedStore(camera, store, is_complete=False))
    return store


def test_a_preview_serves_until_the_whole_replaces_it_and_only_then_the_old_eye_goes():
    stream = make_stream()
    add(stream, 1, SMALL)
    (old_store,) = build_all(stream)
    new = add(stream, 2)
    preview = preview_of(stream)
    plan = planned(stream, SMALL)
    assert (plan.eye, plan.stores, plan.is_complete) == (new, (preview,), False)
    assert stream.next_build()[:2] == (new, SMALL), "the whole is still to be built"
    assert stream.retired == []
    (whole,) = build_all(stream)
    assert stream.retired == [preview]
    plan = planned(stream, SMALL)
    assert (plan.eye, plan.stores, plan.is_complete) == (new, (whole,), True)
    assert stream.retired == [preview, old_store]


def test_a_profile_that_fails_after_its_preview_gives_way_to_the_old_one():
    stream = make_stream()
    old = add(stream, 1, SMALL)
    build_all(stream)
    add(stream, 2)
    preview = preview_of(stream)
    assert planned(stream, SMALL).stores == (preview,)
    stream.fail_build(*stream.next_build()[:2], BuildFailed("no"))
    assert planned(stream, SMALL).eye is old
    assert stream.retired == [preview]


def test_a_preview_without_an_old_eye_stays_when_the_whole_fails():
    stream = make_stream()
    add(stream, 1, SMALL)
    preview = preview_of(stream)
    stream.fail_build(*stream.next_build()[:2], BuildFailed("no"))
    assert planned(stream, SMALL).stores == (preview,)
    assert stream.next_build() is None
    assert stream.unfinished_eye() is None


def test_a_newer_profile_finds_the_preview_in_use_and_no_ending_said():
    stream = make_stream()
    add(stream, 1, SMALL)
    build_all(stream)
    second = add(stream, 2)
    preview = preview_of(stream)
    planned(stream, SMALL)
    assert stream.unfinished_eye() is second
    third = add(stream, 3)
    plan = planned(stream, SMALL)
    assert (plan.eye, plan.stores) == (second, (preview,))
    assert stream.eyes == [third, second]
    build_all(stream)
    assert planned(stream, SMALL).eye is third
    assert stream.unfinished_eye() is None


def test_the_second_view_of_a_pair_needs_its_own_store_over_the_field_only():
    left = Camera(100, 100, (-0.6, 0.4, 0.5, -0.5))
    right = Camera(100, 100, (-0.4, 0.6, 0.5, -0.5))
    for settings, cameras in (
        (FilterSettings(mode="on-axis"), (left,)),
        (FilterSettings(mode="quality"), (left, right)),
    ):
        stream = make_stream()
        eye = add(stream, 1, left, right, settings=settings)
        assert eye.wanted == cameras
        build_all(stream)
        assert planned(stream, left, right) is not None


def test_what_the_last_frame_looked_at_is_remembered():
    stream = make_stream()
    add(stream, 1, SMALL)
    assert stream.look_at is None
    planned(stream, SMALL)
    assert stream.look_at == LookAt(4.0, 0.0)
