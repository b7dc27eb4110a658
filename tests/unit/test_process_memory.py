"""The memory that benchmarks report: of processes."""

import os
import subprocess
import sys

import pytest

from tests.process_memory import (
    process_ids,
    pss_mb,
)

pytestmark = pytest.mark.tools


def test_the_pss_is_what_the_kernel_reports(tmp_path):
    rollup = tmp_path / "rollup"
    rollup.write_text("00400000-7ff rollup\nRss: 900 kB\nPss: 2000 kB\nPss_Anon: 1\n")
    assert pss_mb(1, str(rollup)) == pytest.approx(2.048)


def test_a_pss_that_is_not_available_is_not_a_number(tmp_path):
    assert pss_mb(1, str(tmp_path / "missing")) is None


def test_processes_are_found_with_their_children():
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        found = process_ids(os.getpid(), "program")
    finally:
        child.communicate(b"\n")
    assert found["program"] == os.getpid()
    assert child.pid in found.values()
