"""Programs of the clients without the packages or the checkout that they need."""

import subprocess
import sys

import pytest

from clients.commands import checkout
from clients.commands.console import CommandFailed
from clients.extra import INSTALL
from tests.source_tree import ROOT

WITHOUT_A_PACKAGE = (
    "import runpy, sys\n"
    "sys.modules[sys.argv[2]] = None\n"
    "sys.argv = [sys.argv[1]]\n"
    "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)\n"
)


@pytest.mark.parametrize(
    ("module", "package"),
    [("clients.demo", "av"), ("clients.pyrender_stream", "glfw")],
)
def test_a_missing_package_is_reported_in_one_line_with_its_command(module, package):
    finished = subprocess.run(
        [sys.executable, "-c", WITHOUT_A_PACKAGE, module, package],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert finished.returncode == 1
    assert finished.stdout == ""
    assert finished.stderr.count("\n") == 1, finished.stderr
    assert f"{package} is not installed" in finished.stderr
    assert INSTALL in finished.stderr


def test_an_installed_package_has_no_benchmarks(monkeypatch, tmp_path):
    monkeypatch.setattr(checkout, "BENCHMARKS", tmp_path / "benchmarks")
    with pytest.raises(CommandFailed, match=r"in tests/.*git clone"):
        checkout._benchmarks()
