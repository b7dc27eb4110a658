"""Plain lines of long work: at each stage, and now and then though nothing moves."""

import io
import re
import subprocess
import sys
import time

import pytest

from filter_service.command_line import print_line
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


BUILD_S, FRAME_S = 10.0, 0.1


def _frames(count, item_s=FRAME_S):
    return [item_s] * count


DURATIONS_S = {
    "all alike": _frames(300),
    "slow items": _frames(20, 60.0),
    "an eye first": [BUILD_S, *_frames(500)],
    "three eyes": [3.0 * BUILD_S, *_frames(99)] * 3,
    "ten eyes": [BUILD_S, *_frames(99)] * 10,
    "two at once": [0.4 if k % 2 else 0.0 for k in range(200)],
    "of two sizes": [0.1 if k % 3 else 0.5 for k in range(200)],
    "few parts": [60.0, 200.0, 5.0],
    "fifty thousand": _frames(50_000, 0.01),
}
"""Times between the items of a task, s."""


@pytest.mark.parametrize("case", DURATIONS_S)
def test_the_time_left_is_right_within_a_factor_of_two_or_not_said(case):
    now_s = [100.0]
    progress = Progress("demo", quiet=True, clock=lambda: now_s[0])
    durations_s = DURATIONS_S[case]
    task = progress.task("Frames", total=len(durations_s))
    end_s, said, wrong = now_s[0] + sum(durations_s), 0, []
    for number, item_s in enumerate(durations_s):
        for share in (0.5, 1.0):  # lines are written between items, too
            now_s[0] += 0.5 * item_s
            if share == 1.0:
                task.advance()
            if number % 10_000 > 1000:
                continue
            found = re.search(r", (\d+) s left", task.count)
            if found is None:
                continue
            said += 1
            left_s, truth_s = float(found[1]), end_s - now_s[0]
            if not truth_s / 2.0 - 1.0 <= left_s <= 2.0 * truth_s + 1.0:
                wrong.append((number, left_s, truth_s))
    assert not wrong
    if case not in ("three eyes", "few parts"):
        assert said > 0.4 * 2 * min(len(durations_s), 1000)


def test_a_task_that_stands_still_says_no_time():
    now_s = [0.0]
    progress = Progress("demo", quiet=True, clock=lambda: now_s[0])
    task = progress.task("Frames", total=250)
    for _ in range(20):
        now_s[0] += 0.5
        task.advance()
    assert task.count == "20/250 frames, 115 s left"
    now_s[0] += 1.0
    assert task.count == "20/250 frames, 114 s left"
    now_s[0] += 100.0
    assert task.count == "20/250 frames"


def test_a_resumed_task_counts_only_what_it_does():
    now_s = [0.0]
    progress = Progress("demo", quiet=True, clock=lambda: now_s[0])
    task = progress.task("Frames", total=300)
    task.update(250)
    for _ in range(10):
        now_s[0] += 1.0
        task.advance()
    assert task.count == "260/300 frames, 40 s left"


def test_a_percentage_says_no_time():
    """Its stages advance at rates of their own: 85 % of a report took half of it."""
    now_s = [0.0]
    progress = Progress("demo", quiet=True, clock=lambda: now_s[0])
    task = progress.task("Report", total=1.0, unit="%")
    for k in range(30):
        now_s[0] += 1.0
        task.update(k / 40, "numbers")
    assert task.count == "72 %"


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


def test_a_name_that_is_not_utf_8_is_printed_with_escapes(capsys):
    """The stream is strict, as in most locales; a written file counted as a failure."""
    print_line("wrote caf\udce9.png, 中")
    assert capsys.readouterr().out == "wrote caf\\udce9.png, 中\n"
