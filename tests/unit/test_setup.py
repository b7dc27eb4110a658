"""What installs the project agrees with itself."""

import importlib
import os
import re
import subprocess
import sys
import tomllib

import pytest

from tests.source_tree import ROOT

pytestmark = pytest.mark.tools

PINNED = [
    line.partition("==")[0]
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _required() -> list[str]:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    project = tomllib.loads(text)["project"]
    extras = project["optional-dependencies"]
    listed = [*project["dependencies"], *extras["clients"], *extras["dev"]]
    listed += extras["pyrender"]
    listed += [*extras["peers"], *extras["web"], *extras["web-test"]]
    return [re.match(r"[\w.-]+", requirement)[0] for requirement in listed]


def test_every_requirement_has_a_pin():
    pinned = {_normal(name) for name in PINNED}
    assert [name for name in _required() if _normal(name) not in pinned] == []


def test_a_script_beside_a_clone_imports_the_package(tmp_path):
    (tmp_path / "ocufilter").mkdir()  # as `git clone` names it
    script = tmp_path / "script.py"
    script.write_text("from ocufilter import Camera\nprint(Camera.__name__)\n")
    bare = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    finished = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=bare, capture_output=True, text=True
    )
    assert finished.stdout == "Camera\n", finished.stderr


def test_without_a_compiler_the_build_asks_for_that_of_pypi(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)
    backend = importlib.import_module("build_backend")
    monkeypatch.setenv("CC", sys.executable)
    assert backend.compiler_requirements() == []
    monkeypatch.setenv("CC", "/nonexistent/cc -m64")
    assert backend.compiler_requirements() == [backend.ZIG]
    # setuptools' own writes egg-info to the tree, in which other tests build meanwhile.
    meta = backend.build_meta
    monkeypatch.setattr(meta, "get_requires_for_build_editable", lambda _: ["own"])
    assert backend.get_requires_for_build_editable() == ["own", backend.ZIG]


def test_a_wheel_has_no_modules_of_an_earlier_build(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(ROOT)
    backend = importlib.import_module("build_backend")
    stale = tmp_path / "build/lib.linux-x86_64-cpython-311/estimator/media/__init__.py"
    stale.parent.mkdir(parents=True)
    stale.write_text("")
    (tmp_path / "build/temp").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(backend.build_meta, "build_wheel", lambda *given: given)
    assert backend.build_wheel("dist") == ("dist", None, None)
    assert [path.name for path in (tmp_path / "build").iterdir()] == ["temp"]


@pytest.mark.parametrize("name", ["constraints.txt", "setup.sh", "Makefile", ".ci/run"])
def test_set_up_names_no_host(name):
    assert "://" not in (ROOT / name).read_text(encoding="utf-8")


def test_make_clean_removes_compiled_loops_and_leaves_results(tmp_path):
    kept, removed = "out/demo/video.mp4", "filter_service/native/_loops.abi3.so"
    libraries = ("estimator/native/_core.so", "clients/openxr_layer/_layer.so")
    cached = "estimator/__pycache__/a.nbi"
    for name in (kept, removed, cached, *libraries):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("")
    make = ["make", "-f", ROOT / "Makefile", "clean"]
    subprocess.run(make, cwd=tmp_path, check=True, capture_output=True)
    left = {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()}
    assert left == {kept}
