"""A session's rules without sockets: credit, which eye serves, what is built."""

import pytest

from filter_service import Preparing
from filter_service.camera import Camera
from filter_service.errors import BuildFailed, CreditExceeded, NoProfile
from filter_service.filtering.stream_eyes import PreparedStore, StreamEyes
from filter_service.messages import Frame, ViewHeader
from filter_service.service.session import Session, WaitingFrame
from filter_service.settings import DEFAULTS, FilterSettings

SMALL = Camera(100, 100, (-0.5, 0.5, 0.5, -0.5))  # 10 mrad
LARGE = Camera(200, 200, (-0.5, 0.5, 0.5, -0.5))  # 5 mrad


class Store:
    """Stands for a loaded store."""


def make_stream(**changes):
    return StreamEyes(on_event=lambda event: None, **{"max_cameras": 2} | changes)


def planned(stream, *cameras):
    return stream.plan(cameras)


def add(stream, profile_id, *cameras, settings=DEFAULTS):
    return stream.add_profile(None, settings, cameras, profile_id=profile_id)


def load_one(stream):
    """Load what the stream asks for next; return its eye and the prepared store."""
    following = stream.next_build()
    prepared = PreparedStore(following.camera, Store(), 0.0)
    stream.add_store(following.eye, prepared)
    return following.eye, prepared


def build_all(stream):
    """Make ready what the stream asks for; return the stores in order."""
    stores = []
    while stream.next_build() is not None:
        eye, prepared = load_one(stream)
        stream.set_ready(eye, prepared)
        stores.append(prepared.store)
    return stores


def test_credit_counts_unanswered_frames_and_the_newest_waits():
    session = Session(1, b"a", "", credit=2)
    view = (ViewHeader.of(SMALL),)
    frames = [WaitingFrame(Frame(i, view, 4.0, 0.0), b"", 0.0, 0.0) for i in range(3)]
    assert session.enqueue(frames[0]) is None
    assert session.enqueue(frames[1]) is frames[0]
    with pytest.raises(CreditExceeded, match="2 frames are unanswered"):
        session.enqueue(frames[2])
    assert session.waiting is frames[1]
    session.n_unanswered -= 1
    assert session.enqueue(frames[2]) is frames[1]


def test_a_frame_needs_a_profile():
    with pytest.raises(NoProfile):
        planned(make_stream(), SMALL)


def test_the_old_eye_serves_until_the_new_one_is_ready_and_is_then_given_up():
    stream = make_stream()
    old = add(stream, 1, SMALL)
    (old_store,) = build_all(stream)
    new = add(stream, 2)
    assert new.generation == old.generation + 1
    assert planned(stream, SMALL)[0] is old
    (new_store,) = build_all(stream)
    plan = planned(stream, SMALL)
    assert plan == (new, [new_store])
    assert stream.retired == [old_store]


def test_a_new_camera_is_wanted_while_the_old_eye_serves_the_old_one():
    stream = make_stream()
    add(stream, 1, SMALL)
    build_all(stream)
    assert planned(stream, LARGE) == Preparing("preparing")
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
    assert planned(stream, SMALL)[0] is old
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


def test_the_old_eye_serves_until_a_first_frame_through_the_new_one_is_prepared():
    stream = make_stream()
    old = add(stream, 1, SMALL)
    (old_store,) = build_all(stream)
    new = add(stream, 2)
    eye, prepared = load_one(stream)
    assert eye is new
    assert stream.next_build() is None
    assert stream.store_to_warm() == (new, prepared)
    assert stream.unfinished_eye() is new
    plan = planned(stream, SMALL)
    assert plan == (old, [old_store])
    stream.set_ready(new, prepared)
    assert stream.store_to_warm() is None
    assert stream.unfinished_eye() is None
    plan = planned(stream, SMALL)
    assert plan == (new, [prepared.store])
    assert stream.retired == [old_store]
    assert stream.store_in_use() is prepared


def test_without_an_old_eye_frames_go_through_the_one_that_is_being_prepared():
    stream = make_stream()
    add(stream, 1, SMALL)
    assert planned(stream, SMALL) == Preparing("preparing")
    _, prepared = load_one(stream)
    assert planned(stream, SMALL)[1] == [prepared.store]
    assert stream.store_in_use() is None


def test_an_eye_that_fails_while_it_is_prepared_gives_way_to_the_old_one():
    stream = make_stream()
    old = add(stream, 1, SMALL)
    build_all(stream)
    new = add(stream, 2)
    _, prepared = load_one(stream)
    stream.fail_build(new, SMALL, BuildFailed("no"))
    assert planned(stream, SMALL)[0] is old
    assert stream.retired == [prepared.store]


def test_a_newer_profile_replaces_an_eye_that_is_being_prepared():
    stream = make_stream()
    old = add(stream, 1, SMALL)
    build_all(stream)
    add(stream, 2)
    _, prepared = load_one(stream)
    third = add(stream, 3)
    assert stream.eyes == [third, old]
    assert stream.retired == [prepared.store]


def test_the_second_view_of_a_pair_needs_its_own_store_over_the_field_only():
    left = Camera(100, 100, (-0.6, 0.4, 0.5, -0.5))
    right = Camera(100, 100, (-0.4, 0.6, 0.5, -0.5))
    for settings, cameras in (
        (FilterSettings(mode="on-axis"), (left,)),
        (FilterSettings(mode="quality"), (left, right)),
    ):
        stream = make_stream()
        eye = add(stream, 1, left, right, settings=settings)
        assert eye.requested == cameras
        build_all(stream)
        assert planned(stream, left, right) is not None
