"""Packages and C libraries; pyproject.toml contains all other metadata.

`ctypes` loads the libraries, which use neither Python's headers nor its functions.  One
wheel of a platform therefore serves every Python version.
"""

import importlib.util
import os
import shlex
import shutil
import sys
from glob import glob

from setuptools import Extension, find_packages, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

CORE = "estimator/native/source"
FRAMES = "filter_service/native/source"
LAYER = "clients/openxr_layer/source"
FLAGS = ["-std=gnu11", "-g0", "-fvisibility=hidden"]
COMPILER = "a C compiler (Debian: apt install gcc libc6-dev; or pip install ziglang)"
WITHOUT = {
    "estimator.native._core": f"install {COMPILER}",
    "filter_service.native._loops": f"install {COMPILER}",
    "filter_service.service._drop_parts": (
        "the service will take ten times as long to drop messages with millions of "
        f"parts; install {COMPILER}"
    ),
    "clients.openxr_layer._layer": (
        "`ocufilter layer` will not work; install a C compiler and headers (Debian: "
        "apt install gcc libc6-dev libopenxr-dev libgl-dev libegl-dev libvulkan-dev "
        "libx11-dev)"
    ),
}
"""Libraries, and what to do where one cannot be compiled."""


REQUIRED = ("estimator.native._core", "filter_service.native._loops")


def compiler():
    """Return the command of the C compiler: ``CC``, `cc`, or that of `ziglang`."""
    cc = shlex.split(os.environ.get("CC", "cc"))
    if shutil.which(cc[0]) is None and importlib.util.find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]
    return cc


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
            cc = compiler()
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
            if not os.path.exists(self.get_ext_fullpath(extension.name)):
                name = extension.name.rpartition(".")[2]
                said = f"ocufilter: {name} was not built: {WITHOUT[extension.name]}"
                if extension.name in REQUIRED:
                    raise SystemExit(f"{said}, and install ocufilter again")
                print(said, file=sys.stderr)


def loops(name, folder, include_dirs=()):
    """Return the extension of a library of loops."""
    return Extension(
        name,
        sources=sorted(glob(f"{folder}/*.c")),
        depends=sorted(
            header for own in (folder, *include_dirs) for header in glob(f"{own}/*.h")
        ),
        include_dirs=[folder, *include_dirs],
        libraries=["m"],
        extra_compile_args=[
            *FLAGS,
            "-O3",
            "-falign-functions=64",  # the same loop took 12 % longer at other addresses
            "-falign-loops=32",
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


IS_EDITABLE = "editable_wheel" in sys.argv
SHADERS = ("", ".common", ".draws", ".passes")
"""Packages in `filter_service.shaders`, which is a top-level folder in a checkout.

An editable installation has none of them: it puts the checkout on Python's path.  With
packages that are elsewhere, setuptools would install a finder instead, to which Python
prefers any folder named ``ocufilter``, such as a clone in the folder of a script.
"""

setup(
    cmdclass={"bdist_wheel": AnyPythonWheel, "build_ext": BuildLibraries},
    packages=[
        *find_packages(
            include=["clients*", "estimator*", "filter_service*", "ocufilter"]
        ),
        *(() if IS_EDITABLE else (f"filter_service.shaders{name}" for name in SHADERS)),
    ],
    package_dir={"": "."} if IS_EDITABLE else {"filter_service.shaders": "shaders"},
    # Libraries are loaded by path.  All are marked as optional so that the build goes
    # on to the end, where `BuildLibraries` says what is missing.
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
