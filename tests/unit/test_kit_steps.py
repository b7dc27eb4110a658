"""Steps of the GPU kit: one that fails, one that takes too long, a budget that ends."""

import os
import sys
import time

import pytest

from tests.gpu_kit.runner import (
    DONE,
    FAILED,
    LEAST_S,
    TOO_LONG,
    Budget,
    kept_rows,
    last_lines,
    printed_json,
    run_program,
)
from tests.gpu_kit.steps import all_steps, gpu_test_files
from tests.source_tree import ROOT


@pytest.fixture
def ran(tmp_path):
    """Run a script as a step: its state, its seconds, its files."""

    def run(script, limit_s=20.0):
        state, seconds = run_program(
            [sys.executable, "-c", script],
            name="step",
            limit_s=limit_s,
            logs=tmp_path,
            cwd=tmp_path,
            environment=os.environ,
        )
        return state, seconds, tmp_path / "step.out", tmp_path / "step.log"

    return run


def test_a_step_that_ends_well_leaves_what_it_printed(ran):
    state, seconds, out, _ = ran("print('{\"rows\": [1]}')")
    assert state == DONE
    assert 0.0 < seconds < 20.0
    assert printed_json(out) == {"rows": [1]}


def test_a_step_that_fails_leaves_its_last_lines(ran):
    state, _, out, log = ran("print('half'); raise ValueError('bad pupil')")
    assert state == FAILED
    assert printed_json(out) == {}
    assert last_lines(log)[-1] == "ValueError: bad pupil"
    assert len(last_lines(out, log)) <= 5


def test_a_step_that_takes_too_long_is_ended_with_what_it_started(ran, tmp_path):
    script = (
        "import subprocess, sys, time\n"
        "sleep = [sys.executable, '-c', 'import time; time.sleep(60)']\n"
        "child = subprocess.Popen(sleep)\n"
        "open('child', 'w').write(str(child.pid))\n"
        "print('begun', flush=True)\n"
        "time.sleep(60)\n"
    )
    state, seconds, out, _ = ran(script, limit_s=2.0)
    assert state == TOO_LONG
    assert 2.0 <= seconds < 15.0
    assert last_lines(out) == ("begun",)
    assert _has_ended(int((tmp_path / "child").read_text()))


def _has_ended(pid):
    """Whether a process is gone, or only waits for someone to take note of its end."""
    for _ in range(50):
        try:
            os.kill(pid, 0)
            with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
                if file.read().rpartition(")")[2].split()[0] == "Z":
                    return True
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.1)
    return False


def test_a_budget_shortens_the_last_step_and_begins_no_other():
    now_s = [100.0]
    budget = Budget(480.0, clock=lambda: now_s[0])
    assert budget.limit_s(60.0) == 60.0
    now_s[0] += 450.0
    assert budget.limit_s(60.0) == pytest.approx(30.0)
    now_s[0] += 30.0 - 0.5 * LEAST_S
    assert budget.limit_s(60.0) == 0.0
    assert budget.spent_s == pytest.approx(480.0 - 0.5 * LEAST_S)


def test_rows_that_were_kept_count_only_if_they_are_of_this_run(tmp_path):
    file = tmp_path / "rows.jsonl"
    assert kept_rows(file, 0.0) == {}
    file.write_text('{"key": "a", "row": {"error": 46.0}}\n')
    assert kept_rows(file, 0.0) == {"rows": [{"error": 46.0}]}
    assert kept_rows(file, time.time() + 60.0) == {}


def test_a_row_that_was_cut_off_while_it_was_written_is_left_out(tmp_path):
    file = tmp_path / "rows.jsonl"
    file.write_text('{"key": "a", "row": {"error": 46.0}}\n{"key": "b", "ro')
    assert kept_rows(file, 0.0) == {"rows": [{"error": 46.0}]}


def test_every_step_starts_what_exists():
    steps = all_steps(ROOT)
    assert len({step.name for step in steps}) == len(steps)
    for step in steps:
        file = ROOT / (step.module.replace(".", "/") + ".py")
        assert file.is_file() or step.module == "pytest"
        for is_quick in (False, True):
            words = step.command(ROOT / "out", is_quick=is_quick)
            assert not [word for word in words if "{" in word]
            assert all((ROOT / w).is_file() for w in words if w.endswith(".toml"))


def test_tests_for_a_gpu_are_found_by_their_mark():
    assert "tests/numerical/test_renderer_scenes.py" in gpu_test_files(ROOT)
    assert "tests/unit/test_depths.py" not in gpu_test_files(ROOT)
