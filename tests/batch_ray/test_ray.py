"""`ocufilter batch --ray`: two workers of a cluster make the bytes of one process."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from PIL import Image

from tests.source_tree import ROOT

pytest.importorskip("ray")

COUNT, SIZE_PX = 48, (96, 64)
MODE = ("--settings", '{"mode": "on-axis", "eye_model": "wavefront"}')
TIMEOUT_S = 300


def run(room, out, *arguments):
    command = [sys.executable, "-m", "ocufilter", "batch", room, "-o", out]
    command += ["-p", "myopia", "-p", "cataract", "--fov-deg", 20, *MODE, *arguments]
    finished = subprocess.run(
        [*map(str, command), "--json"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert finished.returncode == 0, finished.stderr
    return json.loads(finished.stdout)


def pictures(out):
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in out.glob("*/*.png")}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    rng = np.random.default_rng(6)
    width_px, height_px = SIZE_PX
    for part in ("color", "depth"):
        (folder / part).mkdir()
    for number in range(COUNT):
        color = rng.integers(0, 256, (height_px, width_px, 3), dtype=np.uint8)
        depth_mm = rng.integers(400, 3000, (height_px, width_px)).astype(np.uint16)
        Image.fromarray(color).save(folder / f"color/{number:03d}.png")
        Image.fromarray(depth_mm).save(folder / f"depth/{number:03d}.png")
    return folder


@pytest.fixture(scope="module")
def usual(room, tmp_path_factory):
    out = tmp_path_factory.mktemp("usual") / "out"
    run(room, out, "--workers", 1)
    return pictures(out)


def test_two_workers_of_ray_make_the_bytes_of_one_process(room, usual, tmp_path):
    summary = run(room, tmp_path / "out", "--ray", "local", "--workers", 2)
    assert summary["frames_done"] == {"myopia": COUNT, "cataract": COUNT}
    assert pictures(tmp_path / "out") == usual
    assert len(usual) == 2 * COUNT


def ray_workers():
    found = []
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/cmdline", "rb") as file:
                if file.read().startswith(b"ray::_RayWorker"):
                    found.append(int(name))
        except OSError:
            continue
    return found


def test_a_worker_of_ray_that_is_killed_is_replaced(room, usual, tmp_path):
    killed = []

    def kill_one():
        while not killed:
            if len(list(tmp_path.glob("out/*/*.png"))) > 4:
                killed.extend(ray_workers()[:1])
                for worker in killed:
                    os.kill(worker, signal.SIGKILL)
            time.sleep(0.02)

    thread = threading.Thread(target=kill_one, daemon=True)
    thread.start()
    run(room, tmp_path / "out", "--ray", "local", "--workers", 2)
    thread.join(5.0)
    assert killed
    assert pictures(tmp_path / "out") == usual
