"""How the PSFs of a cache are computed: in C, or in Python without a C compiler.

Not on a GPU: beside an H200, 16 cores compute the paper's set of 201,825 PSFs in C in
0.64 s; compute shaders took 3.2 s, and three to five times the processor time, as each
PSF has to be surveyed before it is dispatched.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from estimator.psf.compute import PsfBatch, compute_psf_batch
from filter_service.psfs.native_psfs import NativePsfs, native_psfs

PYTHON_BATCH = 768
NATIVE_BATCH = 1024
"""PSFs computed between two looks at progress and cancellation: about 0.05 s of two
cores."""


@dataclass(frozen=True)
class PsfEngine:
    """A way to compute PSFs.

    Attributes
    ----------
    compute : callable
        As `estimator.psf.compute.compute_psf_batch`.
    batch_count : int
        PSFs to ask for at a time.
    native : NativePsfs, optional
        Computes packed kernels instead, where it can.
    """

    compute: Callable[..., PsfBatch]
    batch_count: int
    native: NativePsfs | None = None


PYTHON = PsfEngine(compute_psf_batch, PYTHON_BATCH)
"""Where the package was installed without a C compiler."""


@cache
def psf_engine() -> PsfEngine:
    """Return the compiled engine, or `PYTHON` where it was not built."""
    native = native_psfs()
    if native is None:
        return PYTHON
    return PsfEngine(compute_psf_batch, NATIVE_BATCH, native)
