"""``make results``: one commit, resumption, failures, in a small checkout."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

GOOD = '''"""Measure nothing."""
import time
from tests.benchmarks.harness import Row, written_path
MINUTES = 0.1
def measure(run):
    written_path("{name}.png").write_bytes(b"picture")
    time.sleep({wait_s})
    return [Row("{name}", "a", "b", "c", 1, 1.0, 1.0, 1.0, "px", 0.5, "none")]
'''
BAD = '''"""Fail."""
MINUTES = 0.1
def measure(run):
    raise ValueError("the lamp is broken")
'''


class Checkout:
    """A git repository with the runner, two benchmarks, one that fails, a document."""

    def __init__(self, folder):
        self.folder = folder
        self.benchmarks = folder / "tests" / "benchmarks"
        self.results = self.benchmarks / "results"
        self.benchmarks.mkdir(parents=True)
        for name in ("__main__.py", "harness.py", "measure_all.py", "tables.py"):
            shutil.copy(ROOT / "tests" / "benchmarks" / name, self.benchmarks)
        (self.benchmarks / "tables.toml").write_text("[sets]\n[figures]\n")
        for name, wait_s in (("one", 0.0), ("slow", 60.0)):
            text = GOOD.format(name=name, wait_s=wait_s)
            self.bench(name).write_text(text)
        self.bench("bad").write_text(BAD)
        (folder / "README.md").write_text("")
        (folder / ".gitignore").write_text("out/\n__pycache__/\n")
        self.git("init", "-q")
        self.commit()

    def bench(self, name):
        return self.benchmarks / f"bench_{name}.py"

    def git(self, *arguments):
        who = ("-c", "user.name=a", "-c", "user.email=a@example.org")
        subprocess.run(("git", *who, *arguments), cwd=self.folder, check=True)

    def commit(self):
        self.git("add", "-A")
        self.git("commit", "-q", "-m", "state")

    def start(self, *names):
        arguments = ("results", "--no-wait", *names)
        return subprocess.Popen(
            [sys.executable, "-m", "tests.benchmarks", *arguments],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": f"{self.folder}{os.pathsep}{ROOT}"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def run(self, *arguments):
        with self.start(*arguments) as process:
            text, _ = process.communicate(timeout=100)
        return process.returncode, text


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    return Checkout(tmp_path_factory.mktemp("checkout"))


@pytest.mark.long("runs two benchmarks and ends one")
def test_results_are_of_one_commit_and_runs_continue(checkout):
    status, text = checkout.run("one", "bad")
    assert status == 1
    assert "failed: bad: exit status 1; see out/results/bad.log" in text
    assert "the lamp is broken" in (checkout.folder / "out/results/bad.log").read_text()
    assert sorted(os.listdir(checkout.results)) == ["one.json", "one.png"]
    first = json.loads((checkout.results / "one.json").read_text())
    assert first["rows"][0]["error"] == 0.5
    # A commit of results and documents does not count.
    (checkout.folder / "README.md").write_text("| 0.5 |")
    checkout.commit()
    with checkout.start("one", "slow") as process:
        while not any((checkout.folder / "out/results").glob("*/slow.png")):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        text, _ = process.communicate(timeout=20)
    assert f"commit {first['commit']}: 1 benchmarks" in text
    assert "measured at this commit: one" in text
    assert sorted(os.listdir(checkout.results)) == ["one.json", "one.png"]
    assert not list((checkout.folder / "out/results").glob("*/"))


@pytest.mark.long("starts the runner twice")
def test_changed_trees_are_refused_and_the_files_named(checkout):
    path = checkout.bench("other")
    path.write_text(BAD)
    try:
        status, text = checkout.run("bad")
        assert status == 1
        assert "commit these changes first:\n  tests/benchmarks/bench_other.py" in text
        status, text = checkout.run("one", "--out", "out/validate")
        assert status == 0
        kept = json.loads((checkout.folder / "out/validate/one.json").read_text())
        assert kept["commit"].endswith("+")
    finally:
        path.unlink()


@pytest.mark.long("starts the runner")
def test_the_plan_measures_nothing(checkout):
    status, text = checkout.run("--plan", "bad", "slow")
    assert status == 0
    assert "2 benchmarks, about 0 min" in text
    assert not (checkout.results / "slow.json").exists()
