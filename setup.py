"""Packages and C extensions; pyproject.toml contains all other metadata."""

from glob import glob

from setuptools import Extension, find_packages, setup

NATIVE = "filter_service/native/source"
LAYER = "clients/openxr_layer/source"
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
    # All libraries are optional and loaded by path.  Without a C compiler, the engine
    # is gl, and dropping messages with millions of parts takes ten times as long.
    # Without the headers of OpenXR, OpenGL and X11, `ocufilter layer` says what to do.
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
