"""Choice of the PSF engine: packed kernels in C, or the ENZ series.

There is no GPU engine.  On a machine with an H200, 16 cores compute the paper's set of
201,825 PSFs in C in 0.64 s.  Compute shaders took 3.2 s and three to five times the
processor time, because each PSF must be surveyed before it is dispatched.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

from estimator.psf.compute import PsfBatch, compute_psf_batch
from estimator.threads import thread_count
from filter_service.psfs.native_psfs import NativePsfs, native_psfs

NATIVE_BATCH = 1024
"""PSFs between checks of progress and cancellation: about 0.05 s on two cores."""


@dataclass(frozen=True)
class PsfEngine:
    """Engine that computes PSFs.

    Attributes
    ----------
    compute : callable
        Function like `estimator.psf.compute.compute_psf_batch`.
    batch_count : int
        PSFs per batch.
    native : NativePsfs, optional
        Engine that computes packed kernels directly, for the PSFs that it supports.
    """

    compute: Callable[..., PsfBatch]
    batch_count: int
    native: NativePsfs | None = None


@cache
def psf_engine(pipeline: str = "exact") -> PsfEngine:
    """Return the engine of a pipeline.

    That of "exact" is the compiled one.  That of "published" is the ENZ series to the
    paper's Zernike degree, also where the aberrations require a higher one.  Its PSFs
    take up to 0.25 s of a core, so there is one for each thread between two checks.
    """
    if pipeline == "published":
        series = partial(compute_psf_batch, method="enz_unchecked")
        return PsfEngine(series, thread_count())
    return PsfEngine(compute_psf_batch, NATIVE_BATCH, native_psfs())
