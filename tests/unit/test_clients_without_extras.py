"""Programs of the clients without the packages or the checkout that they need."""

import re
import subprocess
import sys

import pytest

from clients.commands import checkout
from clients.extra import INSTALL, PYRENDER_INSTALL
from tests.commands import run_command
from tests.source_tree import ROOT

WITHOUT_A_PACKAGE = (
    "import runpy, sys\n"
    "sys.modules[sys.argv[2]] = None\n"
    "sys.argv = [sys.argv[1], *sys.argv[3:]]\n"
    "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)\n"
)


@pytest.mark.parametrize(
    ("package", "command", "arguments"),
    [
        ("glfw", INSTALL, ("clients.pyrender_stream", "--window")),
        ("pyrender", PYRENDER_INSTALL, ("clients.pyrender_stream", "--file", "a.stl")),
    ],
)
def test_a_missing_package_is_reported_in_one_line_with_its_command(
    package, command, arguments
):
    finished = subprocess.run(
        [
            sys.executable,
            "-c",
            WITHOUT_A_PACKAGE,
            arguments[0],
            package,
            *arguments[1:],
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert finished.returncode == 1
    assert finished.stdout == ""
    assert finished.stderr.count("\n") == 1, finished.stderr
    assert f"{package} is not installed" in finished.stderr
    assert command in finished.stderr


def test_an_installed_package_has_no_benchmarks(monkeypatch, tmp_path):
    monkeypatch.setattr(checkout, "BENCHMARKS", tmp_path / "benchmarks")
    for arguments in (["bench", "psf"], ["paper"]):
        ended = run_command(*arguments, cwd=tmp_path)
        assert ended.returncode == 1
        assert re.search(r"in tests/.*git clone", ended.stderr)
