"""Builds the native engine's loops as the package does, or with other flags."""

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


def extension(ending="_loops"):
    """The extension module of the loops, or another one, as setup.py has it."""
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


def build_library(folder: Path, *flags: str) -> Path:
    """Compile the sources into a shared library; flags come behind the package's."""
    own = extension()
    out = folder / "loops.so"
    subprocess.run(
        [
            *(COMPILER, "-shared", "-fPIC", *own.extra_compile_args, *flags),
            *("-o", str(out), *own.sources, *own.extra_link_args),
            *(f"-l{name}" for name in own.libraries),
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
