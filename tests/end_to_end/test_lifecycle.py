"""Clients and services that come and go, stop, and misbehave."""

import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from clients.filter_client import FilterClient, FilteredFrame
from clients.service_process import CHECKOUT, ServiceProcess
from filter_service.errors import ServiceTimeout
from filter_service.messages import Dropped, Ping
from tests.end_to_end.conftest import TIMEOUT_S, make_view, small_frame

pytestmark = pytest.mark.clock

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}


def wait_until(is_so, limit_s=TIMEOUT_S):
    end_s = time.monotonic() + limit_s
    while not is_so():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.02)


def children_of(pid):
    """Return the processes that a process has started (Linux)."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return {
        int(child)
        for task in tasks
        for child in (task / "children").read_text().split()
    }


def is_running(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_service_cleanly(start_service, number):
    service = start_service()
    ready_file = service._ready_file
    with FilterClient(service.endpoint) as client:
        client.set_profile(EYE | {"build_s": 30}, views=[make_view()], wait=False)
        children = children_of(service.process.pid)
        assert children
        started_s = time.monotonic()
        service.process.send_signal(number)
        assert service.process.wait(TIMEOUT_S) == 0
    assert time.monotonic() - started_s < 3.0
    assert not ready_file.exists()
    wait_until(lambda: not any(is_running(pid) for pid in children))


def test_the_worker_ends_with_a_service_that_is_killed(start_service):
    service = start_service()
    with FilterClient(service.endpoint) as client:
        client.set_profile(EYE | {"build_s": 30}, views=[make_view()], wait=False)
        children = children_of(service.process.pid)
        service.process.kill()
        service.process.wait()
    wait_until(lambda: not any(is_running(pid) for pid in children))


def test_a_client_recovers_when_the_service_is_killed_and_started_again(start_service):
    service = start_service()
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        first = client.filter(view, **SEE)
        service.process.kill()
        service.process.wait()
        again = start_service(bind=service.endpoint)
        assert again.endpoint == service.endpoint
        started_s = time.monotonic()
        reply = client.filter(view, **SEE)
        # The profile was sent again by itself; its PSFs had to be built again.
        assert (reply.color == first.color).all()
        assert time.monotonic() - started_s < 3.0
        assert again.log.count("session 1 started") == 1


@pytest.mark.parametrize("call", ["set_profile", "filter", "ping"])
def test_a_reply_that_is_lost_with_the_connection_is_not_waited_for(
    start_service, call
):
    service = start_service()
    view = make_view()
    building = EYE | {"build_s": 1.0}
    with (
        FilterClient(service.endpoint, timeout_s=2 * TIMEOUT_S) as client,
        FilterClient(service.endpoint) as other,
        ThreadPoolExecutor(1) as thread,
    ):
        pid = service.pids()["front-end"]
        if call == "ping":
            os.kill(pid, signal.SIGSTOP)
            found = thread.submit(client.ping)
            time.sleep(0.2)
        elif call == "set_profile":
            found = thread.submit(client.set_profile, building, views=[view])
        else:
            client.set_profile(building)  # without a camera to prepare for
            found = thread.submit(client.filter, view, **SEE)
        if call != "ping":
            wait_until(lambda: other.ping()[1].is_building)
            os.kill(pid, signal.SIGSTOP)
            time.sleep(1.5)  # the eye becomes ready
        os.kill(pid, signal.SIGKILL)
        assert found.result(TIMEOUT_S)


def test_frames_on_their_way_to_a_killed_service_are_reported_as_lost(start_service):
    service = start_service(filter_ms=5000)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        frame_id = client.submit(view, **SEE)
        time.sleep(0.1)
        service.process.kill()
        events = client.poll(TIMEOUT_S)
        assert [(e.frame_id, e.reason) for e in events] == [
            (frame_id, "connection_lost")
        ]
        with pytest.raises(ServiceTimeout, match="connection lost"):
            client.ping(timeout_s=0.3)


@pytest.mark.parametrize(
    ("transport", "in_flight"), [("messages", 1), ("shared memory", 2)]
)
def test_every_frame_of_a_stream_is_reported_while_the_service_is_upgraded(
    start_service, transport, in_flight
):
    service = start_service(filter_ms=20)
    view = make_view()
    with FilterClient(
        service.endpoint,
        timeout_s=TIMEOUT_S,
        max_in_flight=in_flight,
        shared_memory=transport == "shared memory",
    ) as client:
        client.set_profile(EYE, views=[view])
        submitted, events = [], []

        def stream(is_over):
            end_s = time.monotonic() + TIMEOUT_S
            while not is_over():
                assert time.monotonic() < end_s
                submitted.append(client.submit(view, **SEE))
                events.extend(client.poll(0.005))

        stream(lambda: sum(isinstance(e, FilteredFrame) for e in events) > 5)
        service.process.send_signal(signal.SIGTERM)
        stream(lambda: service.process.poll() is not None)
        n_before = len(submitted)
        stream(lambda: len(submitted) > n_before + 20)
        start_service(filter_ms=20, bind=service.endpoint)
        first = len(events)
        stream(lambda: sum(isinstance(e, FilteredFrame) for e in events[first:]) > 5)
        while client.n_unanswered:
            events.extend(client.poll(TIMEOUT_S))
        answers = [e for e in events if getattr(e, "frame_id", None) is not None]
        assert sorted(e.frame_id for e in answers) == submitted
        reasons = {e.reason for e in answers if isinstance(e, Dropped)}
        assert reasons <= {"superseded", "connection_lost", "preparing"}
        lost = [e for e in answers if getattr(e, "reason", "") == "connection_lost"]
        assert 1 <= len(lost) <= in_flight + 1  # with memory, also the queued frame
        assert answers[-1].color[0, 0, 0] == 5  # the profile was sent again


@pytest.mark.parametrize("name", ["supervisor", "front-end", "render"])
def test_a_service_that_is_stopped_for_a_moment_is_used_again(shared_service, name):
    service = shared_service
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        pid = service.pids()[name]
        os.kill(pid, signal.SIGSTOP)
        try:
            if name == "supervisor":  # nobody needs it as long as all is well
                assert client.filter(view, **SEE).color[0, 0, 0] == 5
            else:
                with pytest.raises(ServiceTimeout, match="reply to frame 0"):
                    client.filter(view, **SEE, timeout_s=0.5)
        finally:
            os.kill(pid, signal.SIGCONT)
        assert client.filter(view, **SEE).color[0, 0, 0] == 5
        assert service.pids()[name] == pid


def test_a_client_that_is_killed_leaves_no_session(brief_service):
    service = brief_service
    program = (
        "import sys, time\n"
        "from clients.filter_client import FilterClient\n"
        "client = FilterClient(sys.argv[1])\n"
        "client.hello()\n"
        "print('connected', flush=True)\n"
        "time.sleep(60)\n"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", program, service.endpoint],
        stdout=subprocess.PIPE,
        cwd=CHECKOUT,
    )
    with other, FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        assert other.stdout.readline() == b"connected\n"
        assert client.ping()[1].n_sessions == 2
        other.kill()
        wait_until(lambda: client.ping()[1].n_sessions == 1)
        # It might have come back, but not for ever.
        wait_until(lambda: "ended: the client did not reconnect" in service.log)


@pytest.mark.slow
def test_a_client_that_does_not_read_for_long_keeps_its_session(start_service):
    """With a mark of 64 messages an idle client was gone after 64 signs of life."""
    service = start_service(alive_interval_s=0.05, session_keep_s=0.0)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        session_id = client.hello().session_id
        time.sleep(12.0)  # 240 of them
        assert client.filter(view, **SEE).color[0, 0, 0] == 5
        assert client.hello().session_id == session_id
    assert "disconnected" not in service.log


def test_two_clients_get_their_own_eye_and_a_fair_share(shared_service):
    view = make_view()
    with (
        FilterClient(shared_service.endpoint, max_in_flight=2) as first,
        FilterClient(shared_service.endpoint, max_in_flight=1) as second,
    ):
        clients = {7: first, 8: second}
        for mark, client in clients.items():
            client.set_profile(EYE | {"mark": mark, "filter_ms": 10}, views=[view])
        counts = dict.fromkeys(clients, 0)
        end_s = time.monotonic() + 1.5
        while time.monotonic() < end_s:
            for mark, client in clients.items():
                if client.n_unanswered < 3:
                    client.submit(view, **SEE)
                for event in client.poll():
                    if hasattr(event, "color"):
                        assert event.color[0, 0, 0] == mark
                        counts[mark] += 1
    assert sum(counts.values()) > 40
    assert min(counts.values()) > 0.6 * max(counts.values()), counts


def test_bytes_that_are_no_zmq_and_idle_connections_do_no_harm(client, shared_service):
    host, port = shared_service.endpoint.removeprefix("tcp://").split(":")
    connections = []
    try:
        for i in range(60):
            connection = socket.create_connection((host, int(port)), TIMEOUT_S)
            connections.append(connection)
            if i % 2:
                connection.sendall(bytes(range(256)) * 4)
        assert client.ping()[0] < 1000 * TIMEOUT_S
    finally:
        for connection in connections:
            connection.close()


def test_nobody_there_is_said_with_the_way_out():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        endpoint = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
        client = FilterClient(endpoint, timeout_s=0.3)
        with pytest.raises(ServiceTimeout) as caught:
            client.hello()
        client.close()
    text = str(caught.value)
    assert "not connected yet" in text
    assert f"ocufilter serve --bind {endpoint}" in text


def test_an_endpoint_in_use_is_said(shared_service):
    with pytest.raises(RuntimeError, match="ended with code 1"):
        ServiceProcess(
            {"bind": shared_service.endpoint},
            command=(sys.executable, "-m", "tests.end_to_end.double_service"),
            start_timeout_s=TIMEOUT_S,
        )


def test_an_ipc_path_that_is_no_socket_is_left_alone(start_service, tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("mine")
    with pytest.raises(RuntimeError, match="is not a socket"):
        start_service(bind=f"ipc://{precious}")
    assert precious.read_text() == "mine"


def test_an_ipc_endpoint_serves_its_owner_only_and_is_not_taken(
    start_service, raw_client, tmp_path
):
    path = tmp_path / "ocufilter"
    service = start_service(bind=f"ipc://{path}")
    assert path.stat().st_mode & 0o777 == 0o600
    raw = raw_client(service)
    assert raw.begin().transports == ("ipc", "shm")
    with pytest.raises(RuntimeError, match="another service"):
        start_service(bind=f"ipc://{path}")
    assert raw.ask(small_frame(1)).type_name == "result"
    assert raw.ask(Ping(1.0)).t == 1.0
    assert service.stop(TIMEOUT_S) == 0
    assert not path.exists()
