"""The native engine for aarch64 under emulation, compared with that of this machine.

    python -m tests.release.aarch64 WHEEL_AARCH64 WHEEL_X86_64 [TEST_FILE ...]

Frames and PSFs are computed by the library of each wheel, x86-64 with its portable
variant, which is the only one on aarch64.  Prints the largest differences.  With test
files, pytest also runs these with the emulated library in place of the native one.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np

from filter_service.native import library as native
from filter_service.native.library import Library
from filter_service.psfs.native_psfs import NativePsfs
from filter_service.rendering.native import NativeRenderer
from tests.conftest import Engine
from tests.numerical import test_native_psfs as psf_cases
from tests.numerical import test_native_random as frame_cases
from tests.numerical.one_kernel import OneKernelBench
from tests.release.build import COMPILERS
from tests.release.commands import BUILD, Failed, run, say
from tests.release.emulated import EmulatedLibrary

EMULATOR = "qemu-aarch64-static"
LIBRARY = "filter_service/native/_loops.so"
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
    """Extract the library from a wheel."""
    path = BUILD / "aarch64" / f"loops-{name}.so"
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(wheel) as archive:
        path.write_bytes(archive.read(LIBRARY))
    return path


@contextlib.contextmanager
def emulated(wheel: Path) -> Iterator[EmulatedLibrary]:
    """Make every new `Library` call the functions of a wheel for aarch64."""
    driver = BUILD / "aarch64" / "driver"
    path = unpack(wheel, "aarch64")
    source = Path(__file__).with_name("emulated.c")
    flags = ("-std=gnu11", "-O2", "-Wall", "-Wextra", "-Werror")
    run(COMPILERS["aarch64"], *flags, source, "-o", driver, "-ldl")
    process = EmulatedLibrary(EMULATOR, "-L", SYSTEM, driver, path)
    with mock.patch.object(native.ctypes, "CDLL", return_value=process):
        yield process
    process.close()


def render(library: Library, case: dict) -> np.ndarray:
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
    renderer = NativeRenderer(library, n_threads=1)
    seen = renderer.render(
        view,
        renderer.load(bench.store),
        accumulation=case["accumulation"],
        **frame_cases.STATE,
    )
    renderer.close()
    return np.asarray(seen.color, float)


def kernels(library: Library) -> list[np.ndarray]:
    """Compute PSFs of random wavefronts, by rays and by waves."""
    engine = NativePsfs(library, library.new_threads(1))
    rng = np.random.default_rng(6)
    found = []
    for rms_um in (0.05, 0.5, 2.0, 4.0):
        wavefronts = psf_cases.wavefronts_of(psf_cases.random_zernike(rng, 4, rms_um))
        packed, *_ = psf_cases.computed(wavefronts, engine=engine)
        found += [psf_cases.kernel(packed, k) for k in range(12)]
    library.end_threads(engine.threads)
    return found


def compare(wheel: Path, x86_64: Path) -> dict[str, float]:
    """Return the largest differences between the libraries of two wheels.

    Raises
    ------
    Failed
        If they exceed the limits.
    """
    native.compiled_library()  # of this machine, for what the tests prepare
    plain = Library(unpack(x86_64, "x86_64"), portable=True)
    with emulated(wheel) as process:
        other = Library(unpack(wheel, "aarch64"))
        light = 0.0
        for case in FRAMES:
            expected, seen = render(plain, case), render(other, case)
            if not np.isfinite(seen).all():
                raise Failed(f"aarch64: non-finite light: {case}")
            light = max(light, float(np.abs(seen - expected).max()))
        pairs = list(zip(kernels(other), kernels(plain), strict=True))
        errors = [psf_cases.error_ratio(theirs, ours) for theirs, ours in pairs]
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
        native.compiled_library.cache_clear()
        with emulated(Path(aarch64)):
            raise SystemExit(pytest.main([*tests, "-q", "-p", "no:cacheprovider"]))


if __name__ == "__main__":
    main()
