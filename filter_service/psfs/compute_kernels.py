"""Computation of packed kernels from the wavefronts of nodes, and choice of the engine.

There is no GPU engine.  On a machine with an H200, 16 cores compute the paper's set of
201,825 PSFs in C in 0.64 s.  Compute shaders took 3.2 s and three to five times the
processor time, because each PSF must be surveyed before it is dispatched.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import PsfBatch, compute_psf_batch
from estimator.threads import call_after_fork, thread_count
from filter_service.constants import RGB
from filter_service.planning.cost import COMPUTED_BEYOND
from filter_service.planning.grid import GridSpec
from filter_service.planning.node_wavefronts import NodeWavefronts, apodization
from filter_service.planning.nodes import PlanNodes
from filter_service.psfs.native_psfs import (
    MAX_PRIMARIES,
    NativePsfs,
    NodeRings,
    native_psfs,
)
from filter_service.psfs.pack import PackedKernels, pack_kernels

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
def psf_engine(pipeline: str = "exact", threads: int | None = None) -> PsfEngine:
    """Return the engine of a pipeline.

    "exact" uses the compiled engine.  "published" uses the ENZ series up to the paper's
    Zernike degree, even where the aberrations require a higher one.  Its PSFs take up
    to 0.25 s of a core, so there is one for each thread between two checks.

    Parameters
    ----------
    pipeline : "exact" or "published"
    threads : int, optional
        Number of threads of the compiled engine; by default one for each core.
    """
    if pipeline == "published":
        series = partial(compute_psf_batch, method="enz_unchecked")
        return PsfEngine(series, thread_count())
    return PsfEngine(compute_psf_batch, NATIVE_BATCH, native_psfs(threads))


call_after_fork(psf_engine.cache_clear)


def computed_kernels(
    eye: EyeOptics,
    spec: GridSpec,
    nodes: PlanNodes,
    psfs: NDArray[np.int64],
    engine: PsfEngine,
    rings: NodeRings | None = None,
) -> tuple[PackedKernels, Counter[str]]:
    """Compute the kernels of PSFs.

    Parameters
    ----------
    psfs : (n,)
        PSF indices.
    rings : NodeRings, optional
        Rings of the eye's lens at the nodes.

    Returns
    -------
    kernels : PackedKernels
        Kernels (n,), in the order of ``psfs``.
    methods : Counter
        Number of PSFs by the method that computed the larger share of each.

    Raises
    ------
    PsfTooLarge
        If a PSF is larger than ``spec.max_blur_radius_px``.
    ValueError
        If no light arrives within a kernel.
    """
    groups, channels = nodes.defocus.group_at(psfs // RGB), psfs % RGB
    total_dpt = nodes.defocus.values_dpt[psfs // RGB]
    total_dpt = total_dpt + nodes.channel_shift_dpt[groups, channels]
    wavefronts = nodes.wavefronts
    generic = partial(generic_kernels, eye, spec, wavefronts, engine)
    native = engine.native
    if native is None or wavefronts.wavelength_nm.shape[1] > MAX_PRIMARIES:
        return generic(groups, channels, total_dpt)
    packed, methods, left = native.kernels(
        wavefronts,
        *(groups, channels, total_dpt),
        kept_energy_ratio=spec.kept_energy_ratio,
        max_radius_px=spec.max_blur_radius_px,
        diffraction=spec.settings.diffraction,
        stiles_crawford=apodization(eye, spec),
        rings=rings,
        rays_from_db=spec.rays_from_db,
        accuracy=spec.psf_accuracy,
    )
    if left.size:
        others, more = generic(groups[left], channels[left], total_dpt[left])
        packed, methods = packed.with_kernels(left, others), methods + more
    return packed, methods


def generic_kernels(
    eye: EyeOptics,
    spec: GridSpec,
    wavefronts: NodeWavefronts,
    engine: PsfEngine,
    groups: NDArray[np.int64],
    channels: NDArray[np.int64],
    total_dpt: NDArray[np.float64],
) -> tuple[PackedKernels, Counter[str]]:
    """Compute whole kernels (n,) with `PsfEngine.compute`, and crop them afterward."""
    n_primaries = wavefronts.wavelength_nm.shape[1]
    each = np.repeat(groups, n_primaries)
    found = wavefronts.at(groups, channels, total_dpt)
    rings = eye.rings
    batch = engine.compute(
        found.zernike_um,
        pupil_diameter_mm=found.circle_diameter_mm,
        pupil_ellipse=found.pupil_ellipse,
        stiles_crawford=apodization(eye, spec),
        pupil_screen=rings
        and rings.seen_from(wavefronts.h_deg[each], wavefronts.v_deg[each]),
        wavelength_nm=wavefronts.wavelength_nm[channels].ravel(),
        pixel_from_mrad=wavefronts.pixel_from_mrad[each],
        diffraction=spec.settings.diffraction,
        accuracy=spec.psf_accuracy,
        max_radius_px=spec.max_blur_radius_px,
        min_energy_ratio=1.0 - COMPUTED_BEYOND * (1.0 - spec.kept_energy_ratio),
    )
    batch = mean_batch(batch, n_primaries)
    packed = pack_kernels(batch, kept_energy_ratio=spec.kept_energy_ratio)
    return packed, _methods(batch)


def _methods(batch: PsfBatch) -> Counter[str]:
    """Count PSFs by the method that computed the larger share of each."""
    by_rays = int(np.count_nonzero(batch.geometric_ratio > 0.5))
    counts = {"geometric": by_rays, batch.wave_method: len(batch) - by_rays}
    return Counter({name: number for name, number in counts.items() if number})


def mean_batch(batch: PsfBatch, count: int) -> PsfBatch:
    """Return a batch (P,) of means over ``count`` consecutive kernels each."""
    if count == 1:
        return batch
    radius_px = batch.radius_px.reshape(-1, count).max(axis=1)
    sides = 2 * radius_px + 1
    offsets = np.concatenate([[0], np.cumsum(sides**2)])
    kernels = np.zeros(offsets[-1], np.float32)
    for p, radius in enumerate(radius_px.tolist()):
        side = 2 * radius + 1
        total = kernels[offsets[p] : offsets[p + 1]].reshape(side, side)
        for k in range(count * p, count * (p + 1)):
            psf = batch[k]
            edge = radius - psf.radius_px
            total[edge : side - edge, edge : side - edge] += psf.kernel / count
    return replace(
        batch,
        flat_kernels=kernels,
        offset_count=offsets[:-1],
        radius_px=radius_px,
        lost_energy_ratio=batch.lost_energy_ratio.reshape(-1, count).mean(axis=1),
        blur_radius_px=batch.blur_radius_px.reshape(-1, count).mean(axis=1),
        geometric_ratio=batch.geometric_ratio.reshape(-1, count).mean(axis=1),
    )
