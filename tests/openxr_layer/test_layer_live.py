"""Frames that are filtered while the program goes on, and helpers that come and go."""

import functools
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from tests.end_to_end.layer_double import RunningHelper
from tests.openxr_layer.captured import NUMBER_PX, STRIPE_PX, pixels_of
from tests.openxr_layer.layered import (
    Inverting,
    frozen_look,
    inverting_eyes,
    layer_lines,
)
from tests.openxr_layer.test_layer import Stage, check_clean, floats, kind_of

RATE_HZ = 60
N_FRAMES = 180
AGE_S = 0.15
LIVE = {"MOCK_XR_RATE_HZ": str(RATE_HZ)}
NS_PER_S = 1e9


@pytest.fixture
def stage(layer, runtime, driver, tmp_path):
    return Stage(layer, runtime, driver, tmp_path)


@pytest.fixture
def moving_head(tmp_path):
    """Return a script of a head that is nowhere twice."""
    lines = []
    for i in range(2 * N_FRAMES):
        turn = 0.002 * i
        lines.append(f"{0.01 * i} 0 0 0 {np.sin(turn)} 0 {np.cos(turn)}")
    path = tmp_path / "head.txt"
    path.write_text("\n".join(lines))
    return str(path)


def live_helper(stage, takes_s, **options):
    make_eyes = functools.partial(inverting_eyes, takes_s=takes_s)
    return RunningHelper(stage.path, make_eyes, **options)


def number_in(pixels):
    """Return the number of a drawn frame, and whether it is inverted."""
    rows, columns = NUMBER_PX
    cells = pixels[rows // 2, STRIPE_PX // 2 : columns : STRIPE_PX, :3].astype(int)
    # Cells are green or black, inverted magenta or white.
    is_filtered = bool((cells[:, 0] > 127).all())
    green = cells[:, 1] < 127 if is_filtered else cells[:, 1] > 127
    return int(sum(1 << i for i, bit in enumerate(green) if bit)), is_filtered


def shown_frames(ran):
    """Return (number, shown number, is filtered) of each frame.

    Checks that each picture is one of the driver's, with the pose of its frame.
    """
    told = {line["frame"]: line for line in ran.told if "frame" in line}
    found = []
    for line, frame in ran.pairs():
        own = set()
        for eye, view in enumerate(frame["layers"][0]["views"]):
            pixels = pixels_of(ran.folder, view)
            number, is_filtered = number_in(pixels)
            kind = "filtered" if is_filtered else "own"
            assert kind_of(view, pixels, number, eye) == kind
            expected = floats(told[number]["views"][eye])
            assert view["pose"] + view["fov"] == expected
            own.add((number, is_filtered))
        assert len(own) == 1  # both eyes are of one frame
        found.append((line["frame"], *own.pop()))
    return found


@pytest.mark.parametrize("reads", ["direct", "buffered"])
def test_pictures_go_with_their_poses(stage, moving_head, reads):
    variables = LIVE | {"MOCK_XR_HEAD": moving_head, "OCUFILTER_LAYER_READS": reads}
    with live_helper(stage, 0.03):
        ran = stage.run("plain", n_frames=N_FRAMES, **variables)
    check_clean(ran, N_FRAMES)
    frames = shown_frames(ran)
    first = next(i for i, (_, _, is_filtered) in enumerate(frames) if is_filtered)
    assert first < N_FRAMES / 2
    later = frames[first:]
    # A hiccup of this machine may make a result too old.
    assert np.mean([is_filtered for _, _, is_filtered in later]) > 0.9
    for number, shown, is_filtered in later:
        age_s = (number - shown) / RATE_HZ
        assert 0 <= age_s <= AGE_S + 2 / RATE_HZ
        assert is_filtered or shown == number
    numbers = [shown for _, shown, is_filtered in later if is_filtered]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) > 20


def test_results_that_are_too_old_are_not_shown(stage):
    with live_helper(stage, 0.4) as helper:
        ran = stage.run("plain", n_frames=N_FRAMES, **LIVE)
    check_clean(ran, N_FRAMES)
    assert all(not is_filtered for _, _, is_filtered in shown_frames(ran))
    assert not any("takes" in line for line in helper.lines)  # less than ten of them


@pytest.mark.parametrize("reads", ["direct", "buffered"])
def test_the_helper_gets_every_frame_that_it_can_filter(stage, reads):
    variables = LIVE | {"OCUFILTER_LAYER_READS": reads}
    with live_helper(stage, 0.0):
        ran = stage.run("plain", n_frames=N_FRAMES, **variables)
    check_clean(ran, N_FRAMES)
    later = shown_frames(ran)[N_FRAMES // 3 :]
    filtered = {shown for _, shown, is_filtered in later if is_filtered}
    assert len(filtered) > 0.8 * len(later)  # half of them, if it idled between frames


FLOOD = """
import os, socket, sys
from clients.openxr_layer import wire
listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
listener.bind(sys.argv[1])
listener.listen()
print("listening", flush=True)
connection, _ = listener.accept()
connection.recv(1000)
connection.send(bytes(wire.Welcome(wire.WELCOME, wire.MAGIC, wire.VERSION, 0, 150)))
result = bytes(wire.Result(wire.RESULT, 1, 2**63))
os.fork()
while True:
    connection.send(result)
"""


def test_a_helper_that_floods_the_program(stage):
    flood = subprocess.Popen(
        [sys.executable, "-c", FLOOD, str(stage.path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert flood.stdout.readline() == "listening\n"
        ran = stage.run("plain", n_frames=60, **LIVE)
    finally:
        flood.kill()
        flood.wait()
        flood.stdout.close()
    check_clean(ran, 60)
    assert not any(is_filtered for _, _, is_filtered in shown_frames(ran))


def test_an_older_result_is_shown_if_that_is_allowed(stage):
    with live_helper(stage, 0.3, max_age_ms=2000):
        ran = stage.run("plain", n_frames=N_FRAMES, **LIVE)
    check_clean(ran, N_FRAMES)
    frames = shown_frames(ran)
    assert np.mean([is_filtered for _, _, is_filtered in frames[60:]]) > 0.9


def test_results_from_before_recentering_are_not_shown(stage):
    with live_helper(stage, 0.05):
        ran = stage.run("plain", n_frames=N_FRAMES, MOCK_XR_RECENTER_AT="100", **LIVE)
    check_clean(ran, N_FRAMES)
    frames = shown_frames(ran)
    assert any(is_filtered for number, _, is_filtered in frames if number < 100)
    for number, shown, is_filtered in frames:
        # The runtime counts a frame more, the first one, which is not drawn.
        assert not (is_filtered and shown < 100 <= number)
    assert any(is_filtered for _, _, is_filtered in frames[-40:])


def test_a_space_that_is_destroyed_while_its_frame_is_filtered(stage, moving_head):
    with live_helper(stage, 0.05):
        ran = stage.run(
            "space-destroyed", n_frames=N_FRAMES, MOCK_XR_HEAD=moving_head, **LIVE
        )
    check_clean(ran, N_FRAMES)
    assert any(is_filtered for _, _, is_filtered in shown_frames(ran)[-60:])


HELPER = """
import sys
from pathlib import Path
from clients.openxr_layer.helper import LayerOptions, LayerHelper
from tests.openxr_layer.layered import (
    Inverting,
    frozen_look,
    inverting_eyes,
    layer_lines,
)
seeing, look = inverting_eyes(print)
helper = LayerHelper(seeing, look, print, LayerOptions(), print, Path(sys.argv[1]))
print("listening", flush=True)
while True:
    helper.run_once(0.1)
"""


class HelperProcess:
    """A helper in a process of its own, which can be stopped and killed."""

    def __init__(self, path):
        self.process = subprocess.Popen(
            [sys.executable, "-c", HELPER, str(path)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout.readline() == "listening\n"

    def signal(self, number):
        self.process.send_signal(number)

    def end(self):
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()


def wait_for_frames(stage, n_frames):
    """Wait until so many frames were shown."""
    path = stage.folder / "captured" / "frames.jsonl"
    end_s = time.monotonic() + 60.0
    while time.monotonic() < end_s:
        if path.exists() and path.read_text().count("\n") >= n_frames:
            return
        time.sleep(0.005)
    raise AssertionError("the program does not go on")


def in_background(stage, results, **variables):
    """Run the driver in a thread; its result is added to a list."""
    environment = {**LIVE, **variables}
    thread = threading.Thread(
        target=lambda: results.append(
            stage.run("plain", n_frames=6 * RATE_HZ, **environment)
        )
    )
    thread.start()
    return thread


def test_a_helper_that_starts_late_is_killed_and_comes_back(stage):
    results = []
    program = in_background(stage, results)
    wait_for_frames(stage, RATE_HZ)
    helper = HelperProcess(stage.path)
    wait_for_frames(stage, 3 * RATE_HZ)
    killed_after = stage_frames(stage)
    helper.end()
    wait_for_frames(stage, 4 * RATE_HZ)
    again = HelperProcess(stage.path)
    program.join()
    again.end()
    (ran,) = results
    check_clean(ran, 6 * RATE_HZ)
    frames = shown_frames(ran)
    assert not any(is_filtered for _, _, is_filtered in frames[:RATE_HZ])
    assert any(is_filtered for _, _, is_filtered in frames[:killed_after])
    # Own frames within one frame: the one that was being shown when it was killed.
    between = frames[killed_after + 2 : 4 * RATE_HZ]
    assert not any(is_filtered for _, _, is_filtered in between)
    assert any(is_filtered for _, _, is_filtered in frames[-30:])
    assert layer_lines(ran).count("connected to the helper") == 2
    ended = "the helper has ended; showing the application's own frames"
    assert layer_lines(ran).count(ended) == 1


class Unready(Inverting):
    """Filter whose eyes are not ready for the first frames."""

    n_unready = 10

    def see(self, frame):
        self.n_unready -= 1
        return super().see(frame) if self.n_unready < 0 else None


def test_counts_are_of_one_helper(stage):
    """Frames before its eyes are ready do not count as unfiltered."""
    results, options = [], {"max_age_ms": 2000}
    program = in_background(stage, results)
    with live_helper(stage, 0.0, **options):
        wait_for_frames(stage, 2 * RATE_HZ)
    again = RunningHelper(stage.path, lambda _: (Unready(), frozen_look()), **options)
    with again:
        program.join()
    (ran,) = results
    check_clean(ran, 6 * RATE_HZ)
    report = again.helper.report()
    assert report["not_filtered"] == Unready.n_unready
    assert report["shown_filtered"] > 0
    assert report["fallback"] == 0


def stage_frames(stage):
    return (stage.folder / "captured" / "frames.jsonl").read_text().count("\n")


def test_a_helper_that_hangs(stage):
    results = []
    helper = HelperProcess(stage.path)
    program = in_background(stage, results)
    wait_for_frames(stage, 2 * RATE_HZ)
    stopped_after = stage_frames(stage)
    helper.signal(signal.SIGSTOP)
    wait_for_frames(stage, 4 * RATE_HZ)
    helper.signal(signal.SIGCONT)
    program.join()
    helper.end()
    (ran,) = results
    check_clean(ran, 6 * RATE_HZ)
    frames = shown_frames(ran)
    n_shown = round(AGE_S * RATE_HZ) + 3
    hung = frames[stopped_after + n_shown : 4 * RATE_HZ]
    assert not any(is_filtered for _, _, is_filtered in hung)
    assert any(is_filtered for _, _, is_filtered in frames[-30:])


def test_a_helper_of_another_user_gets_no_frames(stage):
    if os.getuid() != 0:
        pytest.skip("it requires root to be another user")
    path = stage.folder / "layer.sock"
    code = "import os; os.setgid(65534); os.setuid(65534);" + HELPER
    stage.folder.chmod(0o777)
    for parent in stage.folder.parents:
        parent.chmod(parent.stat().st_mode | 0o005)
    helper = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert helper.stdout.readline() == "listening\n"
        ran = stage.run("plain", n_frames=60, **LIVE)
    finally:
        helper.kill()
        helper.wait()
        helper.stdout.close()
    check_clean(ran, 60)
    assert not any(is_filtered for _, _, is_filtered in shown_frames(ran))
