"""The JavaScript client against the service, with the renderer double and without."""

import json
import os
import re
import shutil
import signal
import subprocess

import pytest

from clients.service_process import CHECKOUT, SERVE_COMMAND
from tests.end_to_end.conftest import TIMEOUT_S
from tests.end_to_end.test_lifecycle import wait_until

FOLDER = CHECKOUT / "clients" / "js"

PROFILE = json.dumps({"kind": "prescription", "sphere_dpt": -2})

needs_node = pytest.mark.skipif(
    shutil.which("node") is None or not (FOLDER / "node_modules").is_dir(),
    reason="Node is not installed: `make test` does it where it may",
)


def checked(service, *profiles, meanwhile=lambda: None):
    """Return what `check.js` prints; something may happen in the middle of it."""
    with subprocess.Popen(
        ["node", "check.js", service.endpoint, *profiles, "--wait"],
        cwd=FOLDER,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as node:
        try:
            assert node.stdout.readline() == "lost\n", node.stderr.read()
            meanwhile()
            printed, said = node.communicate("go on\n", timeout=2 * TIMEOUT_S)
        finally:
            node.kill()
    assert not said
    return json.loads(printed)


@pytest.mark.clients
@needs_node
@pytest.mark.parametrize(
    "name", ["front-end", pytest.param("render", marks=pytest.mark.slow)]
)
def test_frames_eyes_errors_and_a_lost_connection_from_javascript(start_service, name):
    service = start_service()
    profiles = [json.dumps({"kind": "double", "mark": mark}) for mark in (5, 7, 8)]

    def kill():
        pid = service.pids()[name]
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: service.pids().get(name, pid) != pid)

    found = checked(service, *profiles, meanwhile=kill)
    pixels = 32 * 18 * 3
    assert found["mono"] == [1, pixels, 5, 245]
    assert found["stereo"] == [235, 225]
    pose = [0.25, 1.5, -3, 0, 0.5, 0, 0.5]
    assert found["eyes"] == [
        ["left", 7, 4, 0.5, [0, 0], pose],
        ["right", 8, 5, 1, [1, -2], None],
    ]
    assert found["time"] == 123
    assert found["eyesAgain"] == [7, 8]
    assert found["twoPupils"] == ["bad_message", "views[1].pupil_diameter_mm"]
    assert found["linear"] == 0.75
    assert found["pupil"] == ["bad_message", "pupil_diameter_mm"]
    assert found["profile"] == ["profile_invalid", "kind"]
    assert found["again"] == [found["session"], 245]
    assert found["pong"] == 1


@pytest.fixture
def native_service(use_service):
    return use_service(command=SERVE_COMMAND, engine="native")


@pytest.mark.clients
@needs_node
def test_the_check_passes_with_profiles_that_the_service_knows(native_service):
    """As a user runs it: at a terminal, where nobody enters a line."""
    ours, theirs = os.openpty()
    try:
        finished = subprocess.run(
            ["node", "check.js", native_service.endpoint, PROFILE],
            cwd=FOLDER,
            stdin=theirs,
            capture_output=True,
            text=True,
            timeout=3 * TIMEOUT_S,
        )
    finally:
        os.close(ours)
        os.close(theirs)
    assert finished.returncode == 0, finished.stderr
    found = json.loads(finished.stdout)
    assert found["profile"] == ["profile_invalid", "kind"]
    assert found["again"][0] == found["session"]


@pytest.mark.clients
@needs_node
@pytest.mark.parametrize(
    ("page", "printed"),
    [
        (FOLDER / "README.md", "320x180, pupil 4 mm"),
        (CHECKOUT / "docs" / "how-to" / "choose.md", "43200\n"),
    ],
    ids=lambda value: getattr(value, "stem", ""),
)
def test_the_example_of_a_page_runs(native_service, tmp_path, page, printed):
    text = page.read_text(encoding="utf-8")
    (example,) = re.findall(r"```js\n(.*?)```", text, re.DOTALL)
    client = (FOLDER / "filter_client.js").as_uri()
    example = example.replace("./filter_client.js", client)
    file = tmp_path / "example.mjs"
    file.write_text(
        example.replace("tcp://127.0.0.1:5577", native_service.endpoint),
        encoding="utf-8",
    )
    finished = subprocess.run(
        ["node", file],
        cwd=FOLDER,
        capture_output=True,
        text=True,
        timeout=3 * TIMEOUT_S,
    )
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith(printed)
