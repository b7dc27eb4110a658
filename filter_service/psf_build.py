"""Builds the PSF cache of a profile for a camera: CPU only, no GL, cancellable."""

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimator.measured_wavefront import MeasuredWavefront
from estimator.profiles import EyeProfile
from estimator.psf import Psf, compute_psfs
from estimator.units import REFERENCE_WAVELENGTH_NM
from filter_service.constants import RGB
from filter_service.errors import BuildCancelled
from filter_service.psf_grid import GridSpec, defocus_nodes_dpt, pupil_nodes_mm
from filter_service.psf_store import PsfStore, channel_defocus_dpt

COMPUTED_BEYOND = 0.2
"""Kernels are computed out to this share of the light that trimming will drop."""

MAX_CENTROID_SHIFT_PX = 0.005
"""Trimming stops where it would move a kernel's centroid farther than this."""

CHUNK = 192
"""PSFs between two looks at progress and cancellation."""


def total_defocus_range_dpt(
    eye: MeasuredWavefront, spec: GridSpec
) -> tuple[float, float]:
    """Smallest and largest total defocus over objects, foci and channels."""
    relaxed_dpt = channel_defocus_dpt(eye, spec)
    accommodation_dpt = [eye.accommodation_dpt(f) for f in spec.focus_range_dpt]
    low = relaxed_dpt.min() + spec.object_range_dpt[0] - max(accommodation_dpt)
    high = relaxed_dpt.max() + spec.object_range_dpt[1] - min(accommodation_dpt)
    return float(low), float(high)


def plan_nodes(eye: MeasuredWavefront, spec: GridSpec) -> tuple[np.ndarray, list]:
    """Pupil nodes and, for each, the defocus nodes that any pupil beside it needs."""
    low_mm, high_mm = (eye.usable_pupil_mm(p) for p in spec.pupil_range_mm)
    pupils_mm = pupil_nodes_mm((low_mm, high_mm))
    low_dpt, high_dpt = total_defocus_range_dpt(eye, spec)
    nodes = []
    for i, pupil_mm in enumerate(pupils_mm):
        # Read from the pupil above at equal blur, so wider by the ratio of diameters.
        widest_mm = pupils_mm[min(i + 1, len(pupils_mm) - 1)]
        narrowest_mm = pupils_mm[max(i - 1, 0)]
        ratios = (narrowest_mm / pupil_mm, widest_mm / pupil_mm)
        nodes.append(
            defocus_nodes_dpt(
                min(low_dpt * r for r in ratios),
                max(high_dpt * r for r in ratios),
                blur_px_per_dpt=spec.blur_px_per_dpt(pupil_mm),
                max_blur_step_px=spec.max_blur_step_px,
            )
        )
    return pupils_mm, nodes


def build_psf_store(
    profile: EyeProfile,
    spec: GridSpec,
    *,
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> PsfStore:
    """Compute every PSF that frames of this camera, pupil and focus range can need.

    Parameters
    ----------
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
    eye = MeasuredWavefront.from_profile(profile)
    pupils_mm, defocus_nodes = plan_nodes(eye, spec)
    channels = RGB if spec.chromatic else 1
    zernike_um, pupil_of, wavelength_of = _requests(
        eye, spec, pupils_mm, defocus_nodes, channels
    )
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
    return _packed(spec, eye, pupils_mm, defocus_nodes, channels, psfs, started_s)


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


def _requests(eye, spec, pupils_mm, defocus_nodes, channels):
    """Wavefronts (n, 28), pupils (n,) and wavelengths (n,), channel fastest."""
    wavelengths_nm = (
        spec.wavelengths_nm if spec.chromatic else (REFERENCE_WAVELENGTH_NM,)
    )
    measured_dpt = eye.refraction_at_dpt(eye.wavelength_nm)
    zernike_um, pupil_of = [], []
    for pupil_mm, nodes in zip(pupils_mm, defocus_nodes, strict=True):
        for total_dpt in nodes:
            coefficients = eye.zernike_with_defocus(
                pupil_diameter_mm=pupil_mm, added_defocus_dpt=total_dpt - measured_dpt
            )
            zernike_um += [coefficients] * channels
            pupil_of += [pupil_mm] * channels
    wavelength_of = np.tile(wavelengths_nm, len(zernike_um) // channels)
    return np.array(zernike_um), np.array(pupil_of), wavelength_of


def _packed(spec, eye, pupils_mm, defocus_nodes, channels, psfs, started_s) -> PsfStore:
    sizes = np.array([psf.kernel.size for psf in psfs])
    share = np.repeat(np.arange(len(psfs)), RGB // channels)
    offsets = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    node_counts = np.array([len(nodes) for nodes in defocus_nodes])
    return PsfStore(
        spec=spec,
        eye=eye,
        pupil_nodes_mm=pupils_mm,
        defocus_nodes_dpt=defocus_nodes,
        first_psf=RGB * np.concatenate([[0], np.cumsum(node_counts)[:-1]]),
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
