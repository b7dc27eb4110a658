"""The memory that benchmarks report: of processes."""

import os
import subprocess
import sys

import pytest

from tests.benchmarks.process_memory import (
    MemoryUse,
    process_ids,
    pss_mb,
)

pytestmark = pytest.mark.tools


def use(*pss, stores_mb=1.0):
    return MemoryUse(stores_mb, 2.0, 3.0, dict(zip("abc", pss, strict=False)))


def test_the_pss_is_what_the_kernel_reports(tmp_path):
    rollup = tmp_path / "rollup"
    rollup.write_text("00400000-7ff rollup\nRss: 900 kB\nPss: 2000 kB\nPss_Anon: 1\n")
    assert pss_mb(1, str(rollup)) == pytest.approx(2.048)


def test_a_pss_that_is_not_available_is_not_a_number(tmp_path):
    assert pss_mb(1, str(tmp_path / "missing")) is None
    partial = use(10.0, None)
    assert partial.total_mb is None
    assert "a 10, b not available" in partial.words


def test_processes_are_found_with_their_children():
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        found = process_ids(os.getpid(), "program")
    finally:
        child.communicate(b"\n")
    assert found["program"] == os.getpid()
    assert child.pid in found.values()
