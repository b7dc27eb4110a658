"""Compiling ahead: side by side, ended with whoever asked, and failures are said."""

import io
import subprocess
import sys
import time

import pytest

from filter_service.building.helper_process import HelperProcess, start_module
from filter_service.errors import BuildFailed
from filter_service.filtering import compile_loops as loops
from filter_service.progress import Progress

SLEEP_UNTIL_PARENT_ENDS = """
import time
from filter_service.building.helper_process import end_with_parent
end_with_parent()
time.sleep(60)
"""


def _python(script):
    return subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE)


def _compile(monkeypatch, scripts, n_cores=2):
    """Run `compile_loops` with a script for each part; the lines that it says."""
    stream = io.StringIO()
    monkeypatch.setattr(loops, "PARTS", {name: name for name in scripts})
    monkeypatch.setattr(loops, "thread_count", lambda: n_cores)
    monkeypatch.setattr(loops, "start_module", lambda _, part: _python(scripts[part]))
    with Progress(stream=stream) as progress:
        loops.compile_loops(progress)
    return stream.getvalue()


def test_parts_are_compiled_side_by_side(monkeypatch, tmp_path):
    meet = """
import pathlib, sys, time
folder, own, other = pathlib.Path({folder!r}), {own!r}, {other!r}
(folder / own).touch()
end_s = time.monotonic() + 30
while not (folder / other).exists():
    assert time.monotonic() < end_s, "the other has not started"
    time.sleep(0.02)
"""
    scripts = {
        own: meet.format(folder=str(tmp_path), own=own, other=other)
        for own, other in (("a", "b"), ("b", "a"))
    }
    assert "2/2 parts" in _compile(monkeypatch, scripts)


def test_a_part_that_fails_ends_the_others(monkeypatch):
    started_s = time.monotonic()
    scripts = {"eyes": "raise SystemExit(3)", "frames": "import time; time.sleep(60)"}
    with pytest.raises(BuildFailed, match="eyes"):
        _compile(monkeypatch, scripts)
    assert time.monotonic() - started_s < 30.0


def test_a_helper_comes_only_to_what_takes_long(monkeypatch):
    started = []
    monkeypatch.setattr(
        "filter_service.building.helper_process.start_module",
        lambda *arguments: (
            started.append(_python(SLEEP_UNTIL_PARENT_ENDS)) or started[0]
        ),
    )
    with HelperProcess("module", after_s=5.0):
        pass
    assert not started
    with HelperProcess("module", after_s=0.01):
        while not started:
            time.sleep(0.01)
    assert started[0].returncode is not None, "it goes on after the work is done"


def test_a_process_ends_with_the_one_that_started_it():
    process = start_module("timeit", "-n1", "-r1", SLEEP_UNTIL_PARENT_ENDS)
    time.sleep(0.2)
    assert process.poll() is None
    process.stdin.close()  # as the system does when the other process ends
    assert process.wait(20.0) == 1
