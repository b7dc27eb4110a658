"""What runs a service for days: counters, signals, the unit."""

import configparser
import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import textwrap
import time
import tomllib
import urllib.request

import pytest

from clients.filter_client import FilterClient
from clients.service_process import ServiceProcess
from filter_service.errors import TooManySessions
from filter_service.service.config import load_config
from filter_service.service.metrics import METRICS
from tests.end_to_end.conftest import (
    QUICK_DOUBLE,
    START_TIMEOUT_S,
    TIMEOUT_S,
    make_view,
)
from tests.source_tree import ROOT

SEE = {"pupil_diameter_mm": 4.0, "focus_dpt": 0.5}
EYE = {"kind": "double", "mark": 5}


@pytest.fixture
def port():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        return unused.getsockname()[1]


def counters(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
        lines = answer.read().decode().splitlines()
    return {
        name: float(value)
        for name, value in (line.split() for line in lines if not line.startswith("#"))
    }


def test_counters_count(use_service, port):
    service = use_service(metrics_port=port)
    view = make_view()
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        client.set_profile(EYE, views=[view])
        for _ in range(3):
            client.filter(view, **SEE)
        found = counters(port)
    assert set(found) == set(METRICS)
    assert found["ocufilter_ready"] == found["ocufilter_sessions"] == 1
    assert found["ocufilter_frames_filtered_total"] == 3
    assert found["ocufilter_filter_seconds_total"] > 0.005
    assert found["ocufilter_memory_bytes"] > 20e6


@pytest.mark.long("a service starts")
def test_a_port_that_is_taken_is_said(start_service, port):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        with pytest.raises(RuntimeError, match=f"metrics_port is {port}"):
            start_service(metrics_port=port)


def test_a_closed_terminal_does_not_end_the_service(shared_service):
    shared_service.process.send_signal(signal.SIGHUP)
    time.sleep(0.3)
    with FilterClient(shared_service.endpoint, timeout_s=TIMEOUT_S) as client:
        assert client.ping()[1].is_ready


@contextlib.contextmanager
def service_that_writes(folder, stdout, stderr):
    """Start a service with the double; return its endpoint once it is ready."""
    ready, config = folder / "ready", folder / "service.toml"
    config.write_text(f'bind = "tcp://127.0.0.1:*"\nready_file = "{ready}"\n')
    command = [*QUICK_DOUBLE, "--config", str(config)]
    outputs = {"stdout": stdout, "stderr": stderr}
    with subprocess.Popen(command, cwd=ROOT, **outputs) as process:
        try:
            end_s = time.monotonic() + START_TIMEOUT_S
            while not ready.exists():
                assert process.poll() is None, "the service ended"
                assert time.monotonic() < end_s
                time.sleep(0.05)
            yield ready.read_text().strip()
            process.terminate()
            assert process.wait(TIMEOUT_S) == 0
        finally:
            process.kill()


@pytest.fixture
def full_pipe():
    """Return the end of a pipe that takes no byte any more."""
    reading, writing = os.pipe2(os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, 65536 * b"x")
    os.set_blocking(writing, True)
    yield writing
    os.close(reading)
    os.close(writing)


def filter_once(endpoint):
    with FilterClient(endpoint, timeout_s=TIMEOUT_S) as client:
        view = make_view()
        client.set_profile(EYE, views=[view])
        client.filter(view, **SEE)


def test_a_log_that_nobody_reads_stops_no_client(tmp_path, full_pipe):
    with service_that_writes(tmp_path, subprocess.DEVNULL, full_pipe) as endpoint:
        for _ in range(3):
            filter_once(endpoint)


def test_an_output_that_nobody_reads_stops_no_start(tmp_path, full_pipe):
    with service_that_writes(tmp_path, full_pipe, subprocess.DEVNULL) as endpoint:
        filter_once(endpoint)


@pytest.mark.parametrize("full", ["stdout", "stderr"])
def test_a_full_disk_behind_its_output_ends_no_service(tmp_path, full):
    """And the other output is as usual."""
    paths = {"stdout": tmp_path / "out", "stderr": tmp_path / "err"}
    paths[full] = "/dev/full"
    with open(paths["stdout"], "w") as out, open(paths["stderr"], "w") as err:
        with service_that_writes(tmp_path, out, err) as endpoint:
            filter_once(endpoint)
    if full == "stdout":
        log = paths["stderr"].read_text()
        assert "stdout cannot be written: No space left on device" in log
    else:
        assert paths["stdout"].read_text() == f"ocufilter: serving on {endpoint}\n"


def hang_up(service, old, new, said):
    """Change the file, send SIGHUP and wait for what the service says to it."""
    file = service.config_file
    file.write_text(file.read_text().replace(old, new))
    service.process.send_signal(signal.SIGHUP)
    end_s = time.monotonic() + TIMEOUT_S
    while said not in service.log:
        assert time.monotonic() < end_s, service.log
        time.sleep(0.05)
    time.sleep(0.1)  # the door has it from the keeper


@pytest.fixture(scope="module")
def reloaded():
    """A service whose settings tests change, and change back."""
    settings = {"max_sessions": 1, "max_width_px": 640, "threads": 1}
    with ServiceProcess(settings, command=QUICK_DOUBLE) as service:
        yield service


def test_limits_change_while_clients_are_served(reloaded):
    service = reloaded
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        view = make_view()
        client.set_profile(EYE, views=[view])
        client.filter(view, **SEE)
        with (
            pytest.raises(TooManySessions),
            FilterClient(service.endpoint, timeout_s=TIMEOUT_S),
        ):
            pass
        hang_up(
            *(service, "max_sessions = 1", "max_sessions = 2"), "max_sessions is now 2"
        )
        with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as other:
            other.ping()
            hang_up(service, "width_px = 640", "width_px = 1280", "px is now 1280")
        with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as other:
            assert other.welcome.limits.max_width_px == 1280
        client.filter(view, **SEE)
    hang_up(service, "max_sessions = 2", "max_sessions = 1", "max_sessions is now 1")
    hang_up(service, "width_px = 1280", "width_px = 640", "px is now 640")


def test_what_cannot_change_is_said_and_a_wrong_file_changes_nothing(reloaded):
    service = reloaded
    hang_up(
        *(service, "threads = 1", "threads = 2"),
        "threads: takes effect after a restart of the service",
    )
    hang_up(
        *(service, "max_sessions = 1", "max_sessions = 1000"),
        "settings are unchanged: max_sessions is 1000; allowed: 1 to 64",
    )
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S) as client:
        assert client.ping()[1].is_ready
    wrong, right = "max_sessions = 1000", "max_sessions = 1"
    text = service.config_file.read_text(encoding="utf-8")
    service.config_file.write_text(text.replace(wrong, right), encoding="utf-8")


@pytest.mark.long("a service starts")
def test_the_log_is_json_for_programs(start_service):
    service = start_service(log_format="json")
    with FilterClient(service.endpoint, timeout_s=TIMEOUT_S, client_name="x") as client:
        client.set_profile(EYE, views=[make_view()])
        client.filter(make_view(), **SEE)
        os.kill(service.pids()["render"], signal.SIGKILL)
        end_s = time.monotonic() + TIMEOUT_S
        while "SIGKILL" not in service.log and time.monotonic() < end_s:
            time.sleep(0.05)
    service.process.send_signal(signal.SIGTERM)
    service.process.wait(TIMEOUT_S)
    first, *lines = service.log.splitlines()
    assert first.startswith("ocufilter: serving on")  # not of the log
    found = [json.loads(line) for line in lines]
    assert {"time", "process", "pid", "level", "message"} <= set(found[0])
    assert {line["process"] for line in found} >= {"front-end", "service"}
    assert any("SIGKILL" in line["message"] for line in found)


def test_the_unit_starts_the_program():
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read(ROOT / "filter_service" / "service" / "ocufilter.service")
    assert " ocufilter serve --config " in unit["Service"]["ExecStart"]
    assert unit["Service"]["Restart"] == "on-failure"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd")
def test_systemd_accepts_the_unit_and_the_account_of_a_lab(tmp_path):
    source = ROOT / "filter_service" / "service" / "ocufilter.service"
    units = tmp_path / "etc" / "systemd" / "system"
    page = (ROOT / "docs" / "how-to" / "lab.md").read_text(encoding="utf-8")
    account = textwrap.dedent(re.search(r"```ini\n(.*?)```", page, re.DOTALL)[1])
    (units / "ocufilter.service.d").mkdir(parents=True)
    shutil.copy(source, units)
    (units / "ocufilter.service.d" / "account.conf").write_text(account)

    def analyze(*arguments):
        return subprocess.run(
            ["systemd-analyze", *arguments],
            capture_output=True,
            text=True,
            timeout=60,
        )

    verified = analyze("verify", str(source))
    assert verified.returncode == 0 and not verified.stderr, verified.stderr
    # Each version of systemd weighs the settings a little differently.
    how = ("security", "--offline=yes", f"--root={tmp_path}", "--threshold=25")
    assert analyze(*how, "ocufilter.service").returncode == 0
    (units / "ocufilter.service.d" / "account.conf").unlink()
    assert analyze(*how, "ocufilter.service").returncode != 0


def test_the_container_holds_what_a_machine_needs():
    """What `make` sets up on a bare machine, the image has; its settings are ours."""
    lines = (ROOT / "Containerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    setup = (ROOT / "setup.sh").read_text(encoding="utf-8")
    for name in ("SYSTEM_PACKAGES", "C_PACKAGES"):
        for package in re.search(rf'^{name}="(.*)"', setup, re.MULTILINE)[1].split():
            assert re.search(rf'[ "]{package}[ "]', lines), package
    copied = set(re.findall(r"^COPY (.*) [\w./]+$", lines, re.MULTILINE))
    assert {"clients", "estimator", "filter_service", "shaders"} <= copied
    settings = re.search(r"printf '(.*)' > service.toml", lines)[1]
    config = tomllib.loads(settings.replace("\\n", "\n"))
    assert load_config(**config).keys_dir == "/keys"
    assert 'ENTRYPOINT ["ocufilter", "serve", "--config"' in lines
    assert "USER ocufilter" in lines
