"""What bounds hostile peers in the front end, piece by piece."""

import json
import logging
import os
import socket
import time

import msgpack
import pytest
import zmq

from filter_service.atomic_files import write_atomically
from filter_service.errors import BadMessage, OutOfMemory
from filter_service.log_lines import ONCE_A_SECOND, RepeatFilter
from filter_service.service.connections import Connections
from filter_service.service.descriptors import BASE_COUNT, DescriptorLimit
from filter_service.service.dropped_parts import drop_parts, drop_parts_in_python
from filter_service.service.fair_queue import MAX_CATCH_UP_S, MAX_CHARGE_S, FairQueue
from filter_service.service.rate_limit import (
    MAX_IGNORED,
    MAX_REFUSALS,
    MAX_REQUESTS,
    WINDOW_S,
    RateLimit,
    Verdict,
)
from filter_service.service.router import Outcome, Router
from filter_service.service.supervisor import _Restarts
from filter_service.shared_memory import SlotPool
from filter_service.wire.unpacking import MAX_ITEMS, MAX_TEXT, unpack_profile

# Connections


@pytest.fixture
def listener():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener


class Clients:
    """Connections as libzmq has them: the accepted ends' descriptors."""

    def __init__(self, listener):
        self.listener, self.ends = listener, []

    def connect(self, opening=b""):
        client = socket.create_connection(self.listener.getsockname())
        accepted, _ = self.listener.accept()
        client.sendall(opening)
        client.settimeout(5.0)
        self.ends += [client, accepted]
        return client, accepted.fileno()

    def close(self):
        for end in self.ends:
            end.close()


@pytest.fixture
def clients(listener):
    clients = Clients(listener)
    yield clients
    clients.close()


def is_closed(client):
    try:
        return client.recv(1) == b""
    except (ConnectionError, BlockingIOError) as error:
        return isinstance(error, ConnectionError)


def test_the_oldest_connections_without_session_or_greeting_are_closed(clients):
    with_session = set()
    connections = Connections(3, with_session)
    held = []
    for number, opening in enumerate((b"", b"x" * 64, b"", b"")):
        client, descriptor = clients.connect(opening)
        held.append(client)
        connections.add(descriptor, number)
    time.sleep(0.05)  # until the greeting has arrived
    assert connections.find(0, clients.ends[1].fileno()) is not None
    with_session.add(0)
    connections.evict()
    for client in held:
        client.setblocking(False)
    assert [is_closed(client) for client in held] == [False, False, True, False]
    assert connections.n_evicted == 1


def test_a_descriptor_that_was_given_again_is_not_taken_for_the_old_connection(clients):
    connections = Connections(9, set())
    _, descriptor = clients.connect()
    connections.add(descriptor, 1)
    assert connections.find(1, descriptor) is not None
    assert connections.remove(descriptor) == 1
    _, other = clients.connect()
    os.dup2(other, descriptor)  # as the system gives a number again
    connections.add(descriptor, 2)
    assert connections.find(1, descriptor) is None, "of the connection before"
    assert not connections.is_open(1)
    assert connections.find(2, descriptor) is not None


def test_a_file_that_has_the_descriptor_now_is_left_alone(clients):
    connections = Connections(9, set())
    _, descriptor = clients.connect()
    connections.add(descriptor, 1)
    connections.find(1, descriptor)
    _, other = clients.connect()
    os.dup2(other, descriptor)
    connections.close(1, "it misbehaves")
    clients.ends[2].setblocking(False)
    assert not is_closed(clients.ends[2])


def test_what_is_sent_without_a_session_is_limited(clients):
    with_session = {2}
    connections = Connections(9, with_session)
    held = []
    for number in (1, 2):
        client, descriptor = clients.connect()
        connections.add(descriptor, number)
        connections.find(number, descriptor)
        held.append((client, descriptor))
    connections.check_unread(1.0)
    for client, descriptor in held:
        client.setblocking(False)
        sent = 0
        while sent < 400_000:
            try:
                sent += client.send(bytes(65536))
            except BlockingIOError:
                break
            os.read(descriptor, 65536)
        assert sent > 300_000
    connections.check_unread(2.0)
    assert not connections.is_open(1)
    assert connections.is_open(2)


# Rates


def test_refusals_and_requests_are_counted_by_the_second():
    rates = RateLimit()
    for _ in range(MAX_REFUSALS):
        assert rates.verdict(0.0) is Verdict.HANDLE
        rates.count_refusal()
    assert rates.verdict(0.5) is Verdict.IGNORE
    assert rates.verdict(WINDOW_S) is Verdict.HANDLE
    for _ in range(MAX_REQUESTS):
        assert rates.verdict(1.5) is Verdict.HANDLE
        rates.count_request()
    verdicts = [rates.verdict(1.6) for _ in range(MAX_IGNORED + 1)]
    assert verdicts == [Verdict.IGNORE] * MAX_IGNORED + [Verdict.CLOSE]


def test_frames_alone_are_never_too_many():
    rates = RateLimit()
    assert all(rates.verdict(0.0) is Verdict.HANDLE for _ in range(10_000))


def test_log_lines_that_repeat_are_left_out_and_counted():
    records, log = [], logging.Logger("test")
    handler = logging.Handler()
    handler.emit = records.append
    handler.addFilter(RepeatFilter())
    log.addHandler(handler)
    for number in range(50):
        log.warning("session %d begins", number)
    assert len(records) == 10
    for _ in range(5):
        log.warning("no descriptors", extra=ONCE_A_SECOND)
    assert len(records) == 11
    time.sleep(1.05)
    log.warning("session %d begins", 50)
    assert records[-1].getMessage() == "session 50 begins (40 similar lines omitted)"


# Fairness


IDLE_S = 0.004
"""From one frame to the next: of the messages that end one and begin the other."""


def simulated(costs_s, duration_s):
    """Serve sessions that always wait; return the time of each and its waits."""
    queue = FairQueue()
    used_s, waits_s = dict.fromkeys(costs_s, 0.0), {name: [] for name in costs_s}
    since_s, now_s = dict.fromkeys(costs_s, 0.0), 0.0
    for name in costs_s:
        queue.mark_waiting(name)
    while now_s < duration_s:
        chosen = queue.pop_next(costs_s)
        started_s = now_s + IDLE_S
        waits_s[chosen].append(started_s - since_s[chosen])
        now_s = started_s + costs_s[chosen]
        queue.record_frame(chosen, costs_s[chosen], since_s[chosen], started_s, now_s)
        used_s[chosen] += IDLE_S + costs_s[chosen]
        since_s[chosen] = now_s
        queue.mark_waiting(chosen)
    return used_s, waits_s


def note(queue, name, used_s):
    queue.record_frame(name, used_s, 0.0, 0.0, 0.0)


def test_heavy_and_light_sessions_that_wait_have_equal_time():
    costs_s = {f"light {i}": 0.004 for i in range(20)} | {"heavy": 2.0, "huge": 5.0}
    used_s, waits_s = simulated(costs_s, 20 * 2.0 * 22)
    assert max(used_s.values()) - min(used_s.values()) <= 5.0 + IDLE_S
    for name, cost_s in (("heavy", 2.0), ("huge", 5.0)):
        assert max(waits_s[name]) <= 1.5 * 22 * cost_s


def test_who_asked_for_nothing_has_little_claim():
    queue = FairQueue()
    for name in ("busy", "idle"):
        queue.mark_waiting(name)
    assert queue.pop_next(["idle"]) == "idle"
    note(queue, "idle", 0.01)
    for _ in range(10):
        queue.mark_waiting("busy")
        assert queue.pop_next(["busy"]) == "busy"
        note(queue, "busy", 1.0)
    queue.mark_waiting("idle")  # after ten seconds
    queue.mark_waiting("busy")
    served_s = 0.0
    while queue.pop_next(["busy", "idle"]) == "idle":
        note(queue, "idle", 0.1)
        queue.mark_waiting("idle")
        served_s += 0.1
    assert served_s <= 1.0 + MAX_CATCH_UP_S + 0.2, (
        "its frame's worth, and what it caught up"
    )


def test_a_frame_that_hung_is_not_owed_for_ever():
    queue = FairQueue()
    for name in ("hung", "other"):
        queue.mark_waiting(name)
    assert queue.pop_next(["hung"]) == "hung"
    note(queue, "hung", 600.0)
    queue.mark_waiting("hung")
    served_s = 0.0
    while queue.pop_next(["hung", "other"]) == "other":
        note(queue, "other", 1.0)
        queue.mark_waiting("other")
        served_s += 1.0
    assert served_s <= MAX_CHARGE_S + 1.0


# Descriptors and memory


def test_descriptors_are_reserved_for_the_front_end(monkeypatch):
    import resource

    limits = [(300, 300)]
    monkeypatch.setattr(resource, "getrlimit", lambda _: limits[-1])
    monkeypatch.setattr(resource, "setrlimit", lambda _, pair: limits.append(pair))
    limit = DescriptorLimit(8)
    assert limits[-1] == (268, 300)
    assert BASE_COUNT + limit.max_connections + limit.max_slots == 300
    with limit.reserve():
        assert limits[-1] == (300, 300)
    assert limits[-1] == (268, 300)
    with pytest.raises(
        OSError, match="may open 300 files; expected at least 303 for 69"
    ):
        DescriptorLimit(69)


def test_slots_have_a_limit_to_their_number():
    pool = SlotPool(10**6, 3)
    for _ in range(3):
        pool.create(10)
    with pytest.raises(OutOfMemory, match="3 slots of shared memory are in use"):
        pool.create(10)


def test_no_descriptor_is_an_out_of_memory(monkeypatch):
    def none_left(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(os, "memfd_create", none_left)
    with pytest.raises(OutOfMemory, match="Too many open files"):
        SlotPool(10**6).create(10)


@pytest.mark.parametrize("drop", [drop_parts, drop_parts_in_python])
def test_parts_are_dropped_in_slices_up_to_the_end_of_the_message(drop):
    context = zmq.Context()
    router, dealer = context.socket(zmq.ROUTER), context.socket(zmq.DEALER)
    try:
        router.bind("inproc://parts")
        dealer.connect("inproc://parts")
        dealer.send_multipart([b"x"] * 250)
        dealer.send_multipart([b"next"])
        router.recv(copy=False)
        assert router.recv(copy=False).more
        assert drop(router, 100) == (100, True)
        assert drop(router, 100) == (100, True)
        assert drop(router, 100) == (49, False)
        assert router.recv_multipart()[1:] == [b"next"]
    finally:
        router.close(linger=0)
        dealer.close(linger=0)
        context.term()


# Profiles


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (json.dumps({"a": [[]] * 20_000}).encode(), "more than 16,384 values"),
        (json.dumps({"a": [1] * 20_000}).encode(), "more than 16,384 values"),
        (msgpack.packb({"a": [[[]] * 4000] * 5}), f"more than {MAX_ITEMS} items"),
        (msgpack.packb({"a": [[0] * 4000] * 5}), f"more than {MAX_ITEMS} items"),
        (b'{"a": ' + b"1" * 900_000 + b"}", "an integer of 900000 digits"),
        (b'{"a": ' + b"[" * 5000 + b"]" * 5000 + b"}", "cannot be read as JSON"),
        (
            b'{"a": ' + b"[" * 40 + b"]" * 40 + b"}",
            "arrays more than 32 deep",
        ),
        (json.dumps({"a": {"b": "x" * 5000}}).encode(), "5000 characters"),
    ],
)
def test_profiles_are_bounded_before_they_are_read(body, text):
    with pytest.raises(BadMessage, match=text):
        unpack_profile(body, 2**20)


def test_paths_of_refused_values_are_whole():
    body = {"a": [0, {"b c": [[1.0, float("inf")]]}]}
    with pytest.raises(BadMessage) as caught:
        unpack_profile(msgpack.packb(body), 10_000)
    assert caught.value.field == "profile.a[1].b c[0][1]"
    assert unpack_profile(json.dumps({"a": "x" * MAX_TEXT}).encode(), 10_000)


# Files and processes


def test_an_atomic_write_follows_no_link_and_can_refuse_to_replace(tmp_path):
    target, other = tmp_path / "file", tmp_path / "other"
    other.write_text("mine")
    target.symlink_to(other)
    write_atomically(target, "new")
    assert (target.read_text(), other.read_text()) == ("new", "mine")
    with pytest.raises(FileExistsError):
        write_atomically(target, "newer", is_new=True)
    assert target.read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "other"]


def test_pauses_before_restarts_grow_to_a_minute_and_end_with_a_stable_process():
    restarts = _Restarts()
    pauses_s = [restarts.record_exit(float(i), float(i)) for i in range(11)]
    assert pauses_s == [0, 0, 1, 2, 4, 8, 16, 32, 60, 60, 60]
    assert restarts.record_exit(100.0, 161.0) == 0.0


# The socket


@pytest.fixture
def router():
    connections = Connections(9, set())
    box = Router("tcp://127.0.0.1:*", 10**6, 4, connections=connections)
    yield box
    box.close()


def received_within(router, limit_s=5.0):
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        router.wait(0.05)
        message = router.receive()
        if message is not None:
            return message
    raise AssertionError("nothing was received")


def test_a_connection_that_comes_between_is_known_before_it_has_a_number(
    router, monkeypatch
):
    """It was not, on a busy machine: its client was never answered."""
    context = zmq.Context()
    dealer = context.socket(zmq.DEALER)
    answer = router._authenticator.handle_requests
    calls = []

    def late():
        if not calls:  # after the monitor was read, and before requests are answered
            dealer.connect(router.endpoint)
            dealer.send(b"hello")
            time.sleep(0.2)
        calls.append(1)
        answer()

    monkeypatch.setattr(router._authenticator, "handle_requests", late)
    try:
        message = received_within(router)
        assert bytes(message.parts[0]) == b"hello"
        assert message.connection is not None
        outcome, _ = router.send(message.peer, [b"welcome"])
        assert (outcome, dealer.recv()) == (Outcome.SENT, b"welcome")
    finally:
        dealer.close(linger=0)
        context.term()


def test_a_reply_to_a_connection_that_has_ended_is_not_sent(router):
    context = zmq.Context()
    dealer = context.socket(zmq.DEALER)
    dealer.setsockopt(zmq.IDENTITY, b"camera")
    dealer.connect(router.endpoint)
    dealer.send(b"hello")
    peer = received_within(router).peer
    dealer.close(linger=0)
    thief = context.socket(zmq.DEALER)
    try:
        end_s = time.monotonic() + 5.0
        while not router.pop_ended():
            assert time.monotonic() < end_s
            router.wait(0.05)
        thief.setsockopt(zmq.IDENTITY, b"camera")
        thief.connect(router.endpoint)
        thief.send(b"mine")
        other = received_within(router).peer
        assert other.routing_id == peer.routing_id
        assert other.connection != peer.connection
        assert router.send(peer, [b"secret"])[0] is Outcome.GONE
        assert router.send(other, [b"hello"])[0] is Outcome.SENT
        thief.rcvtimeo = 5000
        assert thief.recv() == b"hello"
    finally:
        thief.close(linger=0)
        context.term()
