"""What a day in a lab brings, and a hostile client: the service goes on."""

import os
import re
import signal
import struct
import time
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq

from clients.filter_client import FilterClient, FilteredFrame
from filter_service.errors import FilterError
from filter_service.messages import Hello, Ping, ProfileRequest, encode
from filter_service.wire.replies import Dropped
from tests.attacks import spoken_to
from tests.end_to_end.conftest import TIMEOUT_S, RawClient, make_view, small_frame
from tests.end_to_end.test_lifecycle import children_of, wait_until

pytestmark = pytest.mark.clock

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}


def worker_of(service):
    (worker,) = children_of(service.pids()["render"])
    return worker


def filtered_again(client, view, *, limit_s=TIMEOUT_S):
    """Send frames until one is filtered; return it, and the seconds it took."""
    started_s = time.monotonic()
    while time.monotonic() - started_s < limit_s:
        try:
            return client.filter(view, **SEE, timeout_s=1.0), (
                time.monotonic() - started_s
            )
        except FilterError:
            time.sleep(0.02)
    raise AssertionError("no frame came through any more")


# What dies or stands still


@pytest.mark.parametrize("name", ["front-end", "render"])
@pytest.mark.parametrize(
    "when",
    [pytest.param("idle", marks=pytest.mark.slow), "in mid-frame", "in mid-build"],
)
def test_a_process_that_is_killed_is_started_again_and_the_eye_is_there(
    start_service, name, when
):
    service = start_service(filter_ms=100)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        session_id = client.hello().session_id
        before = service.pids()
        if when == "in mid-frame":
            client.submit(view, **SEE)
            time.sleep(0.05)
        elif when == "in mid-build":
            client.set_profile(EYE | {"mark": 9, "build_s": 0.4}, wait=False)
        os.kill(before[name], signal.SIGKILL)
        wait_until(lambda: service.pids().get(name, before[name]) != before[name])
        reply, took_s = filtered_again(client, view)
        assert took_s < 3.0
        if when == "in mid-build":
            deadline_s = time.monotonic() + TIMEOUT_S
            while reply.color[0, 0, 0] != 9 and time.monotonic() < deadline_s:
                reply, _ = filtered_again(client, view)
            assert reply.color[0, 0, 0] == 9
        else:
            assert reply.color[0, 0, 0] == 5
        assert client.hello().session_id == session_id
        assert service.pids()["supervisor"] == before["supervisor"]
    assert f"the {name} process was killed by SIGKILL" in service.log


def test_frames_wait_for_the_eyes_of_a_new_process(start_service, raw_client):
    """One that comes while the process is started finds its session there."""
    service = start_service()
    raw = raw_client(service)
    raw.begin(mark=7)
    os.kill(service.pids()["render"], signal.SIGKILL)
    marks, frame_id = [], 0
    while not marks:
        frame_id += 1
        raw.send(encode(small_frame(frame_id)))
        answer = raw.receive()
        while getattr(answer, "frame_id", None) != frame_id:
            answer = raw.receive()  # of the profile, which is prepared once more
        kind = getattr(answer, "code", getattr(answer, "reason", "result"))
        assert kind in ("render_failed", "preparing", "result")
        if kind == "result":
            marks.append(answer.colors[0][0, 0, 0])
        time.sleep(0.01)
    assert marks == [7]


def test_a_frame_that_dies_with_its_process_is_answered(start_service, raw_client):
    service = start_service(filter_ms=2000)
    raw = raw_client(service)
    raw.begin()
    raw.send(encode(small_frame(1)))
    time.sleep(0.2)
    os.kill(service.pids()["render"], signal.SIGKILL)
    answer = raw.receive()
    assert (answer.code, answer.frame_id) == ("render_failed", 1)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) for n in ("front-end", "render")]
)
def test_a_process_that_stands_still_is_ended_and_started_again(start_service, name):
    service = start_service()
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        os.kill(service.pids()[name], signal.SIGSTOP)
        _, took_s = filtered_again(client, view)
        assert took_s < 8.0
    assert f"the {name} process does not respond" in service.log


@pytest.mark.slow
def test_a_worker_that_stands_still_is_ended_and_the_next_build_goes_on(start_service):
    service = start_service()
    view = make_view()
    with (
        FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as first,
        FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as second,
    ):
        first.set_profile(EYE | {"build_s": 30}, views=[view], wait=False)
        time.sleep(0.3)
        os.kill(worker_of(service), signal.SIGSTOP)
        started_s = time.monotonic()
        second.set_profile(EYE | {"mark": 8}, views=[view])
        assert time.monotonic() - started_s < 8.0
        assert second.filter(view, **SEE).color[0, 0, 0] == 8
        codes = [getattr(event, "code", "") for event in first.poll(TIMEOUT_S)]
        assert "worker_crashed" in codes


def test_a_frame_without_an_end_is_ended(start_service):
    service = start_service(filter_ms=60_000, frame_limit_s=1.0)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        with pytest.raises(FilterError, match="the render worker exited"):
            client.filter(view, **SEE)
    assert "has not responded for 1 s" in service.log


def test_both_processes_killed_at_once_are_both_started_again(start_service):
    service = start_service()
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        for n_killed in range(1, 4):
            pids = service.pids()
            for name in ("render", "front-end"):
                os.kill(pids[name], signal.SIGKILL)
            wait_until(lambda n=n_killed: service.log.count("SIGKILL") >= 2 * n)
            seen = client.filter(view, **SEE)
            assert seen.color[0, 0, 0] == EYE["mark"]
    assert service.process.poll() is None


def await_standby(service, other_than=None):
    end_s = time.monotonic() + TIMEOUT_S
    while (pid := service.pids().get("standby")) in (None, other_than):
        assert time.monotonic() < end_s, "nobody stands by"
        time.sleep(0.05)
    time.sleep(1.0)  # until it is ready
    return pid


def test_who_stands_by_takes_over_and_another_stands_by(start_service, monkeypatch):
    monkeypatch.setenv("OCUFILTER_TEST_STANDBY_AFTER_S", "0.1")
    service = start_service(standby=True)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        client.filter(view, **SEE)
        standby = await_standby(service)
        os.kill(service.pids()["render"], signal.SIGKILL)
        wait_until(lambda: "the standby process takes over" in service.log)
        seen = client.filter(view, **SEE)
        assert seen.color[0, 0, 0] == EYE["mark"]
        assert service.pids()["render"] == standby
        newer = await_standby(service, other_than=standby)
        os.kill(newer, signal.SIGKILL)
        client.filter(view, **SEE)
        assert await_standby(service, other_than=newer) != standby
        assert service.pids()["render"] == standby, "it was not disturbed"


# Sessions


def test_a_session_is_taken_up_by_its_key_and_by_nothing_else(
    shared_service, raw_client
):
    first = raw_client(shared_service)
    welcome = first.begin(mark=7)
    assert not welcome.is_resumed
    first.close()
    stranger, second = raw_client(shared_service), raw_client(shared_service)
    answer = stranger.ask(Hello("stranger", "0" * 32))
    assert not answer.is_resumed
    assert answer.session_id != welcome.session_id
    again = second.ask(Hello("raw", welcome.session_key))
    assert (again.is_resumed, again.session_id) == (True, welcome.session_id)
    assert again.profile_id == 7
    result = second.ask(small_frame(1))
    assert (result.type_name, result.colors[0][0, 0, 0]) == ("result", 7)


def test_a_session_ends_when_its_client_stays_away(brief_service, raw_client):
    first, second = raw_client(brief_service), raw_client(brief_service)
    key = first.begin().session_key
    first.close()
    wait_until(lambda: "the client did not reconnect" in brief_service.log)
    assert not second.ask(Hello("late", key)).is_resumed


def test_a_clean_end_is_told(start_service, raw_client):
    service = start_service()
    raw = raw_client(service)
    raw.begin()
    service.process.send_signal(signal.SIGTERM)
    assert raw.receive().type_name == "closing"
    assert service.process.wait(TIMEOUT_S) == 0


# Who waits for whom


def test_the_front_end_answers_while_a_frame_is_filtered(shared_service, raw_client):
    raw, other = raw_client(shared_service), raw_client(shared_service)
    raw.begin(more={"filter_ms": 1000})
    raw.send(encode(small_frame(1)))
    time.sleep(0.1)
    took_ms = []
    for _ in range(50):
        started_s = time.perf_counter()
        pong = other.ask(Ping(1.0))
        took_ms.append(1e3 * (time.perf_counter() - started_s))
        assert pong.is_filtering
    assert np.median(took_ms) < 5.0
    assert other.ask(Hello("other")).type_name == "welcome"


@pytest.mark.parametrize("flood", [pytest.param(False, marks=pytest.mark.slow), True])
def test_clients_share_time_whatever_their_frames_take(shared_service, flood):
    """One has frames twice as wide; the double takes as long for each view."""
    view = make_view()
    with (
        FilterClient(shared_service.endpoint, max_in_flight=2) as slow,
        FilterClient(shared_service.endpoint, max_in_flight=2) as quick,
    ):
        views = {slow: [view] * 2, quick: [view]}
        for client, shown in views.items():
            client.set_profile(EYE | {"filter_ms": 30}, views=shown[:1])
        used_ms = dict.fromkeys(views, 0.0)
        end_s = time.monotonic() + 3.0
        while time.monotonic() < end_s:
            for client, shown in views.items():
                wanted = 8 if flood and client is slow else 2
                if client.n_unanswered < wanted:
                    client.submit(shown, **SEE)
                for event in client.poll():
                    if isinstance(event, FilteredFrame):
                        used_ms[client] += event.stage_times_ms["filter_ms"]
    assert used_ms[slow] == pytest.approx(used_ms[quick], rel=0.15)


def test_a_storm_of_profiles_mixes_no_eyes_and_ends_with_the_newest(shared_service):
    view = make_view()
    with FilterClient(shared_service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE | {"mark": 0, "filter_ms": 5}, views=[view])
        marks = {}
        for mark in range(1, 101):
            accepted = client._link  # the storm does not wait for answers
            request = ProfileRequest(
                1000 + mark,
                EYE | {"mark": mark, "filter_ms": 5},
                views=(view.camera,),
            )
            accepted.profile = request
            accepted.queue_message(encode(request))
            marks[request.profile_id] = mark
            client.submit(view, **SEE)
            for event in client.poll(0.01):
                check_mark(event, marks)
        deadline_s = time.monotonic() + TIMEOUT_S
        newest = None
        while newest != 100 and time.monotonic() < deadline_s:
            client.submit(view, **SEE)
            for event in client.poll(0.05):
                newest = check_mark(event, marks) or newest
        assert newest == 100


def check_mark(event, marks):
    if not isinstance(event, FilteredFrame):
        return None
    mark = int(event.color[0, 0, 0])
    assert mark == marks.get(event.profile_id, 0)
    return mark


# Hostile messages


def test_deep_headers_are_refused_and_nothing_ends(shared_service, raw_client):
    raw = raw_client(shared_service)
    for depth in (33, 512, 975, 1000, 1023):
        raw.send([b"\x91" * depth + b"\x01"])
        assert raw.receive().code == "bad_message"
        raw.send([b"\x81\xa1a" * depth + b"\x01"])
        assert raw.receive().code == "bad_message"
    header = {"type": "profile", "version": 1, "profile_id": 1}
    raw.ask(Hello("deep"))
    for body in (
        b'{"kind":' + b"[" * 900 + b"]" * 900 + b"}",
        b'{"kind":' * 5000,
        b'{"sphere_dpt":' + b"9" * 400 + b"}",
        b'{"sphere_dpt":' + b"9" * 5000 + b"}",
    ):
        raw.send([msgpack.packb(header), body])
        answer = raw.receive()
        assert (answer.code, answer.field.partition(".")[0]) == (
            "bad_message",
            "profile",
        )
    assert "could not be handled" not in shared_service.log


def test_who_sends_too_much_that_is_wrong_is_not_heard_for_a_while(
    shared_service, raw_client
):
    raw, other = raw_client(shared_service), raw_client(shared_service)
    for _ in range(500):
        raw.send([b"\xc1"])
    assert other.ask(Ping(1.0)).t == 1.0
    time.sleep(1.1)
    answers = 0
    while raw.socket.poll(100):
        assert raw.receive().code == "bad_message"
        answers += 1
    assert 100 <= answers < 500
    assert raw.ask(Ping(2.0)).t == 2.0


def test_a_message_of_very_many_parts_is_thrown_away_unread(shared_service, raw_client):
    raw, other = raw_client(shared_service), raw_client(shared_service)
    raw.begin()  # without a session it is cut off
    other.begin()
    count = 200_000
    for _ in range(count):
        raw.socket.send(b"x", zmq.SNDMORE)
    raw.socket.send(b"x")
    started_s = time.monotonic()
    answer = raw.receive()
    assert (answer.code, answer.field) == ("bad_message", "parts")
    assert f"{count} parts" in answer.message
    assert other.ask(small_frame(1)).type_name == "result"
    assert time.monotonic() - started_s < 3.0


def test_unfinished_messages_stay_below_the_ceiling_and_harm_nobody(start_service):
    ceiling_mb = 300
    service = start_service(max_socket_mb=ceiling_mb, max_part_mb=50, max_sessions=32)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        connections, held_mb = [], []
        try:
            for _ in range(15):
                connections.append(half_a_message(service.endpoint, 45_000_000))
                held_mb.append(resident_mb(service.pids()["front-end"]))
                assert filtered_again(client, view)[0].color[0, 0, 0] == 5
        finally:
            for connection in connections:
                connection.close()
        assert 150 < max(held_mb) < ceiling_mb, "libzmq held what it could get"
        assert filtered_again(client, view)[0].color[0, 0, 0] == 5


def resident_mb(pid):
    status = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1e3


def half_a_message(endpoint, size_bytes):
    """Send one part that says that more follow, as a client that has a session."""
    connection = spoken_to(endpoint)
    (hello,) = encode(Hello("half"))
    try:
        connection.sendall(b"\0" + bytes([len(hello)]) + bytes(hello))
        connection.sendall(b"\x03" + struct.pack(">Q", size_bytes))  # long, more
        connection.sendall(bytes(size_bytes))
    except OSError:  # the other side has ended
        pass
    return connection


@pytest.mark.parametrize(
    "transport", [pytest.param(t, marks=pytest.mark.slow) for t in ("tcp", "ipc")]
)
def test_a_client_that_leaves_with_messages_queued_does_no_harm(
    start_service, tmp_path, transport
):
    """libzmq aborts where a heartbeat is due for such a client."""
    bind = "tcp://127.0.0.1:*" if transport == "tcp" else f"ipc://{tmp_path / 's'}"
    service = start_service(filter_ms=1200, bind=bind)
    before = service.pids()
    for _ in range(3):
        leaver = RawClient(service.endpoint)
        leaver.begin()
        for frame_id in range(3):
            leaver.send(encode(small_frame(frame_id)))
        for number in range(25):
            leaver.send(encode(ProfileRequest(10 + number, EYE | {"build_s": 1})))
        leaver.close()
    time.sleep(2.5)
    assert service.pids() == before
    staying = RawClient(service.endpoint)
    try:
        assert staying.ask(Ping(2.0)).t == 2.0
    finally:
        staying.close()


def test_dropped_frames_say_when_to_try_again(shared_service):
    view = make_view()
    with FilterClient(shared_service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE | {"build_s": 5}, views=[view], wait=False)
        client.submit(view, **SEE)
        drops = []
        while not drops:
            drops = [e for e in client.poll(1.0) if isinstance(e, Dropped)]
        assert drops[0].reason == "preparing"
        assert drops[0].retry_after_ms > 0


def test_the_log_has_time_stamps_and_nothing_of_a_profile(shared_service):
    view = make_view()
    with FilterClient(shared_service.endpoint, client_name="lab") as client:
        client.set_profile(EYE | {"mark": 77, "secret": "patient 12"}, views=[view])
        client.filter(view, **SEE)
    lines = shared_service.log.splitlines()
    begins = [line for line in lines if "started ('lab')" in line]
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", begins[0])
    assert "patient" not in shared_service.log
