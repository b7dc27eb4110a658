"""What installs the project agrees with itself."""

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


IMPORTED_TO_COMPILE = """
import sys
from filter_service.building import compile_builds
from filter_service.filtering import compile_loops
from filter_service.rendering import plan_once
for name, module in sys.modules.items():
    if "." not in name and "site-packages" in (getattr(module, "__file__", "") or ""):
        print(name)
"""


def test_loops_are_compiled_with_no_more_than_the_packages_that_come_first():
    setup = (ROOT / "setup.sh").read_text(encoding="utf-8")
    first = re.search(r'^COMPILER_PACKAGES="(.*)"$', setup, re.MULTILINE)[1].split()
    brought_along = {"llvmlite", "glcontext", "typing_extensions"}  # by the others
    brought_along |= {"yaml", "coverage"}  # optional to numba, of `web` and `dev`
    ran = subprocess.run(
        [sys.executable, "-c", IMPORTED_TO_COMPILE],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    found = {name for name in ran.stdout.split() if not name.startswith("_")}
    assert "scipy" in found
    assert found - brought_along <= {name.replace("-", "_") for name in first}


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
