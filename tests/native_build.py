"""Builds the native engine's loops as the package does, or with other flags."""

import shutil
import subprocess
import tomllib
from pathlib import Path

from tests.source_tree import ROOT

COMPILER = shutil.which("cc") or shutil.which("gcc")


def extension():
    """The extension module of the loops as pyproject.toml has it."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    modules = content["tool"]["setuptools"]["ext-modules"]
    return next(module for module in modules if module["name"].endswith("_loops"))


def build_library(folder: Path, *flags: str) -> Path:
    """Compile the sources into a shared library; flags come behind the package's."""
    own = extension()
    out = folder / "loops.so"
    subprocess.run(
        [
            *(COMPILER, "-shared", "-fPIC", *own["extra-compile-args"], *flags),
            *("-o", str(out), *own["sources"], *own["extra-link-args"]),
            *(f"-l{name}" for name in own["libraries"]),
        ],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    return out


def runtime_of(sanitizer: str) -> Path | None:
    """The compiler's library of a sanitizer; None where it has none."""
    name = {"thread": "libtsan.so"}.get(sanitizer, "libasan.so")
    found = subprocess.run(
        [COMPILER, f"-print-file-name={name}"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    return Path(found) if Path(found).is_absolute() else None
