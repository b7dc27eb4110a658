"""`.ci/run` runs every suite that CONTRIBUTING.md names, and reports each outcome."""

import json
import os
import re
import shutil
import subprocess

import pytest

from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

MAKE = """#!/bin/sh
echo "made $1"
if [ -n "${FAILING:-}" ] && [ -z "$ARGS" ]; then
    mkdir -p .pytest_cache/v/cache
    printf '%s' "$FAILING" >.pytest_cache/v/cache/lastfailed
    exit 2
fi
case " $BROKEN " in *" $1 "*) exit 2 ;; esac
"""
CLEAN_CLONE = """
if [ $# = 0 ]; then exit $CLONE_STATUS; fi
echo "cloned $*"
"""
SETUP_ROOT = """
if [ "$HEADSET_STATUS" = 77 ]; then echo "no chroot" >"$OCUFILTER_SKIP_REASON"; fi
exit $HEADSET_STATUS
"""


def _suites() -> list[str]:
    script = (ROOT / ".ci/run").read_text(encoding="utf-8")
    return re.search(r"^SUITES=\((.*)\)$", script, re.MULTILINE)[1].split()


def test_every_suite_that_is_named_runs():
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(
        r"^\| `make (check|demo|docs|release-check|test|test-[a-z-]+)` ",
        page,
        re.MULTILINE,
    )
    assert sorted(_suites()) == sorted(named)


def test_the_hosted_workflow_runs_the_same_suites():
    text = (ROOT / ".github/workflows/test.yml").read_text(encoding="utf-8")
    listed = re.search(r"^ +suite:\n((?: +- [a-z-]+\n)+)", text, re.MULTILINE)[1]
    matrix = set(re.findall(r"- ([a-z-]+)$", listed, re.MULTILINE))
    jobs = set(re.findall(r"run: make ([a-z-]+)$", text, re.MULTILINE))
    assert matrix <= set(_suites()) <= matrix | jobs


@pytest.fixture
def run(tmp_path):
    """Return how to run a copy of the script with stand-ins for make and the set-up."""
    programs = {
        "bin/make": MAKE,
        "tests/headset/setup_root.sh": SETUP_ROOT,
        "tests/clean_clone.sh": CLEAN_CLONE,
    }
    for name, text in programs.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        path.chmod(0o755)
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci/run", tmp_path / ".ci/run")

    def run(*suites, broken="", failing=(), headset_status=0, clone_status=77):
        environment = {
            "FAILING": json.dumps(dict.fromkeys(failing, True), indent=2)
            if failing
            else "",
            "PATH": f"{tmp_path}/bin:{os.environ['PATH']}",
            "BROKEN": broken,
            "HEADSET_STATUS": str(headset_status),
            "CLONE_STATUS": str(clone_status),
            "XDG_CACHE_HOME": str(tmp_path / "cache"),
        }
        return subprocess.run(
            ["bash", str(tmp_path / ".ci/run"), *suites],
            cwd=tmp_path,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
        )

    return run


def _summary(finished) -> dict[str, str]:
    """Return the outcome of each suite, by the lines after the last heading."""
    lines = finished.stdout.split("summary")[-1].splitlines()[1:]
    return {line.split()[0]: line.split(" s  ", 1)[1] for line in lines}


def test_all_suites_pass_one_after_another(run):
    finished = run()
    assert finished.returncode == 0, finished.stdout + finished.stderr
    assert re.findall(r"^made (.*)$", finished.stdout, re.MULTILINE) == _suites()
    assert _summary(finished) == dict.fromkeys(_suites(), "passed")


def test_a_failed_suite_does_not_stop_the_others(run):
    finished = run(broken="check test-web")
    assert finished.returncode == 1
    outcomes = _summary(finished)
    assert list(outcomes) == _suites()
    failed = [name for name, outcome in outcomes.items() if "FAILED" in outcome]
    assert failed == ["check", "test-web"]


def test_a_test_that_passes_the_second_time_is_named(run):
    finished = run("test-web", failing=["tests/web/a.py::test_b[c-d]", "e.py::f"])
    assert finished.returncode == 0
    assert re.findall(r"^made (.*)$", finished.stdout, re.M) == 2 * ["test-web"]
    named = "passed, the second time: tests/web/a.py::test_b[c-d], e.py::f"
    assert _summary(finished) == {"test-web": named}


@pytest.mark.parametrize(
    ("failing", "broken", "n_runs"),
    [
        (["a.py::b"], "test-web", 2),
        ([f"a.py::b{k}" for k in range(4)], "", 1),
    ],
    ids=["again", "many"],
)
def test_a_suite_fails_by_tests_that_fail_twice_and_by_many(
    run, failing, broken, n_runs
):
    finished = run("test-web", failing=failing, broken=broken)
    assert finished.returncode == 1
    assert finished.stdout.count("made test-web") == n_runs
    assert "FAILED: exit status 2" in _summary(finished)["test-web"]


def test_a_suite_that_cannot_run_here_is_skipped_and_reported(run):
    finished = run(headset_status=77)
    assert finished.returncode == 0
    assert _summary(finished)["test-headset"] == "skipped: no chroot"
    assert "made test-headset" not in finished.stdout


def test_what_a_new_user_runs_runs_in_a_clean_clone_where_that_is_possible(run):
    finished = run("check", "demo", "test", clone_status=0)
    assert re.findall(r"^cloned \S+ (.*)$", finished.stdout, re.M) == ["demo", "test"]
    assert re.findall(r"^made (.*)$", finished.stdout, re.M) == ["check"]
    outcomes = {"check": "passed", "demo": "passed", "test": "passed"}
    assert _summary(finished) == outcomes


def test_a_headset_root_that_cannot_be_finished_is_a_failure(run):
    finished = run("test-headset", headset_status=1)
    assert finished.returncode == 1
    assert "FAILED" in _summary(finished)["test-headset"]
