"""Several devices behind one socket: who is where, and who notices a fault of whom."""

import os
import signal
import time

import pytest

from clients.filter_client import FilterClient, FilteredFrame
from filter_service.errors import FilterError
from filter_service.messages import Hello, Ping, Share, encode
from filter_service.service.status_query import query_status
from tests.end_to_end.conftest import TIMEOUT_S, make_view, small_frame
from tests.end_to_end.test_lifecycle import wait_until

pytestmark = pytest.mark.clock

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}
TWO = ["native:1", "native:1"]


def connected(service):
    return FilterClient(service.endpoint, timeout_s=TIMEOUT_S)


def devices_of(service):
    return query_status(service.endpoint)["devices"]


def sessions_on(service):
    return [device["n_sessions"] for device in devices_of(service)]


def test_one_device_is_what_it_was(shared_service, client):
    (device,) = devices_of(shared_service)
    assert device["name"] == "auto"
    assert device["renderer"] == client.hello().server["renderer"]
    assert device["n_sessions"] >= 1
    assert set(shared_service.pids()) == {"supervisor", "front-end", "render"}


def test_sessions_spread_and_fill_the_place_that_becomes_free(
    start_service, raw_client
):
    service = start_service(devices=TWO)
    assert set(service.pids()) == {"supervisor", "front-end", "render 0", "render 1"}
    raws, seen = [], []
    for _ in range(4):
        raws.append(raw_client(service))
        raws[-1].ask(Hello("raw"))
        seen.append(sessions_on(service))
    assert seen == [[1, 0], [1, 1], [2, 1], [2, 2]]
    with connected(service) as fifth:
        fifth.hello()
        assert sessions_on(service) == [3, 2]
    wait_until(lambda: sessions_on(service) == [2, 2])


def test_of_as_many_sessions_the_device_that_had_less_to_do_is_taken(
    start_service, raw_client
):
    service = start_service(devices=TWO, filter_ms=50)
    first, second = raw_client(service), raw_client(service)
    first.begin(mark=1)
    second.ask(Hello("idle"))
    for frame_id in range(10):
        assert first.ask(small_frame(frame_id)).type_name == "result"
    busy = [device["busy_ratio"] for device in devices_of(service)]
    assert busy[0] > 0.02
    assert busy[1] == 0.0
    raw_client(service).ask(Hello("new"))
    assert sessions_on(service) == [1, 2]


def test_each_eye_is_on_its_device_and_all_frames_are_counted(use_service, raw_client):
    service = use_service(devices=TWO)
    n_before = [device["n_rendered"] for device in devices_of(service)]
    raws = [raw_client(service) for _ in range(4)]
    for mark, raw in enumerate(raws, start=1):
        raw.begin(mark=mark)
    for frame_id in range(3):
        for mark, raw in enumerate(raws, start=1):
            answer = raw.ask(small_frame(frame_id))
            assert (answer.frame_id, answer.colors[0][0, 0, 0]) == (frame_id, mark)
    pong = raws[0].ask(Ping(1.0))
    n_rendered = [device.n_rendered for device in pong.devices]
    assert [now - n for now, n in zip(n_rendered, n_before, strict=True)] == [6, 6]
    assert pong.n_rendered == sum(n_rendered)
    assert (pong.n_sessions, pong.is_ready) == (4, True)


def test_devices_filter_side_by_side(use_service, raw_client):
    service = use_service(devices=TWO)
    first, second = raw_client(service), raw_client(service)
    first.begin(mark=1, more={"filter_ms": 800})
    second.begin(mark=2, more={"filter_ms": 800})
    for frame_id, raw in enumerate((first, second)):
        raw.send(encode(small_frame(frame_id)))
    wait_until(lambda: all(d["is_filtering"] for d in devices_of(service)))
    assert [raw.receive().frame_id for raw in (first, second)] == [0, 1]


class Stream:
    """A client that keeps one frame on its way, and notes what becomes of each."""

    def __init__(self, service, mark):
        self.client = connected(service)
        self.view = make_view()
        self.client.set_profile(EYE | {"mark": mark}, views=[self.view])
        self.session_id = self.client.hello().session_id
        self.mark = mark
        self.n_sent = self.n_seen = 0
        self.others = []

    def turn(self):
        if self.client.n_unanswered == 0:
            try:
                self.client.submit(self.view, **SEE)
                self.n_sent += 1
            except FilterError as error:
                self.others.append(error)
        for event in self.client.poll(0.005):
            if isinstance(event, FilteredFrame):
                assert event.color[0, 0, 0] == self.mark
                self.n_seen += 1
            elif getattr(event, "frame_id", None) is not None:
                self.others.append(event)

    def end(self):
        while self.client.n_unanswered:
            self.turn_end()

    def turn_end(self):
        for event in self.client.poll(0.05):
            self.n_seen += isinstance(event, FilteredFrame)


def run_for(seconds, *streams):
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        for stream in streams:
            stream.turn()


@pytest.mark.parametrize("killed", ["render 0", "render 1"])
def test_who_is_on_another_device_never_notices(start_service, killed):
    service = start_service(devices=TWO, filter_ms=10)
    streams = [Stream(service, mark) for mark in (3, 4)]
    index = int(killed[-1])
    struck, other = streams[index], streams[1 - index]
    before = service.pids()
    run_for(0.5, *streams)
    os.kill(before[killed], signal.SIGKILL)
    n_before = struck.n_seen
    end_s = time.monotonic() + TIMEOUT_S
    while struck.n_seen < n_before + 10 and time.monotonic() < end_s:
        run_for(0.1, *streams)
    assert struck.n_seen >= n_before + 10, "its frames come again, with its eye"
    other.end()
    assert (other.others, other.n_seen) == ([], other.n_sent)
    for stream in streams:
        assert stream.client.hello().session_id == stream.session_id
        stream.client.close()
    after = service.pids()
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {killed}
    assert f"the {killed} process was killed by SIGKILL" in service.log


def test_what_hangs_is_ended_alone(start_service, raw_client):
    service = start_service(devices=TWO, frame_limit_s=1.0)
    first, second = raw_client(service), raw_client(service)
    first.begin(mark=3)
    second.begin(mark=4)
    before = service.pids()
    os.kill(before["render 1"], signal.SIGSTOP)
    wait_until(lambda: "has not responded for 1 s" in service.log)
    wait_until(lambda: service.pids().get("render 1") not in (None, before["render 1"]))
    assert first.ask(small_frame(1)).colors[0][0, 0, 0] == 3
    assert service.pids()["render 0"] == before["render 0"]


def test_a_new_front_end_finds_each_session_on_its_device(start_service, raw_client):
    service = start_service(devices=TWO)
    raws = [raw_client(service) for _ in range(3)]
    welcomes = [raw.begin(mark=mark) for mark, raw in enumerate(raws)]
    before = service.pids()
    os.kill(before["front-end"], signal.SIGKILL)
    wait_until(
        lambda: service.pids().get("front-end") not in (None, before["front-end"])
    )
    for mark, (raw, welcome) in enumerate(zip(raws, welcomes, strict=True)):
        raw.close()
        raws[mark] = raw = raw_client(service)
        again = raw.ask(Hello("again", welcome.session_key))
        assert (again.is_resumed, again.session_id) == (True, welcome.session_id)
        assert raw.ask(small_frame(1)).colors[0][0, 0, 0] == mark
    assert sessions_on(service) == [2, 1]
    assert raw_client(service).ask(Hello("new")).session_id not in {
        welcome.session_id for welcome in welcomes
    }
    assert sessions_on(service) == [2, 2]


def test_a_session_begins_where_it_can_be_served(start_service, raw_client):
    """While a device is being started, new sessions go to the other."""
    service = start_service(devices=TWO)
    raws = [raw_client(service) for _ in range(3)]
    raws[1].begin(mark=1)  # on device 0
    os.kill(service.pids()["render 1"], signal.SIGSTOP)
    os.kill(service.pids()["render 1"], signal.SIGKILL)
    wait_until(lambda: not devices_of(service)[1]["is_ready"])
    raws[0].begin(mark=7)
    assert sessions_on(service) == [2, 0]
    wait_until(lambda: devices_of(service)[1]["is_ready"])
    raws[2].begin(mark=8)
    assert sessions_on(service) == [2, 1]


def test_none_uses_up_the_memory_of_another(start_service, raw_client):
    service = start_service(devices=TWO, max_image_mb=20)
    first, second = raw_client(service), raw_client(service)
    first.ask(Hello("greedy"))
    second.ask(Hello("modest"))
    assert first.ask(Share(2_000_000)).path
    refused = first.ask(Share(2_000_000))
    assert not refused.path
    assert "allowed: 2500000 in total" in refused.reason
    assert second.ask(Share(2_000_000)).path


def test_a_device_that_does_not_come_again_is_given_up(
    start_service, raw_client, monkeypatch, tmp_path
):
    gone = tmp_path / "gone"
    monkeypatch.setenv("OCUFILTER_TEST_GONE_FILE", str(gone))
    service = start_service(devices=["native:1", "native:2"])
    first, second = Stream(service, 3), Stream(service, 4)
    gone.touch()
    os.kill(service.pids()["render 1"], signal.SIGKILL)
    wait_until(lambda: "the render 1 process is disabled" in service.log)
    assert "no such device" in service.log
    for _ in range(100):
        first.turn()
    first.end()
    assert (first.others, first.n_seen) == ([], first.n_sent)
    # The other's session is over, and its client begins anew by itself.
    end_s = time.monotonic() + TIMEOUT_S
    while second.n_seen == 0 and time.monotonic() < end_s:
        second.turn()
    assert second.n_seen > 0
    assert [device["is_lost"] for device in devices_of(service)] == [False, True]
    assert sessions_on(service) == [2, 0]
    assert query_status(service.endpoint)["is_ready"]
    for stream in (first, second):
        stream.client.close()
    # A new door is told of it.
    os.kill(service.pids()["front-end"], signal.SIGKILL)
    fresh = raw_client(service)
    fresh.begin(mark=9)
    assert fresh.ask(small_frame(1)).colors[0][0, 0, 0] == 9
    # And it is used again once it can be started.
    gone.unlink()
    wait_until(lambda: "the render 1 process is running again" in service.log, 20.0)
    wait_until(lambda: [d["is_lost"] for d in devices_of(service)] == [False, False])
    other = raw_client(service)
    other.begin(mark=8)
    assert other.ask(small_frame(1)).colors[0][0, 0, 0] == 8
    assert sessions_on(service) == [1, 1]


def test_a_device_that_never_comes_ends_the_start(start_service, monkeypatch, tmp_path):
    (tmp_path / "gone").touch()
    monkeypatch.setenv("OCUFILTER_TEST_GONE_FILE", str(tmp_path / "gone"))
    with pytest.raises(RuntimeError, match="no such device"):
        start_service(devices=["native:1", "native:2"])


@pytest.mark.slow
def test_each_device_has_one_that_stands_by(start_service, monkeypatch):
    monkeypatch.setenv("OCUFILTER_TEST_STANDBY_AFTER_S", "0.5")
    service = start_service(devices=TWO, standby=True)
    wait_until(lambda: {"standby 0", "standby 1"} <= set(service.pids()))
    time.sleep(1.0)  # until they are ready
    before = service.pids()
    os.kill(before["render 1"], signal.SIGKILL)
    wait_until(lambda: "the standby process takes over" in service.log)
    after = service.pids()
    assert after["render 1"] == before["standby 1"]
    assert after["render 0"] == before["render 0"]
