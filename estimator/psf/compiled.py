"""PSF engine in C: one call computes packed kernels from wavefronts."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field
from functools import cache
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import Core, LibraryUnavailable, core
from estimator.native.records import (
    PSF_DONE,
    PSF_NO_MEMORY,
    PsfJob,
    PsfTables,
    pointer_to,
)
from estimator.optics.zernike import N_TERMS, inverse_monomial_matrix, monomial_matrix
from estimator.psf import fourier, geometric, geometric_kernels, pupil, survey, switch
from estimator.psf import fourier_kernels as waves
from estimator.threads import thread_count

FILTER_COUNT = 256
"""Largest number of samples per pixel with a tabulated filter: pixels of 14 mrad,
pupils of 8 mm."""

VECTOR = 8
SIDES = 4


def fft_lengths() -> NDArray[np.int64]:
    """Return the FFT lengths that the engine supports: multiples of eight."""
    lengths: NDArray[np.int64] = fourier.FAST_LENGTHS
    supported: NDArray[np.int64] = lengths[lengths % VECTOR == 0]
    return supported


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
    lock : Lock
        Held by the call that uses the handle.
    """

    core: Core
    threads: int
    lock: Lock = field(default_factory=Lock)

    def compute(
        self,
        arrays: dict[str, NDArray[np.float64]],
        groups: NDArray[np.int64],
        channels: NDArray[np.int64],
        *,
        ring_tables: NDArray[np.float32] | None = None,
        **numbers: Any,
    ) -> ComputedKernels:
        """Compute the kernels of PSFs (n,).

        Parameters
        ----------
        arrays : dict
            Double arrays of the record, by their names in `psf_job.h`.
        groups, channels : (n,)
            Group and channel of each PSF.
        ring_tables : (3, n_primaries, n_rings, 2), optional
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
        kept["groups"] = np.ascontiguousarray(groups, np.int64)
        kept["channels"] = np.ascontiguousarray(channels, np.int64)
        if ring_tables is not None:
            kept["ring_tables"] = np.ascontiguousarray(ring_tables, np.float32)
        count = groups.size
        reach_px = np.zeros((count, SIDES), np.int64)
        radius_px, sizes = np.zeros((2, count), np.int64)
        peak, spread, lost, rays = np.zeros((4, count))
        outcome = np.empty(count, np.int32)
        tables, _ = _tables()
        job = PsfJob(
            threads=self.threads,
            tables=ctypes.addressof(tables),
            **{name: pointer_to(array) for name, array in kept.items()},
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
        with self.lock:
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
def compiled_psfs() -> CompiledPsfs | None:
    """Return the engine of this process, or None if the library is missing."""
    try:
        library = core()
    except LibraryUnavailable:
        return None
    return CompiledPsfs(library, library.new_threads(thread_count()))


def _with_changes(
    table: NDArray[np.float32] | NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return entries (n, 2) of a table (n,): values, and differences to the next."""
    return np.stack([table, np.diff(table, append=table[-1])], axis=1).astype(
        np.float32
    )


@cache
def _tables() -> tuple[PsfTables, dict[str, NDArray[np.generic]]]:
    """Return the tables of `estimator.psf`, and the arrays that they point to."""
    half_width = fourier.ACCURACY["normal"].filter_half_width
    filters = [fourier.pixel_filter(k + 1, half_width) for k in range(FILTER_COUNT)]
    stride = -(-filters[-1].size // VECTOR) * VECTOR
    table = np.zeros((FILTER_COUNT, stride), np.float32)
    for row, weights in zip(table, filters, strict=True):
        row[: weights.size] = weights
    lengths = fft_lengths()
    first = np.cumsum(lengths) - lengths
    turns = np.concatenate([np.arange(n) / n for n in lengths])
    twiddles = np.stack([np.cos(2 * np.pi * turns), -np.sin(2 * np.pi * turns)], axis=1)
    n_points = survey.POINTS.shape[1]
    slopes = np.zeros((2, N_TERMS, -(-n_points // VECTOR) * VECTOR), np.float32)
    for padded, values in zip(slopes, survey.SLOPES, strict=True):
        padded[:, :n_points] = values
        padded[:, n_points:] = values[:, -1:]
    fresnel = geometric.fresnel_table()
    contents: dict[str, NDArray[np.generic]] = {
        "monomials": monomial_matrix(),
        "zernike_terms": inverse_monomial_matrix(),
        "node_xy": pupil.NODES.T,
        "from_nodes": pupil.FROM_NODES.T,
        "slope_x": slopes[0],
        "slope_y": slopes[1],
        "edge_xy": survey.POINTS[:, : survey.N_EDGE].astype(np.float32),
        "passed_powers": survey.PASSED_POWERS,
        "ring_weights": survey.RING_WEIGHTS,
        "fresnel": _with_changes(fresnel),
        "edge_response": _with_changes(fourier.edge_response()),
        "pixel_filters": table,
        "lengths": lengths.astype(np.int32),
        "twiddle_first": first.astype(np.int32),
        "twiddles": twiddles.astype(np.float32),
    }
    arrays = {name: np.ascontiguousarray(array) for name, array in contents.items()}
    tables = PsfTables(
        **{name: pointer_to(array) for name, array in arrays.items()},
        cosine=waves.COSINE_OF_TURNS,
        sine=waves.SINE_OF_TURNS,
        fresnel_limit=geometric.FRESNEL_LIMIT,
        least_margin_px=fourier.MARGIN_PX,
        base_db=switch.BASE_DB,
        per_rms_db=switch.PER_RMS_DB,
        per_pixel_db=switch.PER_PIXEL_DB,
        per_narrow_db=switch.PER_NARROW_DB,
        rays_from_db=switch.GEOMETRIC_FROM_DB,
        fade_db=switch.CROSS_FADE_DB,
        min_cells=geometric_kernels.MIN_CELLS,
        max_cells=geometric_kernels.MAX_CELLS,
        cells_per_px=geometric_kernels.CELLS_PER_PX,
        min_edge_points=geometric_kernels.MIN_EDGE_POINTS,
        edge_points_per_px=geometric_kernels.EDGE_POINTS_PER_PX,
        min_curvature_ratio=geometric_kernels.MIN_CURVATURE_RATIO,
        far_px=geometric_kernels.FAR_PX,
        near_px=geometric_kernels.NEAR_PX,
        fresnel_count=fresnel.size,
        edge_half_width=waves.EDGE_HALF_WIDTH,
        edge_steps=waves.EDGE_STEPS,
        filter_stride=stride,
        filter_count=FILTER_COUNT,
        filter_half_width=half_width,
        length_count=lengths.size,
        n_rings=survey.RING_WEIGHTS.size + 1,
        n_ring=survey.N_RING,
    )
    return tables, arrays
