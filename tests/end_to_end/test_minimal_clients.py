"""Clients written from PROTOCOL.md alone, while the service restarts."""

import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from clients.service_process import CHECKOUT
from tests.end_to_end.conftest import TIMEOUT_S
from tests.end_to_end.test_lifecycle import wait_until

pytestmark = pytest.mark.clock

PROFILE = json.dumps({"kind": "double", "mark": 5})
SIZES_PX = ((160, 90), (320, 180), (640, 360))
N_RESTARTS = 5
ANSWER_LIMIT_S = 5.0
JS_FOLDER = CHECKOUT / "clients" / "js"
FILES = Path(__file__).parent

COMMANDS = [
    pytest.param((sys.executable, FILES / "minimal_client.py"), id="python"),
    pytest.param(
        ("node", FILES / "minimal_client.js"),
        id="javascript",
        marks=pytest.mark.skipif(
            shutil.which("node") is None or not (JS_FOLDER / "node_modules").is_dir(),
            reason="Node is not installed: `make test` does it where it may",
        ),
    ),
]


class MinimalClient:
    """A client in a process of its own, and the times of its filtered frames."""

    def __init__(self, command, endpoint, size_px):
        self.size_px = size_px
        arguments = [endpoint, *map(str, size_px), PROFILE]
        self.process = subprocess.Popen(
            [*command, *arguments], cwd=JS_FOLDER, stdout=subprocess.PIPE, text=True
        )
        self._filtered_s = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self):
        for _ in self.process.stdout:
            self._filtered_s.put(time.monotonic())

    def close(self):
        self.process.kill()
        self.process.wait()
        self._reader.join()
        self.process.stdout.close()

    def answered_after_s(self, since_s):
        """Return the time from a moment to the next filtered frame."""
        filtered_s = -1.0
        while filtered_s < since_s:
            assert self.process.poll() is None, f"{self.size_px}: it has ended"
            filtered_s = self._filtered_s.get(timeout=2 * TIMEOUT_S)
        return filtered_s - since_s


@pytest.fixture
def start_client():
    clients = []

    def start(*arguments):
        clients.append(MinimalClient(*arguments))
        return clients[-1]

    yield start
    for client in clients:
        client.close()


@pytest.mark.parametrize("command", COMMANDS)
def test_frames_are_answered_again_after_every_restart(
    start_service, start_client, command
):
    service = start_service()
    endpoint = service.endpoint
    clients = [start_client(command, endpoint, size_px) for size_px in SIZES_PX]
    waits_s = {}

    def measure(what, since_s):
        for client in clients:
            wait_s = client.answered_after_s(since_s)
            waits_s[what, client.size_px] = round(wait_s, 2)

    measure("start", time.monotonic())
    for n in range(N_RESTARTS):
        pid = service.pids()["front-end"]
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda s=service, p=pid: s.pids().get("front-end", p) != p)
        measure(f"front end {n}", time.monotonic())
        service.process.kill()
        service.process.wait()
        service = start_service(bind=endpoint)
        measure(f"service {n}", time.monotonic())
    del waits_s["start", SIZES_PX[0]]  # the process started as well
    assert max(waits_s.values()) < ANSWER_LIMIT_S
