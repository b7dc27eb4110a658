"""PSF engine in C."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import Core, core, shared_threads
from estimator.native.records import (
    PSF_DONE,
    PSF_NO_MEMORY,
    PsfJob,
    pointer_to,
)
from estimator.psf.fourier import ACCURACY, FourierAccuracy
from estimator.psf.tables import GEOMETRIC_FROM_DB, psf_tables
from estimator.threads import call_after_fork

SIDES = 4


@dataclass(frozen=True)
class ComputedKernels:
    """Kernels (n,) of one call.

    Attributes
    ----------
    words : (n_texels,), uint16
        Kernels one after the other; see `filter_service.psfs.pack`.
    sizes : (n,)
        Texels of each kernel; 0 if the engine does not support the PSF.
    reach_px : (n, 4)
        Columns to the left and right, rows up and down.
    radius_px : (n,)
    peak_ratio, spread_px, lost_ratio : (n,)
    rays_ratio : (n,)
        Share that ray optics computed.
    is_done : (n,), bool
    """

    words: NDArray[np.uint16]
    sizes: NDArray[np.int64]
    reach_px: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    spread_px: NDArray[np.float64]
    lost_ratio: NDArray[np.float64]
    rays_ratio: NDArray[np.float64]
    is_done: NDArray[np.bool_]


@dataclass(frozen=True)
class CompiledPsfs:
    """The compiled engine and its threads.

    Attributes
    ----------
    core : Core
    threads : int
        Handle of the thread pool.
    """

    core: Core
    threads: int

    def compute(
        self,
        arrays: dict[str, NDArray[np.float64]],
        nodes: NDArray[np.int64],
        groups: NDArray[np.int64],
        channels: NDArray[np.int64],
        *,
        ring_tables: NDArray[np.float32] | None = None,
        rays_from_db: float = GEOMETRIC_FROM_DB,
        accuracy: FourierAccuracy = ACCURACY["normal"],
        **numbers: Any,
    ) -> ComputedKernels:
        """Compute the kernels of PSFs (n,).

        Parameters
        ----------
        arrays : dict
            Double arrays of the record, by their names in `psf_job.h`.
        nodes, groups, channels : (n,)
            Wavefront, pixel scale and color of each PSF.
        ring_tables : (3, n_primaries, n_rings, 2), optional
        rays_from_db : float
            Predicted PSNR from which ray optics is used.
        accuracy : FourierAccuracy
        **numbers
            Other fields of the record.

        Raises
        ------
        MemoryError
        """
        kept: dict[str, NDArray[np.generic]] = {
            name: np.ascontiguousarray(array, np.float64)
            for name, array in arrays.items()
        }
        kept["nodes"] = np.ascontiguousarray(nodes, np.int64)
        kept["groups"] = np.ascontiguousarray(groups, np.int64)
        kept["channels"] = np.ascontiguousarray(channels, np.int64)
        if ring_tables is not None:
            kept["ring_tables"] = np.ascontiguousarray(ring_tables, np.float32)
        count = groups.size
        reach_px = np.zeros((count, SIDES), np.int64)
        radius_px, sizes = np.zeros((2, count), np.int64)
        peak, spread, lost, rays = np.zeros((4, count))
        outcome = np.empty(count, np.int32)
        tables, _ = psf_tables(
            kept["zernike_um"].shape[-1],
            filter_half_width=accuracy.filter_half_width,
            rays_from_db=rays_from_db,
        )
        job = PsfJob(
            threads=self.threads,
            tables=ctypes.addressof(tables),
            **{name: pointer_to(array) for name, array in kept.items()},
            oversampling=accuracy.oversampling,
            margin=accuracy.margin,
            min_samples_per_px=accuracy.min_samples_per_px,
            **numbers,
            reach_px=pointer_to(reach_px),
            radius_px=pointer_to(radius_px),
            sizes=pointer_to(sizes),
            peak_ratio=pointer_to(peak),
            spread_px=pointer_to(spread),
            lost_ratio=pointer_to(lost),
            rays_ratio=pointer_to(rays),
            outcome=pointer_to(outcome),
            count=count,
        )
        words = self._words(job, outcome, sizes)
        return ComputedKernels(
            words,
            sizes,
            reach_px,
            radius_px,
            peak,
            spread,
            lost,
            rays,
            outcome == PSF_DONE,
        )

    def call(
        self, name: str, polynomials: NDArray[np.float64], *arrays: NDArray[np.float64]
    ) -> None:
        """Call a function of pupils: of threads, tables, a count and arrays.

        The first array is polynomials (count, n_terms).
        """
        count, n_terms = polynomials.shape
        tables, _ = psf_tables(n_terms, pupils_only=True)
        self.core.call(name, self.threads, tables, count, polynomials, *arrays)

    def _words(
        self, job: PsfJob, outcome: NDArray[np.int32], sizes: NDArray[np.int64]
    ) -> NDArray[np.uint16]:
        """Compute PSFs; return their concatenated kernels."""
        is_done = self.core.call("psfs", job)
        words = None
        try:
            if not is_done or (outcome == PSF_NO_MEMORY).any():
                raise MemoryError("no memory for PSFs")
            words = np.empty(int(sizes.sum()), np.uint16)
        finally:
            self.core.call("take_psfs", job, words)
        return words


@cache
def compiled_psfs() -> CompiledPsfs:
    """Return the engine of this process.

    Raises
    ------
    LibraryUnavailable
        If the core was not built.
    """
    return CompiledPsfs(core(), shared_threads())


call_after_fork(compiled_psfs.cache_clear)
