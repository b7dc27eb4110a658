"""Every benchmark can be imported: few of them run in a test, and mypy skips tests."""

import subprocess
import sys

import pytest

from tests.source_tree import ROOT

# Some benchmarks need packages that only `make validate` or `make test-web` installs.
CODE = """
import importlib, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module("tests.benchmarks." + name)
    except ModuleNotFoundError as error:
        if error.name.partition(".")[0] in ("tests", "ocufilter", *OURS):
            raise
        print(name)
"""
OURS = ("estimator", "filter_service", "clients", "training", "shaders", "examples")


@pytest.mark.tools
@pytest.mark.long("imports all benchmarks")
def test_every_benchmark_can_be_imported():
    paths = (ROOT / "tests" / "benchmarks").glob("bench_*.py")
    names = sorted(path.stem for path in paths)
    finished = subprocess.run(
        [sys.executable, "-c", f"OURS = {OURS}\n{CODE}", *names],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert finished.returncode == 0, finished.stderr
    assert len(names) - len(finished.stdout.split()) > 30
