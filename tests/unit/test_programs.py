"""What `ocufilter demo` and `ocufilter bench` start, and how that ends."""

import importlib.util
import subprocess
import sys

import pytest

from clients.extra import INSTALL
from filter_service.commands import programs
from filter_service.commands.console import CommandFailed
from tests.source_tree import ROOT

WITHOUT_PYRENDER = (
    "import runpy, sys\n"
    "sys.modules['pyrender'] = None\n"
    "sys.argv = [sys.argv[1]]\n"
    "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)\n"
)


@pytest.mark.parametrize("module", ["clients.demo", "clients.pyrender_stream"])
def test_without_pyrender_a_program_says_in_one_line_what_to_install(module):
    finished = subprocess.run(
        [sys.executable, "-c", WITHOUT_PYRENDER, module],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert finished.returncode == 1
    assert finished.stdout == ""
    assert finished.stderr.count("\n") == 1, finished.stderr
    assert "pyrender is not installed" in finished.stderr
    assert INSTALL in finished.stderr


def test_a_program_that_is_found_starts_where_the_user_is():
    assert programs._folder_to_start_in("clients.latency") is None


def test_a_program_beside_the_packages_starts_in_the_checkout(monkeypatch):
    """As the `ocufilter` of an editable install, which does not see tests/."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    folder = programs._folder_to_start_in("tests.benchmarks.bench_psf")
    assert folder == ROOT


def test_a_program_that_is_nowhere_needs_a_checkout():
    with pytest.raises(CommandFailed, match=r"in nowhere/.*checkout"):
        programs._folder_to_start_in("nowhere.bench")
