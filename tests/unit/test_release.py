"""Checks of a release find what they look for."""

import shutil
import struct
import zipfile

import pytest

from tests.release import __main__ as release
from tests.release import build, contents, pythons
from tests.release.commands import Failed

pytestmark = pytest.mark.tools

WHEEL = "ocufilter-0-py3-none-manylinux_2_28_x86_64.whl"


def write_wheel(path, names, machine=62):
    head = b"\x7fELF".ljust(18, b"\0") + struct.pack("<H", machine)
    with zipfile.ZipFile(path, "w") as archive:
        for name in names:
            archive.writestr(name, head)
    return path


def complete():
    return contents.expected_files() | contents.LIBRARIES


def test_a_complete_wheel_passes(tmp_path):
    contents.check_wheel(write_wheel(tmp_path / WHEEL, complete()))


def test_a_wheel_without_a_library_fails(tmp_path):
    names = complete() - {"filter_service/native/_loops.so"}
    with pytest.raises(Failed, match=r"missing .*_loops\.so"):
        contents.check_wheel(write_wheel(tmp_path / WHEEL, names))


def test_a_wheel_with_a_file_too_many_fails(tmp_path):
    names = complete() | {"tests/conftest.py"}
    with pytest.raises(Failed, match=r"surplus .*conftest"):
        contents.check_wheel(write_wheel(tmp_path / WHEEL, names))


def test_a_library_for_another_processor_fails(tmp_path):
    path = write_wheel(tmp_path / WHEEL, complete(), contents.MACHINES["aarch64"])
    with pytest.raises(Failed, match="another processor"):
        contents.check_wheel(path)


def test_a_wheel_for_one_python_fails(tmp_path):
    name = "ocufilter-0-cp311-cp311-manylinux_2_28_x86_64.whl"
    with pytest.raises(Failed, match="not for every Python"):
        contents.check_wheel(write_wheel(tmp_path / name, complete()))


def test_builds_that_differ_are_named(tmp_path):
    folders = [tmp_path / "first", tmp_path / "second"]
    for folder in folders:
        folder.mkdir()
        (folder / "same.whl").write_bytes(b"1")
        (folder / "other.whl").write_bytes(folder.name.encode())
    builds = [sorted(folder.iterdir()) for folder in folders]
    with pytest.raises(Failed, match=r"differ: other\.whl$"):
        build.compare(*builds)
    shutil.copy(folders[0] / "other.whl", folders[1])
    build.compare(*builds)


def test_oldest_dependencies_are_those_of_no_extra(tmp_path):
    path = tmp_path / WHEEL
    lines = ["Requires-Dist: numpy>=1.26", 'Requires-Dist: av; extra == "clients"']
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("ocufilter-0.dist-info/METADATA", "\n".join(lines))
    assert pythons.oldest_dependencies(path) == ["numpy>=1.26"]


def test_the_checklist_separates_what_passed_from_what_remains(tmp_path):
    sdist = tmp_path / "ocufilter-1.tar.gz"
    sdist.touch()
    row = {"python": "3.12", "dependencies": "oldest", "errors": ["web_s: no\nmore"]}
    checks = ["the contents are complete", "metadata: no license chosen (add LICENSE)"]
    text = release.checklist("1234", [sdist], checks, [row])
    passed, to_do = text.split("## To do")
    assert "- [x] the contents are complete" in passed
    assert "license" not in passed
    assert "- [ ] metadata: no license chosen (add LICENSE)" in to_do
    assert "- [ ] failed: Python 3.12, oldest: web_s: no\n" in to_do
    assert "- [ ] test with Python 3.11: none here" in to_do
    assert "3.12: none here" not in to_do
