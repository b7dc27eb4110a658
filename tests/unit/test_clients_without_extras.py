"""Programs of the clients without the packages or the checkout that they need."""

import re
import sys

import pytest

import clients
from clients import pyrender_stream
from clients.commands import checkout
from filter_service.command_line import EXTRAS, app_of, exit_code
from tests.commands import run_command
from tests.source_tree import ROOT


@pytest.mark.parametrize(
    ("package", "module", "arguments"),
    [
        ("glfw", "window", ("--window", "--scene", "primitives")),
        ("pyrender", "pyrender_renderer", ("--file", "a.stl")),
        ("trimesh", "pyrender_renderer", ("--renderer", "pyrender")),
    ],
)
def test_a_missing_package_is_reported_in_one_line_with_its_command(
    package, module, arguments, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"clients.{module}", raising=False)
    monkeypatch.delattr(clients, module, raising=False)
    app = app_of(pyrender_stream.pyrender_stream)
    assert exit_code(app, list(arguments), "stream") == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err == (
        f"stream: the package {package} is not installed: {sys.executable} -m pip "
        f"install 'ocufilter[{EXTRAS[package]}]'\n"
    )


def test_every_extra_that_an_error_names_exists():
    declared = re.findall(
        r"^([a-z-]+) = \[", (ROOT / "pyproject.toml").read_text("utf-8"), re.MULTILINE
    )
    assert set(EXTRAS.values()) <= set(declared)


def test_an_installed_package_has_no_benchmarks(monkeypatch, tmp_path):
    monkeypatch.setattr(checkout, "BENCHMARKS", tmp_path / "benchmarks")
    for arguments in (["bench", "psf"], ["paper"]):
        ended = run_command(*arguments, cwd=tmp_path)
        assert ended.returncode == 1
        assert re.search(r"in tests/.*git clone", ended.stderr)
