"""What hostile peers tried: the service goes on, and nobody sees another's eye."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zmq

from clients.filter_client import FilterClient
from clients.service_process import CHECKOUT, ServiceProcess
from filter_service.errors import FilterError
from filter_service.keys import KeyRing, load_client_key
from filter_service.messages import Hello, Ping, encode
from filter_service.service.router import SEED_VARIABLE
from tests.attacks import spoken_to
from tests.end_to_end.conftest import (
    DOUBLE,
    TIMEOUT_S,
    make_view,
    small_frame,
)
from tests.end_to_end.test_lifecycle import wait_until

pytestmark = pytest.mark.clock

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}
ATTACK = (sys.executable, "-m", "tests.attacks")


def limited(n_files):
    """The service with a soft and hard limit of open files."""
    script = f'ulimit -Sn {n_files}; ulimit -Hn {n_files}; exec "$@"'
    return ("sh", "-c", script, "sh", *DOUBLE, "--filter-ms", "2")


@pytest.fixture
def ring(tmp_path):
    ring = KeyRing(tmp_path / "keys")
    ring.create()
    ring.add("lab", tmp_path / "lab.toml")
    ring.add("other", tmp_path / "other.toml")
    return ring


def cpu_s(pid):
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


# Connections


@pytest.mark.parametrize(
    ("attack_name", "n_files", "has_keys"),
    [
        ("one_byte", 256, True),
        pytest.param("one_byte", 1024, False, marks=pytest.mark.slow),
        ("bare", 160, False),
    ],
)
def test_connections_without_a_session_keep_nobody_out(
    ring, tmp_path, attack_name, n_files, has_keys
):
    settings = {"keys_dir": str(ring.folder)} if has_keys else {}
    key_file = tmp_path / "lab.toml" if has_keys else None
    view = make_view()
    with (
        ServiceProcess(settings, command=limited(n_files)) as service,
        FilterClient(service.endpoint, key_file=key_file) as streaming,
    ):
        streaming.set_profile(EYE, views=[view])
        before = service.pids()
        attack = subprocess.Popen(
            [*ATTACK, attack_name, service.endpoint, "3"],
            cwd=CHECKOUT,
            stdout=subprocess.PIPE,
            text=True,
        )
        n_newcomers = 0
        while attack.poll() is None:
            for _ in range(20):
                assert streaming.filter(view, **SEE).color[0, 0, 0] == 5
            with FilterClient(service.endpoint, key_file=key_file) as newcomer:
                newcomer.hello(timeout_s=5.0)
                newcomer.set_profile(EYE | {"mark": 6}, views=[view])
                assert newcomer.filter(view, **SEE).color[0, 0, 0] == 6
                n_newcomers += 1
        assert n_newcomers > 3
        counts, _ = attack.communicate()
        assert json.loads(counts)["opened"] >= 1500
        assert service.pids() == before
        if attack_name == "one_byte":  # the others never got out of the kernel
            assert "closed the oldest without a session" in service.log
        time.sleep(0.3)
        begin_s = cpu_s(before["front-end"])
        time.sleep(0.6)
        assert cpu_s(before["front-end"]) - begin_s < 0.06, (
            "idle, it takes a tenth at most"
        )


def test_a_connection_without_a_session_cannot_fill_the_memory(shared_service):
    with (
        spoken_to(shared_service.endpoint) as connection,
        pytest.raises(ConnectionError),
    ):
        while True:  # parts of a message without an end
            connection.sendall(b"\x03" + (10**5).to_bytes(8, "big") + bytes(10**5))
            time.sleep(0.01)
    assert "bytes and no message" in shared_service.log


# Routing ids


@pytest.fixture
def named(raw_client):
    """Connect DEALERs with a routing id of their own choice."""

    def connect(service, name, key_file=None):
        options = {"identity": name}
        if key_file is not None:
            key = load_client_key(key_file)
            options |= {
                "curve_serverkey": key.server.encode(),
                "curve_publickey": key.pair.public.encode(),
                "curve_secretkey": key.pair.secret.encode(),
            }
        return raw_client(service, **options)

    return connect


def test_a_routing_id_opens_no_session(shared_service, named):
    service = shared_service
    victim = named(service, b"camera")
    welcome = victim.begin(mark=7)
    victim.socket.close(linger=0)  # without a word
    wait_until(lambda: "client disconnected" in service.log)
    thief = named(service, b"camera")
    refused = thief.ask(small_frame(1))
    assert (refused.code, refused.frame_id) == ("no_session", 1)
    own = thief.ask(Hello("thief"))
    assert not own.is_resumed
    assert own.session_key != welcome.session_key
    assert own.session_id != welcome.session_id
    assert thief.ask(small_frame(2)).code == "no_profile"
    again = named(service, b"camera two")
    assert again.ask(Hello("camera", welcome.session_key)).is_resumed
    assert again.ask(small_frame(3)).colors[0][0, 0, 0] == 7


def test_replies_on_their_way_do_not_reach_who_takes_the_routing_id(
    shared_service, named
):
    for attempt in range(5):
        name = b"camera %d" % attempt
        victim = named(shared_service, name)
        key = victim.begin(mark=7, more={"filter_ms": 60}).session_key
        victim.send(encode(small_frame(1)))
        time.sleep(0.02)
        victim.socket.close(linger=0)
        thief = named(shared_service, name)
        thief.socket.rcvtimeo = 300
        received = []
        while True:
            try:
                thief.send(encode(Ping(1.0)))
                received.append(thief.receive().type_name)
                time.sleep(0.005)
            except zmq.Again:
                break
            if len(received) > 30:
                break
        assert set(received) <= {"pong"}
        again = named(shared_service, b"again %d" % attempt)
        assert again.ask(Hello("camera", key)).is_resumed


def test_a_session_key_is_worth_nothing_with_another_client_s_key(
    start_service, ring, named, tmp_path
):
    service = start_service(keys_dir=str(ring.folder))
    victim = named(service, b"one", tmp_path / "lab.toml")
    key = victim.begin(mark=7).session_key
    victim.socket.close(linger=0)
    wait_until(lambda: "client disconnected" in service.log)
    thief = named(service, b"one", tmp_path / "other.toml")
    assert not thief.ask(Hello("thief", key)).is_resumed
    assert thief.ask(small_frame(1)).code == "no_profile"
    again = named(service, b"two", tmp_path / "lab.toml")
    assert again.ask(Hello("lab", key)).is_resumed


def test_ids_of_each_process_begin_elsewhere(start_service):
    """The first ones of a process without a seed are known to everybody."""
    service = start_service()
    before = service.pids()
    attack = subprocess.run(
        [*ATTACK, "chosen_ids", service.endpoint, "1"],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(attack.stdout)["welcome"] > 10
    assert service.pids() == before


def test_an_assertion_of_libzmq_costs_a_second_and_no_session(
    start_service, monkeypatch
):
    monkeypatch.setenv(SEED_VARIABLE, "1")
    service = start_service()
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        session_id = client.hello().session_id
        before = service.pids()
        attack = subprocess.Popen(
            [*ATTACK, "chosen_ids", service.endpoint, "2"],
            cwd=CHECKOUT,
            stdout=subprocess.DEVNULL,
        )
        wait_until(
            lambda: (
                service.pids().get("front-end", before["front-end"])
                != before["front-end"]
            )
        )
        attack.kill()
        attack.wait()
        begin_s, seen = time.monotonic(), None
        while seen is None:
            assert time.monotonic() - begin_s < 3.0
            try:
                seen = client.filter(view, **SEE, timeout_s=1.0)
            except FilterError:
                time.sleep(0.01)
        assert seen.color[0, 0, 0] == 5
        assert client.hello().session_id == session_id
    assert "was killed by SIGABRT" in service.log


# Keys


BAD_KEY_FILES = {
    "empty": lambda path: path.write_bytes(b""),
    "binary": lambda path: path.write_bytes(bytes(range(256))),
    "malformed": lambda path: path.write_text("public = 'short"),
    "short": lambda path: path.write_text("public = 'short'"),
    "number": lambda path: path.write_text("public = 7"),
    "deep": lambda path: path.write_text("public = " + "[" * 2000),
    "huge": lambda path: path.write_bytes(b"#" * 10_000_000),
    "dangling": lambda path: path.symlink_to("nowhere"),
    "folder": lambda path: path.mkdir(),
    "fifo": lambda path: os.mkfifo(path),
}


def test_bad_key_files_are_skipped_and_named_once(start_service, ring, tmp_path):
    service = start_service(keys_dir=str(ring.folder))
    view = make_view()
    with FilterClient(service.endpoint, key_file=tmp_path / "lab.toml") as client:
        client.set_profile(EYE, views=[view])
        before = service.pids()
        for name, make in BAD_KEY_FILES.items():
            make(ring.folder / "clients" / f"{name}.toml")
            assert client.filter(view, **SEE).color[0, 0, 0] == 5
        end_s = time.monotonic() + 1.5
        n_changes = 0
        while time.monotonic() < end_s:  # and its own commands do no harm
            ring.add("brief", tmp_path / "brief.toml")
            ring.remove("brief")
            (tmp_path / "brief.toml").unlink()
            n_changes += 1
            client.filter(view, **SEE)
        assert n_changes > 30
        assert service.pids() == before
    for name in BAD_KEY_FILES:
        assert service.log.count(f"{name}.toml") == 1, name


def test_rights_and_a_pair_that_does_not_fit_are_told(ring, tmp_path):
    def refusal():
        with pytest.raises(ValueError) as caught:
            ring.check()
        return str(caught.value)

    server = ring.folder / "server.toml"
    ring.folder.chmod(0o777)
    assert "has mode 0777: other users can change it; expected 0700" in refusal()
    with pytest.raises(RuntimeError, match="other users can change it; expected 0700"):
        ServiceProcess({"keys_dir": str(ring.folder)}, command=DOUBLE)
    ring.folder.chmod(0o700)
    server.chmod(0o644)
    assert "has mode 0644: other users can read it; expected 0600" in refusal()
    server.chmod(0o600)
    other = KeyRing(tmp_path / "elsewhere").create()
    server.write_text(
        server.read_text().replace(f"public = '{ring.server.public}'", "")
        + f"public = '{other.public}'\n"
    )
    assert "'public' does not belong to 'secret'" in refusal()


# Work


def test_floods_do_not_stop_a_stream(start_service):
    service = start_service(max_sessions=16)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        before = service.pids()
        for name in ("profiles", "pings", "unread", "parts"):
            attack = subprocess.Popen(
                [*ATTACK, name, service.endpoint, "1.2"],
                cwd=CHECKOUT,
                stdout=subprocess.DEVNULL,
            )
            longest_s, count = 0.0, 0
            while attack.poll() is None:
                begin_s = time.monotonic()
                assert client.filter(view, **SEE).color[0, 0, 0] == 5
                longest_s = max(longest_s, time.monotonic() - begin_s)
                count += 1
            assert count > 50, name
            assert longest_s < 2.0, name
        assert service.pids() == before


def test_a_flooding_connection_is_ignored_and_then_closed(start_service, raw_client):
    service = start_service()
    raw, other = raw_client(service, sndhwm=0, rcvhwm=0), raw_client(service)
    raw.begin()
    parts = [bytes(part) for part in encode(Ping(1.0))]
    for _ in range(1000):
        raw.socket.send_multipart(parts)
    wait_until(lambda: ": too many messages" in service.log)
    assert other.ask(Ping(2.0)).t == 2.0


# The owner's files, and faults


def test_the_ready_file_follows_no_link(tmp_path):
    ready, other = tmp_path / "ready", tmp_path / "diary"
    other.write_text("mine")
    for name in ("ready.unfinished", ".ready.unfinished", "ready"):
        (tmp_path / name).symlink_to(other)
    config = tmp_path / "service.toml"
    config.write_text(f'bind = "tcp://127.0.0.1:*"\nready_file = "{ready}"\n')
    process = subprocess.Popen(
        [*DOUBLE, "--config", str(config)], cwd=CHECKOUT, stdout=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: ready.is_file() and not ready.is_symlink())
        assert other.read_text() == "mine"
    finally:
        process.terminate()
        assert process.wait(TIMEOUT_S) == 0
    assert not ready.exists()


def test_a_session_survives_one_process_after_the_other(start_service):
    service = start_service()
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        welcome = client.hello()
        before = service.pids()
        os.kill(before["render"], signal.SIGSTOP)  # its successor knows nothing yet
        os.kill(before["render"], signal.SIGKILL)
        os.kill(before["front-end"], signal.SIGKILL)
        wait_until(lambda: service.log.count("was killed by SIGKILL") == 2)
        seen = None
        while seen is None:
            try:
                seen = client.filter(view, **SEE)
            except FilterError:
                time.sleep(0.02)
        assert seen.color[0, 0, 0] == 5
        assert client.hello().session_id == welcome.session_id
        assert "session 2 started" not in service.log


def ended_again(service, name, count):
    for _ in range(count):
        wait_until(lambda: name in service.pids())
        os.kill(pid := service.pids()[name], signal.SIGKILL)
        wait_until(lambda pid=pid: service.pids().get(name) != pid)


def test_a_process_that_never_stays_does_not_end_the_service(start_service, raw_client):
    service = start_service()
    ready_file = service.config_file.parent / "ready"
    raw = raw_client(service)
    ended_again(service, "render", 3)
    wait_until(lambda: "starting a new one in 1 s" in service.log)
    wait_until(lambda: not ready_file.exists())
    pong = raw.ask(Ping(1.0))
    assert (pong.is_ready, pong.is_degraded) == (False, True)
    wait_until(lambda: "render" in service.pids())
    front_end = service.pids()["front-end"]
    os.kill(front_end, signal.SIGSTOP)  # it does not know yet that frames may come
    time.sleep(1.5)  # the other process takes less to be ready
    was_early = ready_file.exists()
    os.kill(front_end, signal.SIGCONT)
    assert not was_early
    wait_until(ready_file.exists)
    pong = raw.ask(Ping(2.0))
    assert (pong.is_ready, pong.is_degraded) == (True, False)
    assert service.process.poll() is None


def test_a_service_gives_up_where_its_owner_says_so(start_service):
    service = start_service(give_up_after_s=0.5)
    front_end = service.pids()["front-end"]
    os.kill(front_end, signal.SIGKILL)
    wait_until(lambda: service.pids().get("front-end", front_end) != front_end)
    time.sleep(0.5)
    os.kill(service.pids()["front-end"], signal.SIGKILL)
    assert service.process.wait(TIMEOUT_S) == 1
    assert "(give_up_after_s is 0.5)" in service.log
