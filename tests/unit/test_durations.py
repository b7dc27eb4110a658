"""What the recorded durations say of cases over the budget, and the mark ``long``."""

import json
import os
import subprocess
import sys

import pytest

from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

CONFTEST = """
from tests.conftest import (
    pytest_collection_modifyitems, pytest_configure, pytest_testnodedown
)
"""
SETTINGS = "[pytest]\nmarkers =\n    long: takes long\n    slow: never selected\n"
CASES = """
import pytest, time

def spend(duration_s):
    end_s = time.process_time() + duration_s
    while time.process_time() < end_s:
        pass

@pytest.fixture(scope="module")
def shared():
    spend(0.3)

def test_short(shared):
    pass

def test_over():
    spend(0.25)

@pytest.mark.long("it spends time")
def test_marked():
    spend(0.25)
"""


@pytest.fixture
def run(tmp_path):
    """Run pytest on a file of cases, in a process with the project's hooks."""

    def run(cases, *arguments, **environment):
        (tmp_path / "conftest.py").write_text(CONFTEST)
        (tmp_path / "pytest.ini").write_text(SETTINGS)
        (tmp_path / "test_cases.py").write_text(cases)
        return subprocess.run(
            [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
            capture_output=True,
            text=True,
            timeout=60,
        )

    return run


@pytest.mark.parametrize("workers", [(), ("-n", "2")])
def test_cases_over_the_budget_are_named_without_those_marked_long(
    run, tmp_path, workers
):
    path = tmp_path / "durations.json"
    finished = run(CASES, *workers, OCUFILTER_DURATIONS=str(path))
    assert finished.returncode == 0, finished.stdout
    found = json.loads(path.read_text())
    assert list(found["over_budget_unmarked"]) == ["test_cases.py::test_over"]
    assert found["long_count"] == 1
    assert "1 cases are marked long; 1 others take more than 0.2 s" in finished.stdout


@pytest.mark.parametrize(
    ("mark", "shown"),
    [
        ("", "none"),
        ("()", "none"),
        ("('')", "('',)"),
        ("(0.3)", "(0.3,)"),
        ("('a', 'b')", "('a', 'b')"),
    ],
)
def test_a_mark_without_a_reason_ends_the_collection(run, mark, shown):
    cases = f"import pytest\n\n@pytest.mark.long{mark}\ndef test_it(): pass\n"
    finished = run(cases)
    assert finished.returncode == pytest.ExitCode.USAGE_ERROR
    expected = "test_cases.py::test_it: the mark long takes one reason, a text; it has"
    assert f"{expected} {shown}" in finished.stderr


def test_too_many_marked_cases_end_the_collection(run):
    cases = (
        "import pytest\n"
        "@pytest.mark.long('it is long')\n"
        "@pytest.mark.parametrize('k', range(180))\n"
        "def test_many(k): pass\n"
        "@pytest.mark.slow\n"
        "@pytest.mark.long('it is long')\n"
        "def test_one_more(): pass\n"
    )
    assert run(cases, "-m", "not slow").returncode == 0
    finished = run(cases)
    assert finished.returncode == pytest.ExitCode.USAGE_ERROR
    assert "181 cases are marked long; allowed: at most 180" in finished.stderr


def test_workers_refuse_a_mark_without_a_reason(run):
    cases = "import pytest\n\n@pytest.mark.long\ndef test_it(): pass\n"
    finished = run(cases, "-n", "2")
    assert finished.returncode == pytest.ExitCode.USAGE_ERROR
    assert "test_it: the mark long takes one reason" in finished.stderr
