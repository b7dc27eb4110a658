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
from filter_service.constants import RGB
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
    defocus_dpt : list of (n,) arrays, one a pupil
    """

    pupils_mm: NDArray[np.float64]
    accommodations_dpt: NDArray[np.float64]
    defocus_dpt: list[NDArray[np.float64]]


def total_defocus_range_dpt(
    eye: Eye, spec: GridSpec, *, pupil_diameter_mm: float
) -> tuple[float, float]:
    """Smallest and largest total defocus over objects, foci and channels."""
    at_infinity_dpt = np.concatenate(
        [
            channel_defocus_dpt(
                eye,
                spec,
                pupil_diameter_mm=pupil_diameter_mm,
                accommodation_dpt=eye.accommodation_dpt(focus_dpt),
            )
            for focus_dpt in spec.focus_range_dpt
        ]
    )
    low, high = spec.object_range_dpt
    return float(at_infinity_dpt.min() + low), float(at_infinity_dpt.max() + high)


def plan_cache(eye: Eye, spec: GridSpec) -> CachePlan:
    """Pupil nodes and, for each, the defocus nodes that any pupil beside it needs."""
    low_mm, high_mm = (eye.usable_pupil_mm(p) for p in spec.pupil_range_mm)
    pupils_mm = pupil_nodes_mm((low_mm, high_mm))
    ranges = [
        total_defocus_range_dpt(eye, spec, pupil_diameter_mm=p) for p in pupils_mm
    ]
    nodes = []
    for i, pupil_mm in enumerate(pupils_mm):
        # A pupil between two nodes reads both at equal blur, up to the other's own.
        beside = range(max(i - 1, 0), min(i + 2, len(pupils_mm)))
        nodes.append(
            defocus_nodes_dpt(
                min(ranges[j][0] * pupils_mm[j] / pupil_mm for j in beside),
                max(ranges[j][1] * pupils_mm[j] / pupil_mm for j in beside),
                blur_px_per_dpt=spec.blur_px_per_dpt(pupil_mm),
                max_blur_step_px=spec.max_blur_step_px,
            )
        )
    return CachePlan(
        pupils_mm=pupils_mm,
        accommodations_dpt=eye.accommodation_nodes_dpt(spec.focus_range_dpt),
        defocus_dpt=nodes,
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


def _spread_px(kernel: np.ndarray) -> float:
    """Radius of the uniform disc that has this kernel's sum of squares."""
    return 1.0 / math.sqrt(math.pi * float(np.square(kernel, dtype=np.float64).sum()))


def _requests(eye, spec, plan, channels):
    """Wavefronts (n, 28), pupils (n,) and wavelengths (n,), channel fastest."""
    wavelengths_nm = channel_wavelengths_nm(spec)[:channels]
    requests = [
        (pupil_mm, accommodation_dpt, total_dpt, wavelength_nm)
        for pupil_mm, nodes in zip(plan.pupils_mm, plan.defocus_dpt, strict=True)
        for accommodation_dpt in plan.accommodations_dpt
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
    accommodations = len(plan.accommodations_dpt)
    counts = np.repeat([len(nodes) for nodes in plan.defocus_dpt], accommodations)
    first_psf = RGB * np.concatenate([[0], np.cumsum(counts)[:-1]])
    return PsfStore(
        spec=spec,
        eye=eye,
        pupil_nodes_mm=plan.pupils_mm,
        accommodation_nodes_dpt=plan.accommodations_dpt,
        defocus_nodes_dpt=plan.defocus_dpt,
        first_psf=first_psf.reshape(-1, accommodations),
        kernels=np.concatenate([psf.kernel.ravel() for psf in psfs]).astype(np.float32),
        offsets=offsets[share],
        radius_px=np.array([psf.radius_px for psf in psfs])[share],
        blur_px=np.array([psf.blur_radius_px for psf in psfs])[share],
        spread_px=np.array([_spread_px(psf.kernel) for psf in psfs])[share],
        peak_ratio=np.array([float(psf.kernel.max()) for psf in psfs])[share],
        methods=dict(Counter(psf.method for psf in psfs)),
        max_lost_energy_ratio=max(psf.lost_energy_ratio for psf in psfs),
        build_ms=1e3 * (time.perf_counter() - started_s),
    )
