"""Images in memory that service and client share: in place both ways, and bounded."""

import gc
import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

from clients.filter_client import FilterClient
from filter_service.messages import Hello, Share, SharedPlaces, Unshare, encode
from filter_service.shared_memory import Slot, SlotPool, aligned_starts
from tests.end_to_end.conftest import TIMEOUT_S, make_view, small_frame
from tests.end_to_end.test_faults import filtered_again
from tests.end_to_end.test_lifecycle import wait_until

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}


def until_shared(client, view):
    """Filter until frames travel through shared memory."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while time.monotonic() < deadline_s:
        reply = client.filter(view, **SEE)
        if reply.in_memory:
            return reply
    raise AssertionError("no memory is shared")


@pytest.fixture
def shared_client(shared_service):
    with FilterClient(shared_service.endpoint, timeout_s=TIMEOUT_S) as client:
        yield client


@pytest.mark.parametrize("size", [(64, 36), (1, 1), (7, 301), (640, 480)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_frames_come_back_as_they_do_over_the_wire(shared_client, size, dtype):
    view = make_view(*size, dtype=dtype)
    shared_client.set_profile(EYE, views=[view])
    output = "srgb8" if dtype == np.uint8 else "linear"
    by_wire = shared_client.filter(view, **SEE, output=output)
    assert not by_wire.in_memory, "there was no slot yet"
    shared = until_shared(shared_client, view)
    if output == "linear":
        shared = shared_client.filter(view, **SEE, output=output)
        while not shared.in_memory:
            shared = shared_client.filter(view, **SEE, output=output)
    np.testing.assert_array_equal(shared.color, by_wire.color)


def test_two_views_with_hidden_layers_lie_in_one_slot(shared_client):
    left, right = (
        replace(
            make_view(64, 36, seed=seed),
            hidden_color=make_view(64, 36, seed=seed + 5).color,
            hidden_depth_m=make_view(64, 36).depth_m,
        )
        for seed in (1, 2)
    )
    shared_client.set_profile(EYE, views=[left, right])
    reply = shared_client.filter([left, right], **SEE)
    while not reply.in_memory:
        reply = shared_client.filter([left, right], **SEE)
    for view, color in zip((left, right), reply.colors, strict=True):
        np.testing.assert_array_equal(color[1:], 255 - view.color[1:])


def test_a_result_stays_as_it_is_as_long_as_somebody_has_it(shared_client):
    view = make_view(320, 180)
    shared_client.set_profile(EYE, views=[view])
    until_shared(shared_client, view)
    kept = []
    for value in range(9):
        view.color[:] = value
        reply = shared_client.filter(view, **SEE)
        kept.append((value, reply.color[5:]))  # a view of it holds it, too
        if value % 3:
            kept.pop(0)
        del reply
        gc.collect(1)  # all that these frames made
        for known, color in kept:
            assert np.all(color == 255 - known)


def test_a_lent_view_is_rendered_into_and_not_copied(shared_client):
    camera = make_view(320, 180).camera
    shared_client.set_profile(EYE, views=[camera])
    until_shared(shared_client, make_view(320, 180))
    lent = shared_client.lend_view(camera)
    memory = shared_client._link.memory
    assert memory.holding(lent.images) is not None
    for value in (3, 200):
        lent.color[:] = value
        lent.depth_m[:] = 2.0
        n_slots = len(memory._slots)
        reply = shared_client.filter(lent, **SEE)
        assert reply.in_memory
        assert np.all(reply.color[1:] == 255 - value)
        assert len(memory._slots) == n_slots
        del reply  # else its slot is in use, and another is asked for


def test_a_client_may_do_without(use_service, shared_service):
    service = use_service(shared_memory=False)
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        assert "shm" not in client.hello().transports
        view = make_view()
        client.set_profile(EYE, views=[view])
        for _ in range(4):
            assert not client.filter(view, **SEE).in_memory
    with FilterClient(shared_service.endpoint, shared_memory=False) as client:
        client.set_profile(EYE, views=[view])
        for _ in range(4):
            assert not client.filter(view, **SEE).in_memory


@pytest.mark.long("a service starts, and a process of it again")
@pytest.mark.parametrize("name", ["front-end", "render"])
def test_memory_is_shared_again_after_a_process_was_killed(start_service, name):
    service = start_service()
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        before = until_shared(client, view)
        pid = service.pids()[name]
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: service.pids().get(name, pid) != pid)
        filtered_again(client, view)
        after = until_shared(client, view)
        np.testing.assert_array_equal(after.color, before.color)


def test_nothing_is_left_behind_and_memory_goes_back(shared_service):
    service = shared_service
    view = make_view(1024, 1024)
    before_mb = service.memory_mb
    for _ in range(8):
        with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
            client.set_profile(EYE, views=[view])
            until_shared(client, view)
    wait_until(lambda: service.memory_mb - before_mb < 60.0)


@pytest.fixture
def raw(shared_service, raw_client):
    client = raw_client(shared_service)
    client.begin()
    return client


def in_memory(frame_id, slot, result_slot, *, starts=None, result_starts=None):
    color_bytes = 16 * 8 * 3
    places = SharedPlaces(
        slot, starts or (0, color_bytes), result_slot, result_starts or (0,)
    )
    return replace(small_frame(frame_id), memory=places)


def test_places_are_checked(raw):
    first, second = (raw.ask(Share(4096)) for _ in range(2))
    stranger = {"slot": first.slot + 100, "result_slot": second.slot}
    cases = {
        "memory.slot": in_memory(1, **stranger),
        "memory.result_slot": in_memory(2, first.slot, first.slot),
        "memory.starts": in_memory(3, first.slot, second.slot, starts=(0, 4096)),
        "memory.result_starts": in_memory(
            4, first.slot, second.slot, result_starts=(4032,)
        ),
    }
    for field, frame in cases.items():
        answer = raw.ask(frame)
        assert (answer.code, answer.field) == ("bad_message", field)
        assert answer.frame_id == frame.frame_id
    overlapping = in_memory(5, first.slot, second.slot, starts=(0, 64))
    odd = in_memory(6, first.slot, second.slot, starts=(0, 390))
    few = in_memory(7, first.slot, second.slot, starts=(0,))
    huge = in_memory(8, first.slot, second.slot, starts=(0, 2**53 - 64))
    for frame in (overlapping, odd, few, huge):
        assert raw.ask(frame).field == "memory.starts"
    good = raw.ask(in_memory(9, first.slot, second.slot))
    assert (good.type_name, good.in_memory) == ("result", True)


def test_a_slot_in_use_is_not_taken_twice(shared_service, raw_client):
    raw = raw_client(shared_service)
    raw.begin(more={"filter_ms": 300})
    first, second, third = (raw.ask(Share(4096)) for _ in range(3))
    raw.send(encode(in_memory(1, first.slot, second.slot)))
    answer = raw.ask(in_memory(2, first.slot, third.slot))
    assert (answer.code, answer.field) == ("bad_message", "memory.slot")
    answer = raw.ask(Unshare(second.slot))
    assert (answer.code, answer.field) == ("bad_message", "slot")
    assert raw.receive().frame_id == 1
    raw.send(encode(Unshare(second.slot)))
    assert raw.ask(in_memory(3, first.slot, third.slot)).in_memory


def test_memory_has_bounds_for_each_session(small_service, raw_client):
    raw, other = raw_client(small_service), raw_client(small_service)
    raw.ask(Hello("raw"))
    given = [raw.ask(Share(800_000)) for _ in range(5)]
    assert [g.slot is not None for g in given] == [True] * 3 + [False] * 2
    assert "allowed: 2500000 in total" in given[-1].reason
    answer = raw.ask(Share(2**40))
    assert answer.slot is None
    many = [raw.ask(Share(64)) for _ in range(20)]
    assert sum(m.slot is not None for m in many) == 13
    other.begin(mark=3)
    assert other.ask(small_frame(1)).colors[0][0, 0, 0] == 3
    assert other.ask(Share(800_000)).slot is not None


def test_a_slot_is_sealed_and_full_from_the_start():
    slot = Slot.create(1, 10_000)
    with pytest.raises(PermissionError):
        os.ftruncate(slot.descriptor, 100)
    assert os.fstat(slot.descriptor).st_blocks * 512 >= 10_000
    with pytest.raises(ValueError, match="of a slot"):
        slot.part(0, slot.size_bytes + 1)
    other = Slot.received(1, slot.size_bytes, os.dup(slot.descriptor))
    slot.array(64, (4,), np.dtype(np.float32))[:] = [1, 2, 3, 4]
    assert other.array(64, (4,), np.dtype(np.float32)).tolist() == [1, 2, 3, 4]
    unsealed = os.memfd_create("plain")
    os.ftruncate(unsealed, 4096)
    with pytest.raises((ValueError, OSError)):
        Slot.received(2, 4096, unsealed)


def test_a_pool_uses_slots_again_and_not_for_what_is_much_smaller():
    pool = SlotPool(100_000)
    slot, is_new = pool.acquire(20_000)
    assert is_new
    pool.release(slot)
    assert pool.acquire(19_000) == (slot, False)
    pool.release(slot)
    small, is_new = pool.acquire(1000)
    assert is_new
    pool.release(small)
    assert {s.number for s in pool.trim()} == {slot.number, small.number}
    assert pool.total_bytes == 0
    assert aligned_starts([1, 64, 65]) == ([0, 64, 128], 256)
