"""The PSF cache of one eye and camera, and its blending recipe for one frame.

Plain arrays without GL: the worker fills it, the renderer uploads it.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimator.units import REFERENCE_WAVELENGTH_NM
from filter_service.constants import RECIPE_WORDS, RGB, WEIGHT_MAX
from filter_service.eye import Eye
from filter_service.psf_grid import GridSpec, layer_distances_dpt


@dataclass(frozen=True)
class PsfStore:
    """Kernels over pupil, total defocus and channel.

    Attributes
    ----------
    pupil_nodes_mm : (n_pupils,)
    accommodation_nodes_dpt : (n_accommodations,)
    defocus_nodes_dpt : [pupil][accommodation] of (n_defocus,) arrays, ascending
    first_psf : (n_pupils, n_accommodations)
        PSF index of the first node; node k and channel c follow at 3 k + c.
    kernels : (n_texels,), uint16
        All kernels, rows downwards, one after the other; in steps of the kernel's peak
        over WEIGHT_MAX, which is finer than half floats and half of what floats take.
    offsets, radius_px : (n_psfs,)
        Where a kernel starts and its radius.
    blur_px : (n_psfs,)
        Geometric blur radius.
    spread_px : (n_psfs,)
        Radius of the disc with the kernel's sum of squares: how far it really smears,
        which for a bright core in a wide skirt is much less than ``blur_px``.
    peak_ratio : (n_psfs,)
        Largest weight.
    """

    spec: GridSpec
    eye: Eye
    pupil_nodes_mm: NDArray[np.float64]
    accommodation_nodes_dpt: NDArray[np.float64]
    defocus_nodes_dpt: list[list[NDArray[np.float64]]]
    first_psf: NDArray[np.int64]
    kernels: NDArray[np.uint16]
    offsets: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    blur_px: NDArray[np.float64]
    spread_px: NDArray[np.float64]
    peak_ratio: NDArray[np.float64]
    methods: dict[str, int] = field(default_factory=dict)
    max_lost_energy_ratio: float = 0.0
    build_ms: float = 0.0

    @property
    def psf_count(self) -> int:
        """Number of kernels."""
        return len(self.offsets)

    @property
    def memory_mb(self) -> float:
        """Size of the kernels."""
        return self.kernels.nbytes / 1e6


@dataclass(frozen=True)
class FrameLayers:
    """Layers of one frame: distances, sizes and what to blend from the cache.

    Attributes
    ----------
    object_dpt : (n,)
    radius_px : (n,)
        Kernel radius of the interval from this layer to the next.
    peak_ratio : (n,)
        Bound on the weights of that interval.
    blur_px : (n,)
        Largest geometric blur radius over the channels.
    spread_px : (n,)
        Smallest spread over the channels; decides what may merge.
    recipes : (n, 3, 24), uint32
        Per channel eight kernel offsets, eight radii, eight weights (float bits) that
        turn steps of a kernel into its share of a layer.
    """

    object_dpt: NDArray[np.float64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    blur_px: NDArray[np.float64]
    spread_px: NDArray[np.float64]
    recipes: NDArray[np.uint32]
    pupil_diameter_mm: float
    focus_dpt: float
    blur_px_per_dpt: float
    notes: tuple[str, ...]


def channel_wavelengths_nm(spec: GridSpec) -> tuple[float, ...]:
    """Wavelengths of the three channels; all the same without chromatic blur."""
    return spec.wavelengths_nm if spec.chromatic else (REFERENCE_WAVELENGTH_NM,) * RGB


def channel_defocus_dpt(
    eye: Eye, spec: GridSpec, *, pupil_diameter_mm: float, accommodation_dpt: float
) -> NDArray[np.float64]:
    """Total defocus (3,) per channel for an object at infinity."""
    return np.array(
        [
            eye.total_defocus_dpt(
                pupil_diameter_mm=pupil_diameter_mm,
                accommodation_dpt=accommodation_dpt,
                wavelength_nm=wavelength_nm,
            )
            for wavelength_nm in channel_wavelengths_nm(spec)
        ]
    )


def frame_layers(
    store: PsfStore,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    object_range_dpt: tuple[float, float] | None = None,
) -> FrameLayers:
    """Plan a frame's layers for a pupil and focus.

    The pupil is clamped to the cache's range and to what was measured, with a note.
    Neighbouring pupils and accommodations are blended at equal geometric blur: the node
    of pupil A_i is read at total defocus t A / A_i, so no blended pair differs in size.

    Parameters
    ----------
    object_range_dpt : (low, high), optional
        Distances in the frame; default and limit is the cache's range.

    References
    ----------
    Csoba & Kunkli 2023, section 6.4 (cached neighbours of pupil and focus) and 6.2.
    """
    pupil_mm, notes = _usable_pupil(store, pupil_diameter_mm)
    notes += store.eye.notes(pupil_diameter_mm=pupil_diameter_mm, focus_dpt=focus_dpt)
    accommodation_dpt = store.eye.accommodation_dpt(focus_dpt)
    at_infinity_dpt = channel_defocus_dpt(
        store.eye,
        store.spec,
        pupil_diameter_mm=pupil_mm,
        accommodation_dpt=accommodation_dpt,
    )
    blend = _Blend(store, pupil_mm, accommodation_dpt)
    object_dpt = layer_distances_dpt(
        object_range_dpt or store.spec.object_range_dpt,
        focused_dpt=-at_infinity_dpt,
        blur_radius_px=lambda d: blend.blur_px(d[:, None] + at_infinity_dpt),
        max_blur_step_px=store.spec.max_blur_step_px,
    )
    psfs, weights = blend.neighbours(object_dpt[:, None] + at_infinity_dpt)
    own_px = np.where(weights > 0.0, store.radius_px[psfs], 0).max(axis=(1, 2))
    own_peak = (weights * store.peak_ratio[psfs]).sum(axis=2).max(axis=1)
    return FrameLayers(
        object_dpt=object_dpt,
        radius_px=np.maximum(own_px, np.append(own_px[1:], own_px[-1])),
        peak_ratio=np.maximum(own_peak, np.append(own_peak[1:], own_peak[-1])),
        blur_px=blend.blur_px(object_dpt[:, None] + at_infinity_dpt).max(axis=1),
        spread_px=(weights * store.spread_px[psfs]).sum(axis=2).min(axis=1),
        recipes=_recipes(store, psfs, weights),
        pupil_diameter_mm=pupil_mm,
        focus_dpt=store.eye.reachable_focus_dpt(focus_dpt),
        blur_px_per_dpt=store.spec.blur_px_per_dpt(pupil_mm),
        notes=notes,
    )


def _usable_pupil(store: PsfStore, pupil_diameter_mm: float) -> tuple[float, tuple]:
    usable_mm = store.eye.usable_pupil_mm(pupil_diameter_mm)
    low_mm, high_mm = store.pupil_nodes_mm[0], store.pupil_nodes_mm[-1]
    clamped_mm = float(np.clip(usable_mm, low_mm, high_mm))
    if abs(clamped_mm - usable_mm) <= 1e-9:
        return clamped_mm, ()
    note = (
        f"pupil {pupil_diameter_mm:g} mm is outside the prepared "
        f"{low_mm:.3g} to {high_mm:.3g} mm: {clamped_mm:.3g} mm used"
    )
    return clamped_mm, (note,)


def _bracket(nodes: NDArray, value: float) -> list[tuple[int, float]]:
    """Neighbouring nodes and their weights; one node twice where there is only one."""
    last = len(nodes) - 1
    upper = int(np.clip(np.searchsorted(nodes, value), min(1, last), last))
    lower = max(upper - 1, 0)
    span = nodes[upper] - nodes[lower]
    fraction = (value - nodes[lower]) / span if span > 0 else 0.0
    fraction = float(np.clip(fraction, 0.0, 1.0))
    return [(lower, 1.0 - fraction), (upper, fraction)]


class _Blend:
    """Cached neighbours of one pupil and accommodation at any total defocus."""

    def __init__(self, store: PsfStore, pupil_mm: float, accommodation_dpt: float):
        self.store = store
        self.pupil_mm = pupil_mm
        self.corners = [
            (pupil, accommodation, pupil_weight * accommodation_weight)
            for pupil, pupil_weight in _bracket(store.pupil_nodes_mm, pupil_mm)
            for accommodation, accommodation_weight in _bracket(
                store.accommodation_nodes_dpt, accommodation_dpt
            )
        ]

    def neighbours(self, total_dpt: NDArray) -> tuple[NDArray, NDArray]:
        """PSF indices and weights (n, 3, 8) for total defocus (n, 3), dpt."""
        channels = np.arange(RGB)
        psfs, weights = [], []
        for pupil, accommodation, corner_weight in self.corners:
            nodes = self.store.defocus_nodes_dpt[pupil][accommodation]
            last = len(nodes) - 1
            scaled = total_dpt * self.pupil_mm / self.store.pupil_nodes_mm[pupil]
            scaled = np.clip(scaled, nodes[0], nodes[-1])
            upper = np.clip(np.searchsorted(nodes, scaled), min(1, last), last)
            lower = np.maximum(upper - 1, 0)
            span = nodes[upper] - nodes[lower]
            safe = np.where(span > 0, span, 1.0)
            fraction = np.where(span > 0, (scaled - nodes[lower]) / safe, 0.0)
            first = self.store.first_psf[pupil, accommodation]
            psfs += [first + RGB * lower + channels, first + RGB * upper + channels]
            weights += [corner_weight * (1.0 - fraction), corner_weight * fraction]
        return np.stack(psfs, axis=-1), np.stack(weights, axis=-1)

    def blur_px(self, total_dpt: NDArray) -> NDArray:
        """Geometric blur radius (n, 3), px."""
        psfs, weights = self.neighbours(total_dpt)
        return (self.store.blur_px[psfs] * weights).sum(axis=-1)


def _recipes(store: PsfStore, psfs: NDArray, weights: NDArray) -> NDArray[np.uint32]:
    neighbours = psfs.shape[-1]
    recipes = np.empty((*psfs.shape[:2], RECIPE_WORDS * 4), dtype=np.uint32)
    recipes[..., :neighbours] = store.offsets[psfs]
    recipes[..., neighbours : 2 * neighbours] = store.radius_px[psfs]
    per_step = weights * store.peak_ratio[psfs] / WEIGHT_MAX
    recipes[..., 2 * neighbours :] = per_step.astype(np.float32).view(np.uint32)
    return recipes
