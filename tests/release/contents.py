"""What must be in a wheel and in the sdist, and what the tools say about them."""

from __future__ import annotations

import re
import struct
import tarfile
import zipfile
from pathlib import Path

from tests.end_to_end.test_wheel import HELD
from tests.release.build import GLIBC
from tests.release.commands import ROOT, TOOLS, Failed, run

LIBRARIES = {
    "estimator/native/_core.so",
    "filter_service/native/_loops.so",
    "filter_service/service/_drop_parts.so",
    "clients/openxr_layer/_layer.so",
}
MACHINES = {"x86_64": 62, "aarch64": 183}  # e_machine of ELF
EXAMPLES = tuple(
    f"examples/**/*.{suffix}"
    for suffix in ("csv", "ipynb", "jpg", "md", "png", "py", "toml")
)
SOURCES = ("setup.py", "pyproject.toml", "README.md", "CHANGELOG.md", "CONVENTIONS.md")


def expected_files() -> set[str]:
    """Return the files of the packages that a wheel must have, without libraries."""
    found = {p.relative_to(ROOT).as_posix() for name in HELD for p in ROOT.glob(name)}
    return {re.sub("^shaders/", "filter_service/shaders/", name) for name in found}


def check_wheel(path: Path, libraries: set[str] = LIBRARIES) -> None:
    """Check the files of a wheel, and the processor of its libraries.

    Raises
    ------
    Failed
        With the names of missing and surplus files.
    """
    with zipfile.ZipFile(path) as archive:
        names = [name for name in archive.namelist() if ".dist-info/" not in name]
        heads = {
            name: archive.read(name)[:20] for name in names if name.endswith(".so")
        }
    expected = expected_files() | libraries
    if set(names) != expected or len(names) != len(expected):
        missing, surplus = expected - set(names), set(names) - expected
        raise Failed(f"{path.name}: missing {missing}, surplus {surplus}")
    processor = next(name for name in MACHINES if path.stem.endswith(name))
    for name, head in heads.items():
        (machine,) = struct.unpack_from("<H", head, 18)
        if machine != MACHINES[processor]:
            raise Failed(f"{path.name}: {name} is for another processor ({machine})")
    if not path.name.split("-", 2)[2].startswith("py3-none-"):
        raise Failed(f"{path.name} is not for every Python 3")


def check_sdist(path: Path) -> None:
    """Check that the sdist has the packages, C sources and examples, and no tests."""
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    patterns = [
        f"{name}/**/*.[ch]" for name in ("clients", "estimator", "filter_service")
    ]
    found = (path for pattern in patterns for path in ROOT.glob(pattern))
    sources = {p.relative_to(ROOT).as_posix() for p in found}
    sources = {name for name in sources if "/node_modules/" not in name}
    files = {p.relative_to(ROOT).as_posix() for n in HELD for p in ROOT.glob(n)}
    examples = {p.relative_to(ROOT).as_posix() for n in EXAMPLES for p in ROOT.glob(n)}
    missing = (sources | files | examples | set(SOURCES)) - names
    surplus = {name for name in names if name.startswith(("tests/", "training/"))}
    if missing or surplus:
        raise Failed(f"{path.name}: missing {missing}, surplus {surplus}")


def audit(wheel: Path) -> str:
    """Return the oldest platform that auditwheel finds a wheel to be compatible with.

    Raises
    ------
    Failed
        If it is newer than the platform in the wheel's name.
    """
    said = " ".join(run(TOOLS / "auditwheel", "show", wheel).split())
    found = re.search(r'platform tag(?: to|:) "manylinux_2_(\d+)_\w+"', said)
    if found is None or int(found[1]) > int(GLIBC.split(".")[1]):
        raise Failed(f"auditwheel: {said}")
    return f"glibc 2.{found[1]}"


def check_description(*paths: Path) -> None:
    """Check with twine that an index can show the description."""
    run(TOOLS / "twine", "--no-color", "check", "--strict", *paths)
