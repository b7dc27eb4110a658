"""Where an eye tracker sees the eyes look, from OpenXR to what the command says.

Monado simulates no eye tracker; `gaze_layer` stands before it and has one.  Started by
`run_in_root.sh`, like test_runtime.py.
"""

import json
from itertools import islice

import numpy as np
import pytest

from tests.headset.monado import RemoteHead
from tests.headset.program import Program
from tests.headset.rooms import stripes
from tests.headset.test_runtime import HEADS

SOON = 40
"""Frames after which a program has seen what a script says."""

ERROR_DEG, ERROR_S = 1e-4, 2e-9
DIRECTIONS_DEG = ((0.0, 0.0), (10.0, 0.0), (0.0, 10.0), (-25.0, 12.5), (7.0, -20.0))
LOSSES = ("not active", "not valid", "not tracked")
TRACKED, LOST = "eyes are tracked", "the eye tracker lost the eyes"
VALIDATION = "XR_APILAYER_LUNARG_core_validation"


@pytest.fixture
def script(tmp_path):
    """Return the file of what the tracker tells."""
    path = tmp_path / "gaze.json"
    tell(path)
    return path


def tell(script, h_deg=0.0, v_deg=0.0, *, age_ns=0, has="eyes"):
    """Let the tracker tell this from now on, a `gaze_layer.Script`."""
    told = {"h_deg": h_deg, "v_deg": v_deg, "age_ns": age_ns, "has": has}
    new = script.with_suffix(".new")
    new.write_text(json.dumps(told), encoding="utf-8")
    new.replace(script)  # at once, so that nobody reads half of it


def session(monado, folder, script) -> Program:
    """Return a session that tells of each frame, the validation layer before it."""
    environment = monado.environment | {"XR_ENABLE_API_LAYERS": VALIDATION}
    return Program(folder, environment, "-m", "tests.headset.gaze_layer", str(script))


def frames_of(program):
    return (line for line in program.lines() if "now_s" in line)


def is_gaze(frame, h_deg, v_deg, age_s=0.0):
    """Return whether a frame's gaze is that, of a sample so old."""
    gaze = frame["gaze"]
    return (
        gaze is not None
        and abs(gaze["h_deg"] - h_deg) < ERROR_DEG
        and abs(gaze["v_deg"] - v_deg) < ERROR_DEG
        and abs(frame["now_s"] - age_s - gaze["at_s"]) < ERROR_S
    )


def assert_soon(frames, is_wanted):
    """Wait for a frame; those that come next must be alike."""
    assert any(is_wanted(frame) for frame in islice(frames, SOON))
    assert all(is_wanted(frame) for frame in islice(frames, 3))


def test_gaze_is_where_the_tracker_sees_it(started, tmp_path, script):
    with session(started(), tmp_path, script) as program:
        frames = frames_of(program)
        for h_deg, v_deg in DIRECTIONS_DEG:
            tell(script, h_deg, v_deg)
            assert_soon(frames, lambda frame: is_gaze(frame, h_deg, v_deg))  # noqa: B023
        complaints = program.complaints()
    assert complaints == []


def test_gaze_has_the_time_of_its_sample(started, tmp_path, script):
    with session(started(), tmp_path, script) as program:
        frames = frames_of(program)
        tell(script, 3.0, 4.0, age_ns=12_345_678)
        assert_soon(frames, lambda frame: is_gaze(frame, 3.0, 4.0, 0.012345678))
        tell(script, 3.0, 4.0, age_ns=None)  # unknown: as if it were of now
        assert_soon(frames, lambda frame: is_gaze(frame, 3.0, 4.0))


def test_gaze_is_that_of_the_head_wherever_it_is_turned(started, tmp_path, script):
    monado = started(remote=True)
    tell(script, 10.0, -5.0)
    with RemoteHead() as remote, session(monado, tmp_path, script) as program:
        frames = frames_of(program)
        for head in HEADS:
            remote.move(head)
            turned = head.orientation
            assert_soon(
                frames,
                lambda frame: (
                    is_gaze(frame, 10.0, -5.0) and is_turned(frame, turned)  # noqa: B023
                ),
            )


def is_turned(frame, orientation):
    """Return whether the head is turned so; q and -q are the same turn."""
    return abs(np.dot(frame["head"][3:], orientation)) > 1.0 - 1e-6


@pytest.mark.parametrize("loss", LOSSES)
def test_eyes_that_are_lost_have_no_gaze(started, tmp_path, script, loss):
    with session(started(), tmp_path, script) as program:
        frames = frames_of(program)
        for h_deg in (5.0, -5.0):
            tell(script, h_deg, has="eyes")
            assert_soon(frames, lambda frame: is_gaze(frame, h_deg, 0.0))  # noqa: B023
            tell(script, h_deg, has=loss)
            assert_soon(frames, lambda frame: frame["gaze"] is None)


def test_the_command_tells_of_the_tracker(started, tmp_path, script):
    room = stripes(tmp_path / "room.glb")
    command = (
        *("-m", "tests.headset.gaze_layer", str(script)),
        *("tests.headset.watched_viewer", "--scene", str(room), "--frames", "100000"),
        *("--profile", "emmetropia", "--gaze-range", "5,5", "--scale", "0.3"),
        *("--settings", '{"tolerance": "loose", "object_range_dpt": [0, 1]}'),
    )
    tell(script, 2.0, 1.0)
    with Program(tmp_path, started().environment, *command) as program:
        frames = (line for line in program.lines() if "frame" in line)
        assert await_words(frames, program, TRACKED)
        said = program.said
        assert "no eye tracker" not in said
        assert LOST not in said
        tell(script, has="not tracked")
        assert await_words(frames, program, LOST)
        tell(script, 2.0, 1.0)
        assert await_words(frames, program, TRACKED, times=2)


def await_words(frames, program, words, times=1):
    """Return whether a program says something within some frames."""
    return any(program.said.count(words) == times for _ in islice(frames, 5 * SOON))
