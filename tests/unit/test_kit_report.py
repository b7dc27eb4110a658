"""The page of the GPU kit: goals beside what was measured, steps, their last lines."""

import json

import pytest

from tests.gpu_kit.goals import (
    MET,
    MISSED,
    NOT_JUDGED,
    NOT_MEASURED,
    Goal,
    read_goals,
)
from tests.gpu_kit.report import report_text
from tests.gpu_kit.runner import DONE, FAILED, NOT_BEGUN, Outcome
from tests.gpu_kit.steps import all_steps
from tests.source_tree import ROOT

KEPT = {
    "gpu": "gpu",
    "stereo": "gpu",
    "render": "render_h100",
    "switch": "switch",
    "field": "field",
    "cost": "cost",
}
"""Results in the repository that a step's are like."""

FAST = Goal(
    what="frame",
    unit="ms",
    step="gpu",
    row={"method": "passes", "setting": "720p"},
    quick_row={"setting": "90p"},
    value="median_ms",
    at_most=2.0,
    source="a forecast",
)
ROWS = {
    "rows": [
        {"method": "  passes", "setting": "720p", "median_ms": 1.5},
        {"method": "  passes", "setting": "90p", "median_ms": 0.5},
    ]
}
HARDWARE = {"gl_renderer": "Card 9", "is_software": False, "cpu": "Chip", "torch": ""}


def page(outcomes, goals=(FAST,), hardware=HARDWARE, is_quick=False):
    return report_text(
        outcomes, list(goals), hardware=hardware, commit="abc1234", is_quick=is_quick
    )


@pytest.mark.parametrize("goal", read_goals(), ids=lambda goal: goal.what)
def test_every_goal_names_a_row_that_its_step_has(goal):
    assert goal.step in {step.name for step in all_steps(ROOT)}
    if goal.step not in KEPT:
        assert goal.step == "training"  # whose rows are in no file yet
        return
    file = ROOT / "tests/benchmarks/results" / f"{KEPT[goal.step]}.json"
    value = goal.measured(json.loads(file.read_text(encoding="utf-8")))
    assert value > 0.0


def test_a_number_is_judged_by_its_bound():
    slow = Goal("psnr", "dB", "gpu", {}, "error", "before", at_least=40.0)
    assert (FAST.verdict(2.0), FAST.verdict(2.1)) == (MET, MISSED)
    assert (slow.verdict(40.0), slow.verdict(39.9)) == (MET, MISSED)
    assert FAST.verdict(None) == NOT_MEASURED
    assert FAST.verdict(9.0, is_judged=False) == NOT_JUDGED
    assert Goal("rate", "1/s", "gpu", {}, "n", "-").verdict(1.0) == NOT_JUDGED


def test_two_rows_for_one_goal_are_refused():
    double = {"rows": ROWS["rows"][:1] * 2}
    with pytest.raises(ValueError, match="goal 'frame': 2 rows"):
        FAST.measured(double)


def test_the_page_has_goal_beside_measured():
    text = page([Outcome("gpu", "a frame", DONE, 3.0, 60.0, content=ROWS)])
    assert "# ocufilter abc1234 on Card 9" in text
    assert "| frame | <= 2 ms | 1.5 ms | met | a forecast |" in text
    assert "| gpu | a frame | done | 3.0 | 60 |" in text


def test_a_quick_run_reads_its_own_rows_and_judges_none():
    text = page([Outcome("gpu", "", DONE, content=ROWS)], is_quick=True)
    assert "| frame | <= 2 ms | 0.5 ms (90p) |  | a forecast |" in text
    assert "not judged" in text


def test_a_software_renderer_is_not_judged():
    hardware = HARDWARE | {"is_software": True}
    text = page([Outcome("gpu", "", DONE, content=ROWS)], hardware=hardware)
    assert "| 1.5 ms |  |" in text
    assert "No hardware GPU" in text


def test_last_lines_stand_there_of_what_did_not_end_well_alone():
    text = page(
        [
            Outcome("a", "", DONE, content=ROWS, tail=("all well",)),
            Outcome("b", "", FAILED, tail=("x" * 300, "ValueError: bad")),
            Outcome("c", "rows", NOT_BEGUN, tail=("the budget is spent",)),
        ]
    )
    assert "all well" not in text
    assert "    ValueError: bad" in text
    assert "| c | rows: the budget is spent | not begun |" in text
    assert max(map(len, text.splitlines())) < 120
    assert "| frame | <= 2 ms | - | not measured |" in text


def test_what_prints_no_rows_says_its_last_line():
    text = page([Outcome("tests", "of the GPU", DONE, tail=("begun", "3 passed"))])
    assert "| tests | of the GPU: 3 passed | done |" in text


def test_without_any_machine_there_is_a_page_all_the_same():
    assert "on no GPU" in page([], hardware={})
