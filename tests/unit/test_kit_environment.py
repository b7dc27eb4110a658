"""The GPU kit's environment: which wheels go in, what they become, what goes along."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

from tests.gpu_kit import environment
from tests.source_tree import ROOT

pytestmark = pytest.mark.tools


def packages(name: str) -> set[str]:
    """A list of names in make.sh."""
    text = (ROOT / "tests/gpu_kit/make.sh").read_text(encoding="utf-8")
    found = re.search(rf'^{name}="([^"]*)"$', text, re.MULTILINE)[1].split()
    return {re.sub(r"[-_.]+", "-", package).lower() for package in found}


def test_all_that_the_service_needs_is_carried_or_expected():
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    required = tomllib.loads(text)["project"]["dependencies"]
    needed = {Requirement(requirement).name.lower() for requirement in required}
    assert needed <= packages("CARRIED") | packages("EXPECTED")
    assert not packages("CARRIED") & packages("EXPECTED")
    named = {names.split()[0] for names in environment.EXPECTED.values()}
    assert named == packages("EXPECTED")


def test_every_wheel_has_a_pin():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {re.sub(r"[-_.]+", "-", line.split("==")[0]).lower() for line in lines}
    assert packages("CARRIED") - pinned == set()


def make_wheel(folder, name="pkg-1-py3-none-any.whl"):
    with zipfile.ZipFile(folder / name, "w") as archive:
        archive.writestr("pkg_of_kit/__init__.py", "NUMBER = 41\n")
        archive.writestr("pkg-1.data/platlib/pkg_of_kit/more.py", "NUMBER = 42\n")
        archive.writestr("pkg-1.data/scripts/pkg", "#!python\n")
        archive.writestr("pkg-1.dist-info/METADATA", "Name: pkg\nVersion: 1\n")
    return folder / name


def test_an_environment_has_its_wheels_and_what_this_python_has(tmp_path):
    python = environment.make_environment(tmp_path / "venv", [make_wheel(tmp_path)])
    script = (
        "import importlib.metadata as m, numpy, pkg_of_kit.more as p\n"
        "print(p.NUMBER, m.version('pkg'), numpy.__file__)"
    )
    ran = subprocess.run(
        [python, "-c", script], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert ran.stdout.split() == ["42", "1", np.__file__]
    assert not list((tmp_path / "venv").rglob("*.data"))
    assert environment.missing_modules(python) == []


def test_a_kit_for_another_python_says_so(tmp_path):
    (tmp_path / "COMMIT").write_text("abc1234\n")
    (tmp_path / "PYTHON_VERSION").write_text("3.2\n")
    shutil.copy(ROOT / "tests/gpu_kit/run.sh", tmp_path)
    ran = subprocess.run(
        ["sh", tmp_path / "run.sh"],
        env={**os.environ, "PYTHON": sys.executable},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 1
    assert "for Python 3.2" in ran.stderr
    assert f"PYTHON_VERSION=3.{sys.version_info.minor}" in ran.stderr


def test_variables_name_what_is_there(tmp_path, monkeypatch):
    monkeypatch.setenv("LD_LIBRARY_PATH", "/elsewhere")
    monkeypatch.setattr(environment, "vendor_files", lambda: ["/a.json", "/b.json"])
    folders = (str(tmp_path), str(tmp_path / "none"))
    monkeypatch.setattr(environment, "DRIVER_FOLDERS", folders)
    monkeypatch.delenv("__EGL_VENDOR_LIBRARY_FILENAMES", raising=False)
    python = tmp_path / "venv/bin/python"
    common = {"python": python, "commit": "abc1234"}
    own = environment.variables(**common, loaders=Path("/gl"), native=tmp_path / "l")
    assert own["OCUFILTER_COMMIT"] == "abc1234"
    assert own["LD_LIBRARY_PATH"] == f"/gl:/elsewhere:{tmp_path}"
    assert own["OCUFILTER_LIBRARY_DIR"] == str(tmp_path / "l")
    assert own["__EGL_VENDOR_LIBRARY_FILENAMES"] == "/a.json:/b.json"
    assert own["PATH"].startswith(str(python.parent) + ":")
    bare = environment.variables(**common, loaders=None, native=None)
    assert bare["LD_LIBRARY_PATH"] == f"/elsewhere:{tmp_path}"
    assert "GLCONTEXT_LINUX_LIBEGL" not in bare


def test_the_machine_is_asked_for_its_libraries():
    assert environment.loads("libc.so.6")
    assert not environment.loads("libNoneSuch.so.1")


@pytest.mark.parametrize("module", ["harness", "training"])
def test_a_copy_without_history_tells_its_commit(module, monkeypatch):
    from tests.benchmarks import harness
    from training import versions

    monkeypatch.setenv("OCUFILTER_COMMIT", "abc1234")
    told = {"harness": harness, "training": versions}[module].commit_id()
    assert told == "abc1234"
