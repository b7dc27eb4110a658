"""Builds the PSF cache of a profile for a camera: CPU only, no GL, cancellable."""

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.measured_wavefront import MeasuredWavefront
from estimator.profiles import EyeProfile
from estimator.psf import Psf, compute_psfs
from filter_service.constants import RGB, WEIGHT_MAX
from filter_service.errors import BuildCancelled
from filter_service.eye import Eye
from filter_service.psf_grid import GridSpec, defocus_nodes_dpt, pupil_nodes_mm
from filter_service.psf_store import (
    PsfStore,
    channel_defocus_dpt,
    channel_wavelengths_nm,
)

COMPUTED_BEYOND = 0.2
"""Kernels are computed out to this share of the light that trimming will drop."""

MAX_CENTROID_SHIFT_PX = 0.005
"""Trimming stops where it would move a kernel's centroid farther than this."""

CHUNK = 192
"""PSFs between two looks at progress and cancellation."""


@dataclass(frozen=True)
class CachePlan:
    """Nodes of a cache, before anything is computed.

    Attributes
    ----------
    pupils_mm : (n_pupils,)
    accommodations_dpt : (n_accommodations,)
    defocus_dpt : [pupil][accommodation] of (n,) arrays
    """

    pupils_mm: NDArray[np.float64]
    accommodations_dpt: NDArray[np.float64]
    defocus_dpt: list[list[NDArray[np.float64]]]


def _neighbours(index: int, count: int) -> range:
    return range(max(index - 1, 0), min(index + 2, count))


def _total_defocus_ranges_dpt(
    eye: Eye, spec: GridSpec, pupils_mm: NDArray, used_dpt: NDArray
) -> NDArray[np.float64]:
    """Smallest and largest total defocus (n_pupils, n_accommodations, 2) at each node.

    Over objects and channels, and over every accommodation that reads this node.
    """
    at_infinity_dpt = np.array(
        [
            [
                channel_defocus_dpt(
                    eye, spec, pupil_diameter_mm=pupil_mm, accommodation_dpt=a
                )
                for a in used_dpt
            ]
            for pupil_mm in pupils_mm
        ]
    )
    if len(used_dpt) == 1:  # one shape for all: accommodation is defocus alone
        spread = [eye.accommodation_dpt(f) - used_dpt[0] for f in spec.focus_range_dpt]
        lows = at_infinity_dpt.min(axis=2) - max(spread)
        highs = at_infinity_dpt.max(axis=2) - min(spread)
    else:
        beside = [_neighbours(j, len(used_dpt)) for j in range(len(used_dpt))]
        lows = np.stack(
            [at_infinity_dpt[:, list(j)].min(axis=(1, 2)) for j in beside], axis=1
        )
        highs = np.stack(
            [at_infinity_dpt[:, list(j)].max(axis=(1, 2)) for j in beside], axis=1
        )
    low, high = spec.object_range_dpt
    return np.stack([lows + low, highs + high], axis=-1)


def plan_cache(eye: Eye, spec: GridSpec) -> CachePlan:
    """Pupil and accommodation nodes, and the defocus nodes that frames can read."""
    low_mm, high_mm = (eye.usable_pupil_mm(p) for p in spec.pupil_range_mm)
    pupils_mm = pupil_nodes_mm((low_mm, high_mm))
    used_dpt = eye.accommodation_nodes_dpt(spec.focus_range_dpt)
    ranges = _total_defocus_ranges_dpt(eye, spec, pupils_mm, used_dpt)
    # A pupil between two nodes reads both at equal blur, up to the other's own.
    scaled = ranges * pupils_mm[:, None, None]
    defocus = []
    for i, pupil_mm in enumerate(pupils_mm):
        beside = list(_neighbours(i, len(pupils_mm)))
        defocus.append(
            [
                defocus_nodes_dpt(
                    float(scaled[beside, j, 0].min() / pupil_mm),
                    float(scaled[beside, j, 1].max() / pupil_mm),
                    blur_px_per_dpt=spec.blur_px_per_dpt(pupil_mm),
                    max_blur_step_px=spec.max_blur_step_px,
                )
                for j in range(len(used_dpt))
            ]
        )
    return CachePlan(
        pupils_mm=pupils_mm, accommodations_dpt=used_dpt, defocus_dpt=defocus
    )


def build_psf_store(
    eye: Eye | EyeProfile,
    spec: GridSpec,
    *,
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> PsfStore:
    """Compute every PSF that frames of this camera, pupil and focus range can need.

    Parameters
    ----------
    eye : Eye or EyeProfile
        A profile is used as the measured wavefront.
    progress : callable, optional
        Called with a fraction 0..1 and a stage.
    cancelled : callable, optional
        Asked between chunks of about 200 PSFs.

    Raises
    ------
    filter_service.errors.BuildCancelled
    estimator.psf.PsfTooLarge
        A kernel exceeds ``spec.max_blur_radius_px``; the message has the numbers.
    """
    started_s = time.perf_counter()
    if isinstance(eye, EyeProfile):
        eye = MeasuredWavefront.from_profile(eye)
    plan = plan_cache(eye, spec)
    channels = RGB if spec.chromatic else 1
    zernike_um, pupil_of, wavelength_of = _requests(eye, spec, plan, channels)
    psfs = []
    for first in range(0, len(zernike_um), CHUNK):
        if cancelled is not None and cancelled():
            raise BuildCancelled("a newer profile took over")
        part = slice(first, first + CHUNK)
        computed = compute_psfs(
            zernike_um[part],
            pupil_diameter_mm=pupil_of[part],
            wavelength_nm=wavelength_of[part],
            pixel_pitch_mrad=spec.pixel_pitch_mrad,
            diffraction=spec.diffraction,
            max_radius_px=spec.max_blur_radius_px,
            min_energy_ratio=1.0 - COMPUTED_BEYOND * (1.0 - spec.kept_energy_ratio),
        )
        psfs += [
            trimmed(psf, kept_energy_ratio=spec.kept_energy_ratio) for psf in computed
        ]
        if progress is not None:
            progress(min(1.0, (first + CHUNK) / len(zernike_um)), "psfs")
    return _packed(spec, eye, plan, channels, psfs, started_s)


def trimmed(psf: Psf, *, kept_energy_ratio: float) -> Psf:
    """Cut a kernel's faint rim off and bring it back to unit sum."""
    full_px = psf.radius_px
    axis = np.arange(-full_px, full_px + 1)
    ring = np.ceil(np.hypot(axis[:, None], axis[None]) - 0.5).astype(np.int64).ravel()
    kernel = psf.kernel.astype(np.float64)
    light = np.bincount(ring, kernel.ravel())
    moment_x = np.bincount(ring, (kernel * axis[None]).ravel())
    moment_y = np.bincount(ring, (kernel * axis[:, None]).ravel())
    kept = np.cumsum(light)[: full_px + 1]
    centroid_x, centroid_y = (
        np.cumsum(m)[: full_px + 1] / np.maximum(kept, 1e-12)
        for m in (moment_x, moment_y)
    )
    shift_px = np.hypot(centroid_x - centroid_x[-1], centroid_y - centroid_y[-1])
    good = (kept >= kept_energy_ratio) & (shift_px <= MAX_CENTROID_SHIFT_PX)
    # The rule must hold from the radius on, not by a crossing on the way.
    radius_px = full_px - int(np.argmin(np.append(good[::-1], False))) + 1
    if radius_px >= full_px:
        return psf
    part = slice(full_px - radius_px, full_px + radius_px + 1)
    inner = np.where(ring.reshape(kernel.shape) <= radius_px, kernel, 0.0)[part, part]
    return replace(
        psf,
        kernel=(inner / inner.sum()).astype(np.float32),
        radius_px=radius_px,
        lost_energy_ratio=psf.lost_energy_ratio + 1.0 - float(kept[radius_px]),
    )


def _quantised(psfs: list[Psf]) -> NDArray[np.uint16]:
    """All kernels one after the other, each in steps of its peak / WEIGHT_MAX."""
    parts = [
        np.rint(psf.kernel.ravel() * (WEIGHT_MAX / psf.kernel.max())).astype(np.uint16)
        for psf in psfs
    ]
    whole_words = np.zeros(sum(part.size for part in parts) % 2, np.uint16)
    return np.concatenate([*parts, whole_words])


def _spread_px(kernel: np.ndarray) -> float:
    """Radius of the uniform disc that has this kernel's sum of squares."""
    return 1.0 / math.sqrt(math.pi * float(np.square(kernel, dtype=np.float64).sum()))


def _requests(eye, spec, plan, channels):
    """Wavefronts (n, 28), pupils (n,) and wavelengths (n,), channel fastest."""
    wavelengths_nm = channel_wavelengths_nm(spec)[:channels]
    requests = [
        (pupil_mm, accommodation_dpt, total_dpt, wavelength_nm)
        for pupil_mm, by_use in zip(plan.pupils_mm, plan.defocus_dpt, strict=True)
        for accommodation_dpt, nodes in zip(
            plan.accommodations_dpt, by_use, strict=True
        )
        for total_dpt in nodes
        for wavelength_nm in wavelengths_nm
    ]
    zernike_um = [
        eye.zernike_at_defocus(
            pupil_diameter_mm=pupil_mm,
            accommodation_dpt=accommodation_dpt,
            wavelength_nm=wavelength_nm,
            total_defocus_dpt=total_dpt,
        )
        for pupil_mm, accommodation_dpt, total_dpt, wavelength_nm in requests
    ]
    pupil_of, _, _, wavelength_of = np.array(requests).T
    return np.array(zernike_um), pupil_of, wavelength_of


def _packed(spec, eye, plan, channels, psfs, started_s) -> PsfStore:
    sizes = np.array([psf.kernel.size for psf in psfs])
    share = np.repeat(np.arange(len(psfs)), RGB // channels)
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    counts = [len(nodes) for by_use in plan.defocus_dpt for nodes in by_use]
    first_psf = RGB * np.concatenate([[0], np.cumsum(counts)[:-1]])
    return PsfStore(
        spec=spec,
        eye=eye,
        pupil_nodes_mm=plan.pupils_mm,
        accommodation_nodes_dpt=plan.accommodations_dpt,
        defocus_nodes_dpt=plan.defocus_dpt,
        first_psf=first_psf.reshape(len(plan.pupils_mm), -1),
        kernels=_quantised(psfs),
        offsets=offsets[share],
        radius_px=np.array([psf.radius_px for psf in psfs])[share],
        blur_px=np.array([psf.blur_radius_px for psf in psfs])[share],
        spread_px=np.array([_spread_px(psf.kernel) for psf in psfs])[share],
        peak_ratio=np.array([float(psf.kernel.max()) for psf in psfs])[share],
        methods=dict(Counter(psf.method for psf in psfs)),
        max_lost_energy_ratio=max(psf.lost_energy_ratio for psf in psfs),
        build_ms=1e3 * (time.perf_counter() - started_s),
    )
