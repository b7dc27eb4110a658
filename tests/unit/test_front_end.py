"""What bounds hostile peers in the front end, piece by piece."""

import contextlib
import errno
import json
import logging
import os
import socket
import stat
import time
from contextlib import contextmanager
from pathlib import Path

import msgpack
import pytest
import zmq

from filter_service.atomic_files import replace_atomically, write_atomically
from filter_service.errors import BadMessage, OutOfMemory
from filter_service.log_lines import (
    MAX_WAITING_LINES,
    ONCE_A_SECOND,
    LineWriter,
    RepeatFilter,
)
from filter_service.service.connections import (
    BASE_COUNT,
    MAX_IGNORED,
    MAX_REFUSALS,
    MAX_REQUESTS,
    WINDOW_S,
    Connections,
    DescriptorLimit,
    RateLimit,
    Verdict,
)
from filter_service.service.frame_queue import MAX_CATCH_UP_S, MAX_CHARGE_S, FairQueue
from filter_service.service.router import (
    Outcome,
    Router,
    drop_parts,
    drop_parts_in_python,
)
from filter_service.service.supervisor import _Restarts
from filter_service.shared_memory import SlotPool
from filter_service.wire.message import MAX_ITEMS, MAX_TEXT, unpack_profile

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


@pytest.fixture
def incomplete(clients):
    """Connect clients that have sent so many bytes of a message."""

    def connect(connections, sizes_bytes):
        for number, size_bytes in sizes_bytes.items():
            client, descriptor = clients.connect()
            connections.add(descriptor, number)
            connections.find(number, descriptor)
            connections.check_unread(0.1 * number)
            for _ in range(size_bytes // 10_000):
                client.sendall(bytes(10_000))
                os.read(descriptor, 10_000)
        return connections

    return connect


def open_numbers(connections):
    return [number for number in range(1, 5) if connections.is_open(number)]


def test_a_large_message_without_a_session_may_be_incomplete_for_ten_seconds(
    incomplete,
):
    connections = incomplete(Connections(9, {2}), {1: 400_000, 2: 400_000, 3: 200_000})
    connections.check_unread(5.0)
    connections.check_unread(10.1)
    assert open_numbers(connections) == [1, 2, 3]
    connections.check_unread(10.3)
    assert open_numbers(connections) == [2, 3]


def test_after_a_flood_of_parts_its_address_may_not_send_large_messages(incomplete):
    connections = incomplete(Connections(9, {2}), {1: 400_000, 2: 400_000, 3: 200_000})
    connections.check_unread(5.0)
    assert open_numbers(connections) == [1, 2, 3]
    connections.distrust(connections.find(3, -1), 5.0)
    connections.check_unread(5.1)
    assert open_numbers(connections) == [2, 3]


def test_a_flood_of_parts_is_forgiven_after_a_minute(incomplete):
    connections = Connections(9, set())
    connections = incomplete(connections, {1: 10_000})
    connections.distrust(connections.find(1, -1), -60.0)
    connections = incomplete(connections, {2: 400_000})
    connections.check_unread(5.0)
    assert open_numbers(connections) == [1, 2]


def test_a_complete_message_begins_the_time_anew(incomplete):
    connections = incomplete(Connections(9, set()), {1: 400_000})
    connections.check_unread(5.0)
    connections.find(1, -1)
    connections.check_unread(6.0)
    connections.check_unread(20.0)
    assert open_numbers(connections) == [1]


def test_the_largest_incomplete_messages_go_first(incomplete):
    sizes_bytes = {1: 300_000, 2: 600_000, 3: 400_000, 4: 100_000}
    limited = Connections(9, set(), max_unread_bytes=800_000)
    connections = incomplete(limited, sizes_bytes)
    connections.check_unread(6.0)
    assert open_numbers(connections) == [1, 3, 4]


# Rates


def test_other_work_of_a_session_counts_like_its_frames():
    queue = FairQueue()
    for name in ("a", "b"):
        queue.mark_waiting(name)
    queue.charge("a", 0.2)
    assert queue.pop_next(["a", "b"]) == "b"
    queue.record_frame("b", 0.3, 0.0, 0.0, 0.3)
    queue.mark_waiting("b")
    assert queue.pop_next(["a", "b"]) == "a"


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


def test_log_lines_that_repeat_are_left_out_and_counted(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("filter_service.log_lines.time.monotonic", lambda: now_s[0])
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
    now_s[0] += 0.99
    log.warning("session %d begins", 50)
    assert len(records) == 11
    now_s[0] += 0.02
    log.warning("session %d begins", 51)
    assert records[-1].getMessage() == "session 51 begins (41 similar lines omitted)"


def test_lines_that_nobody_reads_are_dropped_beyond_a_number_and_counted():
    reading, writing = os.pipe2(os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, b"x")
    os.set_blocking(reading, True)
    os.set_blocking(writing, True)
    log = logging.Logger("test")
    log.addHandler(LineWriter(writing))
    n_lines = MAX_WAITING_LINES + 50
    for number in range(n_lines):
        log.warning("line %d", number)
    with os.fdopen(reading, encoding="utf-8") as lines:
        assert lines.readline().lstrip("x") == "line 0\n"
        for number in range(1, MAX_WAITING_LINES):
            assert lines.readline() == f"line {number}\n"
        log.warning("next")
        # one more if the thread had taken a line when the others came
        read = list(iter(lines.readline, "next\n"))
    n_dropped = int(read.pop().removesuffix(" log lines could not be written\n"))
    assert MAX_WAITING_LINES + len(read) + n_dropped == n_lines
    log.warning("the reader is gone")
    log.error("which ends nothing")
    log.handlers[0].flush()
    os.close(writing)


def test_a_line_is_written_when_the_call_returns(tmp_path):
    file = tmp_path / "log"
    with file.open("w") as written:
        log = logging.Logger("test")
        log.addHandler(LineWriter(written.fileno()))
        for number in range(20):
            log.warning("line %d", number)
            log.handlers[0].flush()  # on a busy machine, a call does not wait so long
            assert file.read_text().splitlines()[-1] == f"line {number}"
        log.warning("%d and more", "no number")
        log.handlers[0].flush()
        assert "could not be formatted" in file.read_text().splitlines()[-1]


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
        unpack_profile(body)


def test_paths_of_refused_values_are_whole():
    body = {"a": [0, {"b c": [[1.0, float("inf")]]}]}
    with pytest.raises(BadMessage) as caught:
        unpack_profile(msgpack.packb(body))
    assert caught.value.field == "profile.a[1].b c[0][1]"
    assert unpack_profile(json.dumps({"a": "x" * MAX_TEXT}).encode())


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


def test_a_write_that_fails_leaves_the_earlier_file(tmp_path):
    def fail(part):
        part.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    target = tmp_path / "file.png"
    target.write_text("earlier")
    with pytest.raises(OSError, match="No space"):
        replace_atomically(target, fail)
    assert target.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("earlier", "is_private", "expected"),
    [(0o600, False, 0o600), (0o644, False, 0o644), (0o644, True, 0o600)],
)
def test_a_file_written_anew_is_no_more_public(tmp_path, earlier, is_private, expected):
    target = tmp_path / "file.txt"
    target.touch()
    target.chmod(earlier)
    replace_atomically(
        target, lambda part: part.write_text("new"), is_private=is_private
    )
    assert target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == expected


def test_a_device_is_written_and_not_replaced():
    replace_atomically(Path("/dev/null"), lambda part: part.write_text("gone"))
    assert Path("/dev/null").is_char_device()


def test_pauses_before_restarts_grow_to_a_minute_and_end_with_a_stable_process():
    restarts = _Restarts()
    pauses_s = [restarts.record_exit(float(i), float(i)) for i in range(11)]
    assert pauses_s == [0, 0, 1, 2, 4, 8, 16, 32, 60, 60, 60]
    assert restarts.record_exit(100.0, 161.0) == 0.0


# The socket


@contextmanager
def routing(connections):
    box = Router("tcp://127.0.0.1:*", 10**6, 4, connections=connections)
    try:
        yield box
    finally:
        box.close()


@pytest.fixture
def router():
    with routing(Connections(9, set())) as box:
        yield box


def received_within(router, limit_s=5.0):
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        router.wait(0.05)
        message = router.receive()
        if message is not None:
            return message
    raise AssertionError("nothing was received")


class Between(Connections):
    """Calls a function once, after the monitor has told of a connection."""

    def __init__(self, call):
        super().__init__(9, set())
        self.calls = [call]

    def evict(self):
        super().evict()
        if self.calls:
            self.calls.pop()()


def test_a_connection_that_comes_between_is_known_before_it_has_a_number():
    """It was not, on a busy machine: its client was never answered."""
    context = zmq.Context()
    first, dealer = context.socket(zmq.DEALER), context.socket(zmq.DEALER)

    def connect():  # after the monitor was read, and before requests are answered
        dealer.connect(router.endpoint)
        dealer.send(b"hello")
        time.sleep(0.2)

    try:
        with routing(Between(connect)) as router:
            first.connect(router.endpoint)
            message = received_within(router)
            assert bytes(message.parts[0]) == b"hello"
            assert message.connection is not None
            outcome, _ = router.send(message.peer, [b"welcome"])
            assert (outcome, dealer.recv()) == (Outcome.SENT, b"welcome")
    finally:
        first.close(linger=0)
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
