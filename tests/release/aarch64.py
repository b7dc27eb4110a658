"""The native engine for aarch64 under emulation, compared with that of this machine.

    python -m tests.release.aarch64 WHEEL_AARCH64 WHEEL_X86_64 [TEST_FILE ...]

Frames and PSFs are computed by the library of each wheel, x86-64 with its portable
variant, which is the only one on aarch64.  Prints the largest differences.  With test
files, pytest also runs these with the emulated library in place of the native one.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

from estimator.native import core
from estimator.native import library as native
from estimator.psf.compiled import compiled_psfs
from estimator.threads import THREADS_VARIABLE, thread_count
from filter_service.native import loops
from filter_service.psfs.compute_kernels import psf_engine
from filter_service.psfs.native_psfs import native_psfs
from filter_service.rendering.native import NativeRenderer
from tests.conftest import Engine
from tests.numerical import test_native_psfs as psf_cases
from tests.numerical import test_native_random as frame_cases
from tests.numerical.one_kernel import OneKernelBench
from tests.release.build import COMPILERS
from tests.release.commands import BUILD, Failed, run, say
from tests.release.emulated import Emulator

EMULATOR = "qemu-aarch64-static"
LIBRARIES = ("estimator/native/_core.so", "filter_service/native/_loops.so")
CACHED = (
    *(core, loops, native.shared_threads, compiled_psfs, native_psfs, psf_engine),
)
"""Functions that keep what they loaded."""

SYSTEM = Path("/usr/aarch64-linux-gnu")  # glibc for aarch64, of libc6-dev-arm64-cross

FRAMES = [
    {"size": size, "radius_px": radius_px, "accumulation": rule, "seed": seed}
    for seed, (size, radius_px, rule) in enumerate(
        [
            ((1, 1), 0, "coverage"),
            ((1, 45), 3, "coverage"),
            ((45, 1), 14, "paper"),
            ((17, 33), 1, "coverage"),
            ((32, 32), 7, "paper"),
            ((45, 45), 14, "coverage"),
            ((90, 160), 24, "coverage"),
            ((90, 160), 48, "paper"),
        ]
    )
]
"""Odd sizes, single rows and columns, both rules, kernels with coarse pixels."""

MAX_LIGHT_DIFFERENCE = 1e-4  # of white; 8 bits resolve 4e-3
MAX_KERNEL_DIFFERENCE = 0.01  # as between the variants of x86-64, see the tests


def unpack(wheel: Path, name: str) -> Path:
    """Extract the libraries from a wheel; return their folder."""
    folder = BUILD / "aarch64" / f"libraries-{name}"
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel) as archive:
        for library in LIBRARIES:
            (folder / Path(library).name).write_bytes(archive.read(library))
    return folder


@contextlib.contextmanager
def using(folder: Path) -> Iterator[None]:
    """Use the portable variant of the libraries in a folder."""
    variables = {
        native.FOLDER_VARIABLE: str(folder),
        native.VARIANT_VARIABLE: "portable",
        THREADS_VARIABLE: "1",
    }
    thread_count.cache_clear()
    with mock.patch.dict(os.environ, variables):
        for function in CACHED:
            function.cache_clear()
        yield
    thread_count.cache_clear()
    for function in CACHED:
        function.cache_clear()


@contextlib.contextmanager
def emulated(wheel: Path) -> Iterator[Emulator]:
    """Use the libraries of a wheel for aarch64, under emulation."""
    driver = BUILD / "aarch64" / "driver"
    folder = unpack(wheel, "aarch64")
    source = Path(__file__).with_name("emulated.c")
    flags = ("-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror")
    run(COMPILERS["aarch64"], *flags, source, "-o", driver, "-ldl")
    paths = [folder / Path(library).name for library in LIBRARIES]
    process = Emulator(EMULATOR, "-L", SYSTEM, driver, libraries=paths)
    with (
        mock.patch.object(native.ctypes, "CDLL", process.library),
        mock.patch.object(native, "function_at", process.function_at),
        using(folder),
    ):
        yield process
    process.close()


def render(case: dict) -> np.ndarray:
    """Filter a random frame; return the light."""
    rng = np.random.default_rng(case["seed"])
    height_px, width_px = case["size"]
    kernel = frame_cases.random_kernel(rng, case["radius_px"])
    bench = OneKernelBench(
        Engine("native"),
        kernel,
        width_px=width_px,
        height_px=height_px,
        spread_px=float(case["radius_px"]),
    )
    parts = {"distances_m": frame_cases.DISTANCES_M, "patch_px": 5}
    view = frame_cases.random_view(rng, bench, parts)
    renderer = NativeRenderer(n_threads=1)
    seen = renderer.render(
        view,
        renderer.load(bench.store),
        accumulation=case["accumulation"],
        **frame_cases.STATE,
    )
    renderer.close()
    return np.asarray(seen.color, float)


def kernels() -> list[np.ndarray]:
    """Compute PSFs of random wavefronts, by rays and by waves."""
    rng = np.random.default_rng(6)
    found = []
    for rms_um in (0.05, 0.5, 2.0, 4.0):
        wavefronts = psf_cases.wavefronts_of(psf_cases.random_zernike(rng, 4, rms_um))
        packed, *_ = psf_cases.computed(wavefronts)
        found += [psf_cases.kernel(packed, k) for k in range(12)]
    return found


def compare(wheel: Path, x86_64: Path) -> dict[str, float]:
    """Return the largest differences between the libraries of two wheels.

    Raises
    ------
    Failed
        If they exceed the limits.
    """
    with using(unpack(x86_64, "x86_64")):
        expected = [render(case) for case in FRAMES], kernels()
    with emulated(wheel) as process:
        seen = [render(case) for case in FRAMES], kernels()
    if not all(np.isfinite(light).all() for light in seen[0]):
        raise Failed("aarch64: non-finite light")
    light = max(
        float(np.abs(a - b).max()) for a, b in zip(expected[0], seen[0], strict=True)
    )
    errors = [
        psf_cases.error_ratio(theirs, ours)
        for ours, theirs in zip(expected[1], seen[1], strict=True)
    ]
    result = {
        "frames": len(FRAMES),
        "light": light,
        "psfs": len(errors),
        "psf": float(max(errors)),
        "calls": process.call_count,
    }
    if light > MAX_LIGHT_DIFFERENCE or result["psf"] > MAX_KERNEL_DIFFERENCE:
        raise Failed(f"aarch64 differs from x86-64: {result}")
    return result


def main() -> None:
    """Compare two wheels; run tests with the emulated library."""
    if shutil.which(EMULATOR) is None:
        raise SystemExit(f"{EMULATOR} is missing; run sh setup.sh release")
    aarch64, x86_64, *tests = sys.argv[1:]
    print(compare(Path(aarch64), Path(x86_64)))
    if tests:
        import pytest

        say(f"running {' '.join(tests)} with the emulated library")
        with emulated(Path(aarch64)):
            raise SystemExit(pytest.main([*tests, "-q", "-p", "no:cacheprovider"]))


if __name__ == "__main__":
    main()
