"""Plain lines of long work: at each stage, and now and then though nothing moves."""

import io
import re
import subprocess
import sys
import time

import pytest

from filter_service.progress import Progress
from tests.source_tree import ROOT

SLOW_WORK = """
import sys, time
from filter_service.progress import Progress
with Progress("work", interval_s=0.3) as progress:
    task = progress.task("Digging", total=10, unit="holes")
    task.update(4)
    time.sleep(1.2)
"""


def _lines(stream):
    return [line.split("] ", 1)[1] for line in stream.getvalue().splitlines()]


def test_a_pipe_gets_lines_while_nothing_moves():
    started_s = time.monotonic()
    command = [sys.executable, "-c", SLOW_WORK]
    with subprocess.Popen(
        command, cwd=ROOT, stderr=subprocess.PIPE, text=True
    ) as process:
        came = [(line, time.monotonic() - started_s) for line in process.stderr]
    assert process.returncode == 0
    assert came[0][0] == "work: [0 s] Digging, 0/10 holes\n"
    assert all("4/10 holes" in line for line, _ in came[1:])
    times_s = [at_s for _, at_s in came]
    assert len(came) >= 4  # one every 0.3 s of 1.2 s, and one more for a busy machine
    assert times_s[1] < times_s[0] + 0.9, "the lines came all at once"


def test_each_stage_is_said_at_once_and_only_once():
    stream = io.StringIO()
    with Progress("demo", stream=stream) as progress:
        task = progress.task("Myopia", total=1.0, unit="%")
        for fraction, stage in ((0.0, "eye"), (0.1, "eye"), (0.2, "PSFs")):
            task.update(fraction, stage)
        task = progress.task("Myopia", total=2)
        task.advance()
        task.advance()
    assert _lines(stream) == [
        "Myopia, 0 %",
        "Myopia: eye, 0 %",
        "Myopia: PSFs, 20 %",
        "Myopia, 0/2 frames",
        "Myopia, 2/2 frames",
    ]


def test_time_left_is_that_of_the_rest(monkeypatch):
    stream, now_s = io.StringIO(), [100.0]
    monkeypatch.setattr("filter_service.progress.time.monotonic", lambda: now_s[0])
    progress = Progress("demo", stream=stream)
    task = progress.task("Frames", total=40)
    now_s[0] += 60.0  # to the first one it took long
    task.advance()
    assert task.count == "1/40 frames"
    now_s[0] += 10.0
    task.update(11)
    assert task.count == "11/40 frames, 29 s left"


def test_a_quiet_one_says_nothing_and_a_terminal_gets_a_bar():
    stream = io.StringIO()
    with Progress(stream=stream, quiet=True, interval_s=0.01) as progress:
        progress.task("Work", total=2).advance()
        time.sleep(0.05)
    assert stream.getvalue() == ""
    stream.isatty = lambda: True
    with Progress(stream=stream) as progress:
        progress.task("Work, in earnest", total=2).advance()
    assert "Work, in earnest" in stream.getvalue()
    assert not re.search(r"\[\d+ s\]", stream.getvalue())


def test_what_failed_is_not_said_to_be_done():
    stream = io.StringIO()
    with pytest.raises(OSError), Progress(stream=stream) as progress:
        task = progress.task("Work", total=2)
        task.update(1)
        raise OSError
    assert _lines(stream) == ["Work, 0/2 frames"]
