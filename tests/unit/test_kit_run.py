"""A run of the GPU kit: every step leaves its file and the page, whatever it did."""

import json
import os
import sys
from pathlib import Path

import pytest

from tests.gpu_kit.goals import read_goals
from tests.gpu_kit.run import BUDGET_S, Run
from tests.gpu_kit.runner import DONE, FAILED, LEFT_OUT, NOT_BEGUN, Budget
from tests.gpu_kit.steps import Step, all_steps
from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

ROWS = {"gl_renderer": "Card 9", "torch": "", "rows": [{"method": "a", "n": 1}]}


@pytest.fixture
def printing(tmp_path):
    """A step that prints a JSON object: Python's own tool, on a file."""
    file = tmp_path / "rows.json"
    file.write_text(json.dumps(ROWS))
    return Step("machine", "rows", "json.tool", limit_s=20.0, words=(str(file),))


def new_run(tmp_path, budget_s=60.0):
    out = tmp_path / "out"
    return Run(out, commit="abc1234", is_quick=False, budget=Budget(budget_s))


def start(run, step):
    run.run(step, Path(sys.executable), dict(os.environ))
    return json.loads((run.out / f"{step.name}.json").read_text())


def test_a_step_leaves_its_rows_with_hardware_and_commit(tmp_path, printing):
    run = new_run(tmp_path)
    content = start(run, printing)
    assert content["rows"] == ROWS["rows"]
    assert content["commit"] == "abc1234"
    assert content["hardware"]["gl_renderer"] == "Card 9"
    assert content["step"]["state"] == DONE
    assert content["step"]["command"][:3] == ["python", "-m", "json.tool"]
    assert "abc1234 on Card 9" in (run.out / "report.md").read_text()


def test_after_a_step_that_fails_the_next_one_runs(tmp_path, printing):
    run = new_run(tmp_path)
    broken = Step("bad", "nothing", "no_such_module_of_kit", limit_s=20.0)
    assert start(run, broken)["step"]["state"] == FAILED
    assert start(run, printing)["step"]["state"] == DONE
    page = (run.out / "report.md").read_text()
    assert "No module named no_such_module_of_kit" in page
    hardware = json.loads((run.out / "bad.json").read_text())["hardware"]
    assert hardware["gl_renderer"] == "Card 9"  # known later


def test_without_torch_its_step_is_left_out(tmp_path, printing):
    run = new_run(tmp_path)
    start(run, printing)
    step = Step("training", "a network", "torch", limit_s=20.0, needs_torch=True)
    content = start(run, step)
    assert content["step"]["state"] == LEFT_OUT
    assert content["step"]["tail"] == ["torch is not on this machine"]


def test_when_the_budget_is_spent_a_step_is_not_begun(tmp_path, printing):
    run = new_run(tmp_path, budget_s=1.0)
    content = start(run, printing)
    assert content["step"]["state"] == NOT_BEGUN
    assert content["step"]["tail"] == ["the budget of 1 s is spent"]
    assert not (run.out / "logs" / "machine.out").exists()


def test_rows_that_a_step_kept_count_where_it_fails(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.gpu_kit.run.TREE", tmp_path)
    line = json.dumps({"key": "a", "row": {"method": "a", "error": 46.0}})
    script = tmp_path / "keeps_rows.py"
    script.write_text(
        f"open('kept.jsonl', 'w').write({line + chr(10)!r})\nraise SystemExit(3)\n"
    )
    step = Step("field", "rows", "keeps_rows", limit_s=20.0, rows_file="kept.jsonl")
    content = start(new_run(tmp_path), step)
    assert content["step"]["state"] == FAILED
    assert content["rows"] == [{"method": "a", "error": 46.0}]


def test_every_step_has_time_and_every_goal_a_step():
    steps = all_steps(ROOT)
    assert sum(step.limit_s for step in steps) <= BUDGET_S
    assert {goal.step for goal in read_goals()} <= {step.name for step in steps}
