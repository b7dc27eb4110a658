"""Packages and C extensions; pyproject.toml contains all other metadata."""

from glob import glob

from setuptools import Extension, find_packages, setup

NATIVE = "filter_service/native/source"
FLAGS = ["-std=gnu11", "-g0", "-fvisibility=hidden"]

setup(
    packages=[
        *find_packages(include=["clients*", "estimator*", "filter_service*"]),
        # part of filter_service in a wheel, but a top-level folder in a checkout
        "filter_service.shaders",
        "filter_service.shaders.common",
        "filter_service.shaders.draws",
        "filter_service.shaders.passes",
    ],
    package_dir={"filter_service.shaders": "shaders"},
    # Both libraries are optional and loaded with ctypes.  Without a C compiler, the
    # engine is gl, and dropping messages with millions of parts takes ten times as
    # long.
    ext_modules=[
        Extension(
            "filter_service.native._loops",
            sources=sorted(glob(f"{NATIVE}/*.c")),
            depends=sorted(glob(f"{NATIVE}/*.h")),
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
        ),
        Extension(
            "filter_service.service._drop_parts",
            sources=["filter_service/service/drop_parts.c"],
            extra_compile_args=[*FLAGS, "-O2"],
            optional=True,
        ),
    ],
)
