"""Packed kernels of field nodes, by the engine in C.

`estimator.psf` computes the same in Python, and tests compare the two.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from estimator.corrections.rings import Rings
from estimator.psf.compiled import CompiledPsfs, compiled_psfs
from estimator.psf.fourier import ACCURACY
from estimator.psf.screens import BEYOND_EDGE, ONE_CENTER, TABLE_COUNT
from estimator.psf.stiles_crawford import StilesCrawford
from estimator.psf.tables import GEOMETRIC_FROM_DB
from estimator.threads import call_after_fork
from filter_service.constants import RGB
from filter_service.planning.node_wavefronts import NodeWavefronts
from filter_service.psfs.pack import CUT_STEPS, MAX_CENTROID_SHIFT_RATIO, PackedKernels

MAX_PRIMARIES = 16

CORNERS_TWICE = 1.2
"""Ratio of the light beyond the four sides of a box to the light outside the box: light
beyond a corner counts for two sides.  With 1.2, boxes lose 0.68 to 1.08 % of the light
where 1 % is allowed, as in `pack_kernels`."""


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
    def of(
        cls, rings: Rings, wavefronts: NodeWavefronts, widest: NodeWavefronts
    ) -> NodeRings:
        """Tabulate a lens for the pupils of groups.

        Parameters
        ----------
        widest : NodeWavefronts
            The same directions through the widest pupil, over which tables extend:
            images must not depend on the groups that were planned before.
        """
        seen, offset_mm, largest_mm = _seen_rings(rings, wavefronts)
        lattice_mm = ONE_CENTER if seen.lattice_mm is None else seen.lattice_mm
        if seen.lattice_mm is None:
            radius_mm = float(BEYOND_EDGE * _seen_rings(rings, widest)[2].max())
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


def _seen_rings(
    rings: Rings, wavefronts: NodeWavefronts
) -> tuple[Rings, NDArray[np.float64], NDArray[np.float64]]:
    """Return a lens as groups see it, offsets of pupils, and their largest radius."""
    seen = rings.seen_from(wavefronts.h_deg, wavefronts.v_deg)
    center_mm = np.broadcast_to(seen.centre_mm, (wavefronts.h_deg.size, 2))
    ellipse = wavefronts.pupil_ellipse
    offset_mm = ellipse[..., :2] - center_mm[:, None, None]
    return seen, offset_mm, ellipse[..., 2] + np.linalg.norm(offset_mm, axis=-1)


@dataclass(frozen=True)
class NativePsfs:
    """The compiled engine for nodes of a store.

    Attributes
    ----------
    engine : CompiledPsfs
    """

    engine: CompiledPsfs

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
        rays_from_db: float = GEOMETRIC_FROM_DB,
        accuracy: str = "normal",
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
        rays_from_db : float
            See `GridSpec`.
        accuracy : "normal" or "fine"
            Accuracy of wave optics, as of `compute_psf_batch`.

        Returns
        -------
        kernels : PackedKernels
            Kernels (n,); those in ``left`` have no texels.
        methods : Counter
            Number of PSFs by the method that computed the larger share of each.
        left : (m,)
            Indices of the PSFs among the n that `estimator.psf` must compute or refuse.
        """
        primaries = wavefronts.wavelength_nm.shape[1]
        arrays = {
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
            arrays["apodization_per_mm2"] = per_mm2
            center_mm = stiles_crawford.centre_mm
        if rings is not None:
            arrays["ring_offset_mm"] = rings.offset_mm
            arrays["ring_reach_mrad"] = rings.reach_mrad
        found = self.engine.compute(
            arrays,
            groups * RGB + channels,
            groups,
            channels,
            rays_from_db=rays_from_db,
            accuracy=ACCURACY[accuracy],
            ring_tables=None if rings is None else rings.amplitude_ratio,
            apodization_center_mm=center_mm,
            ring_steps_per_mm2=TABLE_COUNT / rings.radius_mm**2 if rings else 0.0,
            ring_lattice_mm=rings.lattice_mm if rings else ONE_CENTER,
            ring_count=TABLE_COUNT,
            cut_ratio=CORNERS_TWICE * (1.0 - kept_energy_ratio),
            centroid_ratio=MAX_CENTROID_SHIFT_RATIO,
            cut_steps=CUT_STEPS,
            primaries=primaries,
            max_radius_px=max_radius_px,
            is_diffracting=diffraction,
        )
        by_rays = int(np.count_nonzero(found.rays_ratio[found.is_done] > 0.5))
        by_waves = int(np.count_nonzero(found.is_done)) - by_rays
        methods = {"geometric": by_rays, "fourier": by_waves}
        packed = PackedKernels(
            weights=found.words,
            offsets=np.cumsum(found.sizes) - found.sizes,
            reach_px=found.reach_px,
            radius_px=found.radius_px,
            peak_ratio=found.peak_ratio,
            spread_px=found.spread_px,
            lost_energy_ratio=found.lost_ratio,
        )
        counts = Counter({name: n for name, n in methods.items() if n})
        return packed, counts, np.flatnonzero(~found.is_done)


@cache
def native_psfs(threads: int | None = None) -> NativePsfs:
    """Return the engine of this process on all of its threads, or on so many."""
    engine = compiled_psfs()
    if threads is not None:
        engine = replace(engine, threads=engine.core.new_threads(threads))
    return NativePsfs(engine)


call_after_fork(native_psfs.cache_clear)
