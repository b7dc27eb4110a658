"""Build backend of setuptools that also asks for a C compiler where there is none.

The package `ziglang` contains one; setup.py runs it.
"""

import os
import shlex
import shutil
import sys
from glob import glob

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403  (the other hooks)

ZIG = "ziglang>=0.13"


def has_compiler():
    """Return whether the machine has the compiler of ``CC``, or `cc`."""
    return shutil.which(shlex.split(os.environ.get("CC", "cc"))[0]) is not None


def compiler_requirements():
    """Return the packages that compiling takes on this machine."""
    return [] if has_compiler() or sys.platform != "linux" else [ZIG]


def get_requires_for_build_wheel(config_settings=None):
    """Return what building a wheel requires besides ``build-system.requires``."""
    own = build_meta.get_requires_for_build_wheel(config_settings)
    return [*own, *compiler_requirements()]


def get_requires_for_build_editable(config_settings=None):
    """Return what an editable installation requires."""
    own = build_meta.get_requires_for_build_editable(config_settings)
    return [*own, *compiler_requirements()]


def build_wheel(wheel_directory, config_settings=None, metadata_directory=None):
    """Build a wheel, without modules that an earlier build left in ``build``."""
    for folder in glob("build/lib*"):
        shutil.rmtree(folder)
    return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
