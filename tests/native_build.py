"""Builds the C libraries as the package does, or with other flags."""

import contextlib
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest import mock

from tests.source_tree import ROOT

COMPILER = shutil.which("cc") or shutil.which("gcc")


LIBRARIES = ("_core", "_loops")
"""Libraries of loops, which `OCUFILTER_LIBRARY_DIR` may select from another folder."""


def extension(ending):
    """An extension module as setup.py has it."""
    given = {}
    stand_in = ModuleType("setuptools")  # a bare machine may not have it
    stand_in.Extension = lambda name, **options: SimpleNamespace(name=name, **options)
    stand_in.find_packages = lambda **_: []
    stand_in.setup = given.update
    modules = {"setuptools": stand_in}
    for name in ("bdist_wheel", "build_ext"):
        modules[f"setuptools.command.{name}"] = ModuleType(name)
        setattr(modules[f"setuptools.command.{name}"], name, object)
    with mock.patch.dict(sys.modules, modules), contextlib.chdir(ROOT):
        runpy.run_path("setup.py")
    modules = given["ext_modules"]
    return next(module for module in modules if module.name.endswith(ending))


def build_library(ending: str, folder: Path, *flags: str, source=ROOT) -> Path:
    """Compile a library, with flags behind the package's; ``source`` is a tree."""
    own = extension(ending)
    out = folder / f"{ending}.so"
    subprocess.run(
        [
            *(COMPILER, "-shared", "-fPIC", *own.extra_compile_args, *flags),
            *(f"-I{name}" for name in getattr(own, "include_dirs", ())),
            *("-o", str(out), *own.sources, *own.extra_link_args),
            *(f"-l{name}" for name in own.libraries),
        ],
        cwd=source,
        check=True,
        capture_output=True,
        text=True,
    )
    return out


def build_libraries(folder: Path, *flags: str) -> None:
    """Compile all libraries of loops into a folder."""
    for ending in LIBRARIES:
        build_library(ending, folder, *flags)


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
