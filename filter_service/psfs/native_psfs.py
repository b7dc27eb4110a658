"""PSF engine in C: one call computes packed kernels from the wavefronts of nodes.

`estimator.psf` computes the same in Python, and tests compare the two.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from estimator.corrections.rings import Rings
from estimator.optics.zernike import N_TERMS, inverse_monomial_matrix, monomial_matrix
from estimator.psf import fourier, geometric, geometric_kernels, pupil, survey, switch
from estimator.psf import fourier_kernels as waves
from estimator.psf.compute import ACCURACY
from estimator.psf.screens import BEYOND_EDGE, ONE_CENTER, TABLE_COUNT
from estimator.psf.stiles_crawford import StilesCrawford
from estimator.threads import thread_count
from filter_service.errors import RenderFailed
from filter_service.native.library import Library, compiled_library
from filter_service.native.records import (
    PSF_DONE,
    PsfJob,
    PsfTables,
    pointer_to,
)
from filter_service.planning.node_wavefronts import NodeWavefronts
from filter_service.psfs.boxes import CUT_STEPS, MAX_CENTROID_SHIFT_RATIO, SIDES
from filter_service.psfs.pack import PackedKernels

MAX_PRIMARIES = 16

FILTER_COUNT = 256
"""Largest number of samples per pixel with a tabulated filter: pixels of 14 mrad,
pupils of 8 mm."""

CORNERS_TWICE = 1.2
"""Ratio of the light beyond the four sides of a box to the light outside the box: light
beyond a corner counts for two sides.  With 1.2, boxes lose 0.68 to 1.08 % of the light
where 1 % is allowed, like those of `pack_kernels`."""

VECTOR = 8


def fft_lengths() -> NDArray[np.int64]:
    """Return the FFT lengths that the engine supports: multiples of eight."""
    lengths = fourier.FAST_LENGTHS
    return lengths[lengths % VECTOR == 0]


@dataclass(frozen=True)
class NodeRings:
    """Rings of a lens in the pupils of groups, see `estimator.psf.screens`.

    Attributes
    ----------
    offset_mm : (n_groups, 3, n_primaries, 2)
        Center of the pupil relative to the center of the rings.
    reach_mrad : (n_groups, 3, n_primaries)
        Distance beyond the rays to which the rings send light.
    amplitude_ratio : (3, n_primaries, TABLE_COUNT, 2), float32
        Complex amplitude as a function of the squared distance from a center.
    radius_mm : float
        Radius of the last entry.
    lattice_mm : (pitch, inner, outer)
        Dimensions of a honeycomb of such rings; zeros if there is one center.
    """

    offset_mm: NDArray[np.float64]
    reach_mrad: NDArray[np.float64]
    amplitude_ratio: NDArray[np.float32]
    radius_mm: float
    lattice_mm: tuple[float, float, float]

    @classmethod
    def of(cls, rings: Rings, wavefronts: NodeWavefronts) -> NodeRings:
        """Tabulate a lens for the pupils of groups."""
        seen = rings.seen_from(wavefronts.h_deg, wavefronts.v_deg)
        center_mm = np.broadcast_to(seen.centre_mm, (wavefronts.h_deg.size, 2))
        ellipse = wavefronts.pupil_ellipse
        offset_mm = ellipse[..., :2] - center_mm[:, None, None]
        largest_mm = ellipse[..., 2] + np.linalg.norm(offset_mm, axis=-1)
        lattice_mm = ONE_CENTER if seen.lattice_mm is None else seen.lattice_mm
        if seen.lattice_mm is None:
            radius_mm = float(BEYOND_EDGE * largest_mm.max())
        else:
            radius_mm = seen.lattice_mm[0]
        square_mm2 = (np.arange(TABLE_COUNT) + 0.5) / TABLE_COUNT * radius_mm**2
        reach_mrad = np.empty(largest_mm.shape)
        tables = np.empty((*wavefronts.wavelength_nm.shape, TABLE_COUNT, 2), np.float32)
        for place, nm in np.ndenumerate(wavefronts.wavelength_nm):
            reach_mrad[:, *place] = seen.reach_mrad(largest_mm[:, *place], float(nm))
            field = seen.transmission(square_mm2, float(nm))
            tables[place] = np.stack([field.real, field.imag], axis=-1)
        return cls(offset_mm, reach_mrad, tables, float(radius_mm), lattice_mm)


@dataclass(frozen=True)
class NativePsfs:
    """The engine's library, threads and tables.

    Attributes
    ----------
    library : Library
    threads : int
        Handle of the thread pool that calls share.
    lock : Lock
        Held by the call that uses the threads.
    """

    library: Library
    threads: int
    lock: Lock = field(default_factory=Lock)

    def kernels(
        self,
        wavefronts: NodeWavefronts,
        groups: NDArray[np.int64],
        channels: NDArray[np.int64],
        total_dpt: NDArray[np.float64],
        *,
        kept_energy_ratio: float,
        max_radius_px: int,
        diffraction: bool = True,
        stiles_crawford: StilesCrawford | None = None,
        rings: NodeRings | None = None,
    ) -> tuple[PackedKernels, Counter[str], NDArray[np.int64]]:
        """Compute the kernels of PSFs (n,).

        Parameters
        ----------
        wavefronts : NodeWavefronts
        groups, channels : (n,)
            Group and channel of each PSF.
        total_dpt : (n,)
            Total defocus at the middle wavelength of the channel.
        kept_energy_ratio : float
            Share of a kernel's light that its box must contain.
        max_radius_px : int
        diffraction : bool
        stiles_crawford : StilesCrawford, optional
        rings : NodeRings, optional

        Returns
        -------
        kernels : PackedKernels
            Kernels (n,); those in ``left`` have no texels.
        methods : Counter
            Number of PSFs by the method that computed the larger share of each.
        left : (m,)
            Indices of the PSFs among the n that `estimator.psf` must compute or refuse.
        """
        count, primaries = groups.size, wavefronts.wavelength_nm.shape[1]
        sampling = ACCURACY["normal"]
        inputs = {
            "zernike_um": wavefronts.zernike_um,
            "per_dpt_um": wavefronts.per_dpt_um,
            "circle_diameter_mm": wavefronts.circle_diameter_mm,
            "pupil_ellipse": wavefronts.pupil_ellipse,
            "pixel_from_mrad": wavefronts.pixel_from_mrad,
            "wavelength_nm": wavefronts.wavelength_nm,
            "total_dpt": total_dpt,
        }
        center_mm = (0.0, 0.0)
        if stiles_crawford is not None:
            per_mm2, _ = stiles_crawford.amplitude(wavefronts.wavelength_nm.ravel())
            inputs["apodization_per_mm2"] = per_mm2
            center_mm = stiles_crawford.centre_mm
        if rings is not None:
            inputs["ring_offset_mm"] = rings.offset_mm
            inputs["ring_reach_mrad"] = rings.reach_mrad
        arrays: dict[str, NDArray[np.generic]] = {
            name: np.ascontiguousarray(array, np.float64)
            for name, array in inputs.items()
        }
        if rings is not None:
            arrays["ring_tables"] = rings.amplitude_ratio
        arrays["groups"] = np.ascontiguousarray(groups, np.int64)
        arrays["channels"] = np.ascontiguousarray(channels, np.int64)
        reach_px = np.zeros((count, SIDES), np.int64)
        radius_px, sizes = np.zeros((2, count), np.int64)
        peak, spread, lost, rays = np.zeros((4, count))
        outcome = np.empty(count, np.int32)
        tables, _ = _tables()
        job = PsfJob(
            threads=self.threads,
            tables=ctypes.addressof(tables),
            **{name: pointer_to(array) for name, array in arrays.items()},
            apodization_center_mm=center_mm,
            ring_steps_per_mm2=TABLE_COUNT / rings.radius_mm**2 if rings else 0.0,
            ring_lattice_mm=rings.lattice_mm if rings else ONE_CENTER,
            ring_count=TABLE_COUNT,
            cut_ratio=CORNERS_TWICE * (1.0 - kept_energy_ratio),
            oversampling=sampling.oversampling,
            margin=sampling.margin,
            min_samples_per_px=sampling.min_samples_per_px,
            reach_px=pointer_to(reach_px),
            radius_px=pointer_to(radius_px),
            sizes=pointer_to(sizes),
            peak_ratio=pointer_to(peak),
            spread_px=pointer_to(spread),
            lost_ratio=pointer_to(lost),
            rays_ratio=pointer_to(rays),
            outcome=pointer_to(outcome),
            count=count,
            primaries=primaries,
            max_radius_px=max_radius_px,
            is_diffracting=diffraction,
        )
        with self.lock:
            words = self.library.psfs(job, outcome, sizes)
        is_done = outcome == PSF_DONE
        by_rays = int(np.count_nonzero(rays[is_done] > 0.5))
        by_waves = int(np.count_nonzero(is_done)) - by_rays
        methods = {"geometric": by_rays, "fourier": by_waves}
        packed = PackedKernels(
            weights=words,
            offsets=np.cumsum(sizes) - sizes,
            reach_px=reach_px,
            radius_px=radius_px,
            peak_ratio=peak,
            spread_px=spread,
            lost_energy_ratio=lost,
        )
        found = Counter({name: n for name, n in methods.items() if n})
        return packed, found, np.flatnonzero(~is_done)


@cache
def native_psfs() -> NativePsfs | None:
    """Return the engine of this process, or None if the library is missing."""
    try:
        library = compiled_library()
    except RenderFailed:
        return None
    return NativePsfs(library, library.new_threads(thread_count()))


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
    half_width = ACCURACY["normal"].filter_half_width
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
        centroid_ratio=MAX_CENTROID_SHIFT_RATIO,
        fresnel_count=fresnel.size,
        edge_half_width=waves.EDGE_HALF_WIDTH,
        edge_steps=waves.EDGE_STEPS,
        filter_stride=stride,
        filter_count=FILTER_COUNT,
        filter_half_width=half_width,
        length_count=lengths.size,
        n_rings=survey.RING_WEIGHTS.size + 1,
        n_ring=survey.N_RING,
        cut_steps=CUT_STEPS,
    )
    return tables, arrays
