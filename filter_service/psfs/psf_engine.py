"""Who computes the PSFs of a cache: the GPU where there is one, else all CPU cores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

from estimator.psf.compute import PsfBatch, compute_psf_batch
from filter_service.constants import PSF_ENGINES
from filter_service.errors import RenderFailed
from filter_service.gl.gpu import Gpu
from filter_service.gl.hardware import may_have_gpu
from filter_service.psfs.gpu_build import gpu_psf_batch
from filter_service.psfs.gpu_build_pace import Pace
from filter_service.psfs.native_psfs import NativePsfs, native_psfs

CPU_BATCH = 768
NATIVE_BATCH = 1024
GPU_BATCH = 8192
"""PSFs computed between two looks at progress and cancellation: about 0.05 s of two
cores; the GPU's number is a guess, for none was at hand."""


@dataclass(frozen=True)
class PsfEngine:
    """A way to compute PSFs.

    Attributes
    ----------
    name : "cpu" or "gpu"
    compute : callable
        As `estimator.psf.compute.compute_psf_batch`.
    batch_count : int
        PSFs to ask for at a time.
    native : NativePsfs, optional
        Computes packed kernels instead, where it can.
    """

    name: str
    compute: Callable[..., PsfBatch]
    batch_count: int
    native: NativePsfs | None = None


PYTHON = PsfEngine("cpu", compute_psf_batch, CPU_BATCH)
"""Where the package was installed without a C compiler."""


@cache
def cpu_engine() -> PsfEngine:
    """Return the compiled engine, or `PYTHON` where it was not built."""
    native = native_psfs()
    if native is None:
        return PYTHON
    return PsfEngine("cpu", compute_psf_batch, NATIVE_BATCH, native)


@cache
def psf_engine(choice: str = "auto") -> PsfEngine:
    """Return the engine of a choice; the process keeps it and its GPU context.

    Parameters
    ----------
    choice : "auto", "cpu" or "gpu"
        "auto" takes a hardware GPU where there is one: beside a software renderer the
        compiled loops of the CPU are two to four times as fast.

    Raises
    ------
    ValueError
        Another choice.
    filter_service.errors.RenderFailed
        "gpu" without OpenGL 4.3.
    """
    if choice not in PSF_ENGINES:
        raise ValueError(f"psf_engine {choice!r}: allowed are {', '.join(PSF_ENGINES)}")
    if choice == "cpu" or (choice == "auto" and not may_have_gpu()):
        return cpu_engine()
    try:
        gpu = Gpu()
    except RenderFailed:
        if choice == "gpu":
            raise
        return cpu_engine()
    if choice == "auto" and gpu.is_software:
        gpu.close()
        return cpu_engine()
    return PsfEngine("gpu", partial(_computed_on, gpu, Pace()), GPU_BATCH)


def _computed_on(
    gpu: Gpu, pace: Pace, *arguments, diffraction: bool = True, **options
) -> PsfBatch:
    with gpu.context:
        return gpu_psf_batch(
            gpu, *arguments, diffraction=diffraction, pace=pace, **options
        )
