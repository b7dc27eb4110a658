"""Who may connect: allowed, unknown, wrong service, none, and taken out at run time."""

import json
import stat

import pytest

from clients.filter_client import FilterClient
from clients.service_process import ServiceProcess
from filter_service.errors import AuthenticationFailed, FilterError
from filter_service.keys import KeyRing, load_client_key
from tests.commands import run_command as ocufilter
from tests.end_to_end.conftest import QUICK_DOUBLE, TIMEOUT_S, make_view

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}


@pytest.fixture
def ring(tmp_path):
    ring = KeyRing(tmp_path / "keys")
    ring.create()
    return ring


@pytest.fixture(scope="module")
def keyed(tmp_path_factory):
    """A service that asks for keys, and the keys, to which each test adds its own."""
    ring = KeyRing(tmp_path_factory.mktemp("keyed") / "keys")
    ring.create()
    service = ServiceProcess(
        {"bind": "tcp://0.0.0.0:*", "keys_dir": str(ring.folder)},
        command=QUICK_DOUBLE,
        start_timeout_s=TIMEOUT_S,
    )
    yield ring, service, service.endpoint.replace("0.0.0.0", "127.0.0.1")
    assert service.stop(TIMEOUT_S) == 0
    service.kill()  # removes its folder


def filtered(client):
    view = make_view()
    client.set_profile(EYE, views=[view])
    return client.filter(view, **SEE)


def test_files_are_their_owners_alone(ring, tmp_path):
    file = tmp_path / "lab.toml"
    key = ring.add("lab", file)
    assert stat.S_IMODE(ring.folder.stat().st_mode) == 0o700
    for path in (file, ring.folder / "server.toml", ring.folder / "clients/lab.toml"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_client_key(file) == key
    kept = (ring.folder / "clients/lab.toml").read_text()
    assert key.pair.public in kept
    assert key.pair.secret not in kept
    assert ring.create() == ring.server, "the service keeps its key"


def test_names_and_files_that_are_wrong_are_said(ring, tmp_path):
    ring.add("lab", tmp_path / "lab.toml")
    for name in ("", "../lab", "a/b", ".hidden", "x" * 65):
        with pytest.raises(ValueError, match="allowed"):
            ring.add(name, tmp_path / "other.toml")
    with pytest.raises(ValueError, match="already"):
        ring.add("lab", tmp_path / "again.toml")
    with pytest.raises(FileExistsError):
        ring.add("other", tmp_path / "lab.toml")
    assert ring.names() == ["lab"]
    with pytest.raises(ValueError, match="existing clients: lab"):
        ring.remove("nobody")
    bad = tmp_path / "bad.toml"
    bad.write_text("public = 'short'")
    with pytest.raises(ValueError, match="'public' is not a key"):
        load_client_key(bad)


def test_a_client_with_a_key_is_served_over_any_interface(keyed, tmp_path):
    ring, _, endpoint = keyed
    ring.add("lab", tmp_path / "lab.toml")
    with FilterClient(
        endpoint, key_file=tmp_path / "lab.toml", timeout_s=TIMEOUT_S
    ) as client:
        assert client.hello().transports == ("tcp",)
        assert filtered(client).color[0, 0, 0] == 5


def test_who_has_no_key_is_told_so_at_once(keyed, tmp_path):
    ring, service, endpoint = keyed
    stranger, elsewhere = KeyRing(tmp_path / "a"), KeyRing(tmp_path / "b")
    stranger.create()
    (stranger.folder / "server.toml").write_text(
        (ring.folder / "server.toml").read_text()
    )
    stranger.add("stranger", tmp_path / "unknown.toml")
    elsewhere.add("lab", tmp_path / "wrong server.toml")
    for file in ("unknown.toml", "wrong server.toml", None):
        key_file = None if file is None else tmp_path / file
        client = FilterClient(endpoint, key_file=key_file)
        try:
            with pytest.raises(AuthenticationFailed, match="ocufilter keys add"):
                client.hello(timeout_s=TIMEOUT_S)
        finally:
            client.close()
    assert "its key is not allowed" in service.log


def test_the_latency_command_needs_a_key_and_no_shared_memory(keyed, tmp_path):
    ring, _, endpoint = keyed
    ring.add("timed", tmp_path / "timed.toml")
    elsewhere = KeyRing(tmp_path / "b")
    elsewhere.create()
    elsewhere.add("timed", tmp_path / "wrong.toml")
    for key in ((), ("--key", tmp_path / "wrong.toml")):
        refused = ocufilter("latency", endpoint, *key, "--timeout", TIMEOUT_S)
        assert refused.returncode == 1
        assert "ocufilter keys add" in refused.stderr
        assert refused.stderr.count("\n") == 1
    options = ("--key", tmp_path / "timed.toml", "--transport", "shared-memory")
    refused = ocufilter("latency", endpoint, *options)
    assert refused.returncode == 2
    assert "allowed: tcp, auto" in refused.stderr
    assert refused.stderr.count("\n") == 1


def test_keys_may_be_given_and_taken_while_the_service_runs(keyed, tmp_path):
    ring, _, endpoint = keyed
    for name in ("early", "late"):
        ring.add(name, tmp_path / f"{name}.toml")
    with (
        FilterClient(endpoint, key_file=tmp_path / "early.toml") as early,
        FilterClient(endpoint, key_file=tmp_path / "late.toml") as late,
    ):
        filtered(early)
        filtered(late)
        ring.remove("early")
        with pytest.raises(FilterError, match="the key was removed"):
            early.filter(make_view(), **SEE)
        assert late.filter(make_view(), **SEE).color[0, 0, 0] == 5
    again = FilterClient(endpoint, key_file=tmp_path / "early.toml")
    with pytest.raises(AuthenticationFailed):
        again.hello(timeout_s=TIMEOUT_S)
    again.close()


@pytest.mark.long("a service starts, and six commands run")
def test_keys_and_status_from_the_command_line(start_service, tmp_path):
    folder, file = str(tmp_path / "keys"), str(tmp_path / "lab.toml")
    added = ocufilter("keys", "add", "lab", "--dir", folder, "--out", file)
    assert added.returncode == 0
    assert folder in added.stderr + added.stdout
    listed = ocufilter("keys", "list", "--dir", folder, "--json")
    assert json.loads(listed.stdout) == {"names": ["lab"]}
    assert ocufilter("keys", "remove", "me", "--dir", folder).returncode == 2
    service = start_service(keys_dir=folder)
    asked = ocufilter("status", service.endpoint, "--key", file, "--json")
    found = json.loads(asked.stdout)
    assert found["is_ready"]
    assert found["n_sessions"] == 0
    assert "is ready" in ocufilter("status", service.endpoint, "--key", file).stdout
    silent = ocufilter("status", service.endpoint, "--timeout", "0.5")
    assert silent.returncode == 1
    assert "no reply" in silent.stderr
