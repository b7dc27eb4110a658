"""The JavaScript client against the service with the renderer double."""

import json
import os
import shutil
import signal
import subprocess

import pytest

from clients.service_process import CHECKOUT
from tests.end_to_end.conftest import TIMEOUT_S
from tests.end_to_end.test_lifecycle import wait_until

FOLDER = CHECKOUT / "clients" / "js"

needs_node = pytest.mark.skipif(
    shutil.which("node") is None or not (FOLDER / "node_modules").is_dir(),
    reason="Node is not installed: `make test` does it where it may",
)


@needs_node
@pytest.mark.parametrize(
    "name", ["door", pytest.param("render", marks=pytest.mark.slow)]
)
def test_frames_eyes_errors_and_a_lost_connection_from_javascript(start_service, name):
    service = start_service()
    profile = json.dumps({"kind": "double", "mark": 5})
    with subprocess.Popen(
        ["node", "check.js", service.endpoint, profile],
        cwd=FOLDER,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as node:
        try:
            assert node.stdout.readline() == "lost\n", node.stderr.read()
            pid = service.pids()[name]
            os.kill(pid, signal.SIGKILL)
            wait_until(lambda: service.pids().get(name, pid) != pid)
            printed, said = node.communicate("go on\n", timeout=2 * TIMEOUT_S)
        finally:
            node.kill()
    assert not said
    found = json.loads(printed)
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
