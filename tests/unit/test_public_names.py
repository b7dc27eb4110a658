"""`ocufilter` shows the names of its packages, and loads none before it is used."""

import ast
import importlib
import runpy
import subprocess
import sys

import pytest

import clients.commands.program  # noqa: F401  (loaded before its test)
import ocufilter
from tests.source_tree import ROOT

PACKAGES = ("filter_service", "clients", "estimator")
FOUND = {name: getattr(ocufilter, name) for name in ocufilter.__all__}
"""All names, loaded before the tests: SciPy and others take a second."""


def names_of_stub():
    """Return the names of the stub, with the packages that they come from."""
    tree = ast.parse((ROOT / "ocufilter" / "__init__.pyi").read_text(encoding="utf-8"))
    return {
        alias.asname: (node.module, alias.name)
        for node in tree.body
        for alias in node.names
    }


def test_the_stub_and_the_package_have_the_same_names():
    assert sorted(names_of_stub()) == ocufilter.__all__ == dir(ocufilter)
    assert all(name == found for name, (_, found) in names_of_stub().items())


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_of_a_package_is_the_same_object(package):
    module = importlib.import_module(package)
    for name in module.__all__:
        assert FOUND[name] is getattr(module, name)
        home = "estimator" if name == "__version__" else package
        assert names_of_stub()[name][0] == home


def test_no_two_packages_have_a_name_in_common():
    names = [
        name
        for package in PACKAGES
        for name in importlib.import_module(package).__all__
        if name != "__version__"
    ]
    assert len(set(names)) == len(names)


def test_errors_are_those_that_are_raised():
    with pytest.raises(ocufilter.errors.BadMessage, match="width_px"):
        ocufilter.Camera.from_fov(10.0, width_px=0, height_px=2)
    assert issubclass(ocufilter.errors.ServiceTimeout, ocufilter.FilterError)


def test_an_unknown_name_is_an_error_that_names_it():
    with pytest.raises(
        AttributeError, match="'ocufilter' has no attribute 'EyeFitler'"
    ):
        _ = ocufilter.EyeFitler


def test_importing_it_loads_no_module_but_those_of_names(tmp_path):
    script = (
        "import sys\nbefore = set(sys.modules)\nimport ocufilter\n"
        "new = {name for name in set(sys.modules) - before if '.' not in name}\n"
        "print(*sorted(new - set(sys.stdlib_module_names)))\n"
    )
    finished = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    expected = sorted(["lazy_loader", "ocufilter", *PACKAGES])
    assert finished.stdout.split() == expected, finished.stderr


def test_the_command_line_is_its_program(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ocufilter", "--version"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("ocufilter", run_name="__main__")
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"ocufilter {ocufilter.__version__}\n"
