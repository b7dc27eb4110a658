"""Builds the PSF cache of an eye for a camera, in chunks, cancellable."""

import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import EyeProfile
from estimator.psf.compute import PsfBatch
from estimator.threads import thread_count
from estimator.wavefront.field_wavefronts import with_tilt
from filter_service.constants import RGB
from filter_service.errors import BuildCancelled
from filter_service.planning.cost import COMPUTED_BEYOND
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.plan import CachePlan, plan_cache
from filter_service.planning.slopes import PupilStates, apodisation
from filter_service.psfs.pack import PackedKernels, pack_kernels
from filter_service.psfs.psf_engine import CPU, PsfEngine
from filter_service.psfs.several_foci import sharpest_blur_px
from filter_service.psfs.store import PsfStore
from filter_service.psfs.wide_primaries import mean_batch, states_of_primaries


def build_psf_store(
    eye: EyeOptics | EyeProfile,
    spec: GridSpec,
    *,
    plan: CachePlan | None = None,
    engine: PsfEngine = CPU,
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> PsfStore:
    """Compute every PSF that frames of this camera, pupil and focus range can need.

    Parameters
    ----------
    eye : EyeOptics or EyeProfile
        A profile is used as the measured wavefront.
    plan : CachePlan, optional
        Nodes other than those that `planning.plan.plan_cache` chooses.
    engine : PsfEngine
    progress : callable, optional
        Called with a fraction 0..1 and a stage.
    cancelled : callable, optional
        Asked between chunks of a few hundred PSFs.

    Raises
    ------
    filter_service.errors.BuildCancelled
    estimator.psf.compute.PsfTooLarge
        A kernel exceeds ``spec.max_blur_radius_px``; the message has the numbers.
    filter_service.planning.plan.PlanTooLarge
    """
    started_s = time.perf_counter()
    if isinstance(eye, EyeProfile):
        eye = MeasuredWavefront.from_profile(eye)
    plan = plan or plan_cache(eye, spec)
    channels = RGB if spec.settings.chromatic else 1
    states = _states(spec, plan, channels)
    shrink = _shrink_ratios(plan, channels)
    count, step = states.h_deg.size, engine.batch_count
    methods: Counter[str] = Counter()
    packed, blur_px = [], []
    with ThreadPoolExecutor(thread_count()) as pool:
        for first in range(0, count, step):
            if cancelled is not None and cancelled():
                raise BuildCancelled("a newer profile took over")
            part = slice(first, first + step)
            batch = _computed(engine, eye, spec, states.taken(part), shrink[part])
            packed.append(
                pack_kernels(batch, kept_energy_ratio=spec.kept_energy_ratio, pool=pool)
            )
            blur_px.append(batch.blur_radius_px)
            methods += _methods(batch)
            if progress is not None:
                progress(min(1.0, (first + step) / count), "psfs")
    return _joined(
        packed,
        spec=spec,
        eye=eye,
        plan=plan,
        blur_px=np.concatenate(blur_px),
        methods=dict(methods),
        build_ms=1e3 * (time.perf_counter() - started_s),
    )


def _states(spec: GridSpec, plan: CachePlan, channels: int) -> PupilStates:
    """States whose PSFs make up a cache, channel fastest."""
    v_deg, h_deg, pupils_mm, used_dpt = (
        axis.ravel()
        for axis in np.meshgrid(
            *(plan.v_deg, plan.h_deg, plan.pupils_mm, plan.accommodations_dpt),
            indexing="ij",
        )
    )
    of_group = np.repeat(np.arange(h_deg.size), np.diff(plan.defocus.starts))
    wavelengths_nm = np.array(spec.channel_wavelengths_nm[:channels])

    def each(values: NDArray) -> NDArray[np.float64]:
        return np.repeat(values, channels)

    shift_dpt = plan.channel_shift_dpt[of_group, :channels]
    return PupilStates(
        h_deg=each(h_deg[of_group]),
        v_deg=each(v_deg[of_group]),
        pupil_diameter_mm=each(pupils_mm[of_group]),
        accommodation_dpt=each(used_dpt[of_group]),
        total_defocus_dpt=(plan.defocus.values_dpt[:, None] + shift_dpt).ravel(),
        wavelength_nm=np.tile(wavelengths_nm, of_group.size),
    )


def _shrink_ratios(plan: CachePlan, channels: int) -> NDArray[np.float64]:
    """Ratios of the states' wavefronts, in the order of `_states`."""
    counts = channels * np.diff(plan.defocus.starts)
    if plan.shrink_ratio is None:
        return np.ones(int(counts.sum()))
    return np.repeat(plan.shrink_ratio, counts)


def _computed(
    engine: PsfEngine,
    eye: EyeOptics,
    spec: GridSpec,
    states: PupilStates,
    shrink_ratio: NDArray[np.float64],
) -> PsfBatch:
    per_psf = len(spec.primary_wavelengths_nm)
    if per_psf > 1:
        states = states_of_primaries(eye, spec, states)
        shrink_ratio = np.repeat(shrink_ratio, per_psf)
    found = eye.wavefronts(**vars(states))
    zernike_um = found.zernike_um * shrink_ratio[:, None]
    if spec.settings.lateral_color and spec.settings.chromatic:
        shift_mrad = lateral_shift_mrad(eye, spec, states)
        zernike_um = with_tilt(zernike_um, found.circle_diameter_mm / 2.0, shift_mrad)
    batch = engine.compute(
        zernike_um,
        pupil_diameter_mm=found.circle_diameter_mm,
        pupil_ellipse=found.pupil_ellipse,
        stiles_crawford=apodisation(eye, spec),
        pupil_screen=eye.rings and eye.rings.seen_from(states.h_deg, states.v_deg),
        wavelength_nm=states.wavelength_nm,
        pixel_from_mrad=spec.node_pixel_from_mrad(states.h_deg, states.v_deg),
        diffraction=spec.settings.diffraction,
        max_radius_px=spec.max_blur_radius_px,
        min_energy_ratio=1.0 - COMPUTED_BEYOND * (1.0 - spec.kept_energy_ratio),
    )
    if eye.rings is not None:
        blur_px = sharpest_blur_px(eye, spec, states)
        batch = replace(batch, blur_radius_px=blur_px)
    return mean_batch(batch, per_psf)


def lateral_shift_mrad(
    eye: EyeOptics, spec: GridSpec, states: PupilStates
) -> NDArray[np.float64]:
    """Shifts (P, 2) of PSFs along the pupil axes, against green's."""
    place = {
        "h_deg": states.h_deg,
        "v_deg": states.v_deg,
        "accommodation_dpt": states.accommodation_dpt,
    }
    own, green = (
        eye.chief_ray_shift_mrad(**place, wavelength_nm=wavelength_nm)
        for wavelength_nm in (states.wavelength_nm, spec.wavelengths_nm[GREEN])
    )
    return own - green


def _methods(batch: PsfBatch) -> Counter[str]:
    """PSFs by the method that has the larger share in them."""
    by_rays = int(np.count_nonzero(batch.geometric_ratio > 0.5))
    counts = {"geometric": by_rays, batch.wave_method: len(batch) - by_rays}
    return Counter({name: number for name, number in counts.items() if number})


def _joined(
    packed: list[PackedKernels], *, spec: GridSpec, blur_px: NDArray, **fields: Any
) -> PsfStore:
    """Return the store of all kernels of a plan, from batches one after the other."""

    def joined(name: str) -> NDArray:
        return np.concatenate([getattr(part, name) for part in packed])

    ends = np.cumsum([part.weights.size for part in packed])
    offsets = np.concatenate(
        [
            part.offsets + end - part.weights.size
            for part, end in zip(packed, ends, strict=True)
        ]
    )
    copies = 1 if spec.settings.chromatic else RGB  # channels that share a kernel
    return PsfStore(
        spec=spec,
        kernels=joined("weights"),
        offsets=np.repeat(offsets, copies),
        reach_px=np.repeat(joined("reach_px"), copies, axis=0),
        radius_px=np.repeat(joined("radius_px"), copies),
        blur_px=np.repeat(blur_px, copies),
        spread_px=np.repeat(joined("spread_px"), copies),
        peak_ratio=np.repeat(joined("peak_ratio"), copies),
        max_lost_energy_ratio=float(joined("lost_energy_ratio").max()),
        **fields,
    )
