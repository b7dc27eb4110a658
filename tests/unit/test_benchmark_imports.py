"""Every benchmark can be imported: few of them run in a test, and mypy skips tests."""

import subprocess
import sys

import pytest

from tests.source_tree import ROOT

NEEDS_MITSUBA = "bench_witness"


@pytest.mark.tools
@pytest.mark.long("imports all benchmarks")
def test_every_benchmark_can_be_imported():
    paths = (ROOT / "tests" / "benchmarks").glob("bench_*.py")
    names = sorted(path.stem for path in paths if path.stem != NEEDS_MITSUBA)
    assert len(names) > 40
    code = "\n".join(f"import tests.benchmarks.{name}" for name in names)
    finished = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True
    )
    assert finished.returncode == 0, finished.stderr
