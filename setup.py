"""Packages and C libraries; pyproject.toml contains all other metadata.

`ctypes` loads the libraries, which use neither Python's headers nor its functions.  One
wheel of a platform therefore serves every Python version.
"""

import os
import shlex
import sys
from glob import glob

from setuptools import Extension, find_packages, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

CORE = "estimator/native/source"
FRAMES = "filter_service/native/source"
LAYER = "clients/openxr_layer/source"
FLAGS = ["-std=gnu11", "-g0", "-fvisibility=hidden"]
WITHOUT = {
    "estimator.native._core": (
        "PSFs will be computed in Python, ten times as slow, and frames filtered with "
        "OpenGL.  Install a C compiler (Debian: apt install gcc libc6-dev)"
    ),
    "filter_service.native._loops": (
        "the native engine is missing: frames will be filtered with OpenGL, which is "
        "slow without a GPU.  Install a C compiler (Debian: apt install gcc libc6-dev)"
    ),
    "filter_service.service._drop_parts": (
        "the service will take ten times as long to drop messages with millions of "
        "parts.  Install a C compiler (Debian: apt install gcc libc6-dev)"
    ),
    "clients.openxr_layer._layer": (
        "`ocufilter layer` will not work.  Install a C compiler and headers (Debian: "
        "apt install gcc libc6-dev libopenxr-dev libgl-dev libegl-dev libx11-dev)"
    ),
}


class BuildLibraries(build_ext):
    """Compile libraries named without a Python version, and say which are missing."""

    def get_ext_filename(self, fullname):
        """Return the path of a library."""
        return os.path.join(*fullname.split(".")) + ".so"

    def build_extensions(self):
        """Compile with the flags of `CFLAGS` and `LDFLAGS`, but not Python's own.

        Those differ between installations of Python, and so would the libraries.
        """
        if sys.platform == "linux":
            cc = shlex.split(os.environ.get("CC", "cc"))
            link = shlex.split(os.environ.get("LDSHARED", "")) or [*cc, "-shared"]
            flags = shlex.split(os.environ.get("CFLAGS", ""))
            self.compiler.set_executables(
                compiler_so=[*cc, "-fPIC", "-fwrapv", "-DNDEBUG", *flags],
                linker_so=[*link, *shlex.split(os.environ.get("LDFLAGS", ""))],
            )
            self.compiler.include_dirs = []
            self.compiler.library_dirs = []
        super().build_extensions()
        for extension in self.extensions:
            path = self.get_ext_fullpath(extension.name)
            if not os.path.exists(path):
                name = extension.name.rpartition(".")[2]
                remedy = f"{WITHOUT[extension.name]}, and install ocufilter again."
                print(f"ocufilter: {name} was not built; {remedy}", file=sys.stderr)


def loops(name, folder, include_dirs=()):
    """Return the extension of a library of loops."""
    return Extension(
        name,
        sources=sorted(glob(f"{folder}/*.c")),
        depends=sorted(
            header for own in (folder, *include_dirs) for header in glob(f"{own}/*.h")
        ),
        include_dirs=list(include_dirs),
        libraries=["m"],
        extra_compile_args=[
            *FLAGS,
            "-O3",
            "-pthread",
            "-fno-math-errno",
            "-fno-trapping-math",
            "-Wno-psabi",
        ],
        extra_link_args=["-pthread"],
        optional=True,
    )


class AnyPythonWheel(bdist_wheel):
    """Tag the wheel for any Python 3 on this platform."""

    def get_tag(self):
        """Return the wheel's tag."""
        return "py3", "none", super().get_tag()[2]


setup(
    cmdclass={"bdist_wheel": AnyPythonWheel, "build_ext": BuildLibraries},
    packages=[
        *find_packages(include=["clients*", "estimator*", "filter_service*"]),
        # part of filter_service in a wheel, but a top-level folder in a checkout
        "filter_service.shaders",
        "filter_service.shaders.common",
        "filter_service.shaders.draws",
        "filter_service.shaders.passes",
    ],
    package_dir={"filter_service.shaders": "shaders"},
    # All libraries are optional and loaded by path.  Without a C compiler, the engine
    # is gl, and dropping messages with millions of parts takes ten times as long.
    # Without the headers of OpenXR, OpenGL and X11, `ocufilter layer` says what to do.
    ext_modules=[
        loops("estimator.native._core", CORE),
        loops("filter_service.native._loops", FRAMES, [CORE]),
        Extension(
            "filter_service.service._drop_parts",
            sources=["filter_service/service/drop_parts.c"],
            extra_compile_args=[*FLAGS, "-O2"],
            optional=True,
        ),
        Extension(
            "clients.openxr_layer._layer",
            sources=sorted(glob(f"{LAYER}/*.c")),
            depends=sorted(glob(f"{LAYER}/*.h")),
            libraries=["dl"],
            extra_compile_args=[*FLAGS, "-O2", "-pthread"],
            extra_link_args=["-pthread"],
            optional=True,
        ),
    ],
)
