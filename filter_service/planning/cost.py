"""Cost of a planned cache: memory from predicted box sizes, time from a cost model."""

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import ACCURACY
from estimator.psf.fourier import plan_grids
from estimator.psf.survey import (
    PIXEL_CORNER_PX,
    PupilSurvey,
    needed_radius_px,
)
from estimator.psf.switch import geometric_shares
from estimator.threads import relative_core_time, thread_count
from filter_service.constants import RGB
from filter_service.planning.grid import GridSpec
from filter_service.planning.node_wavefronts import PupilStates, state_survey
from filter_service.planning.nodes import CachePlan

_LENGTHS = np.unique(
    [2**a * 3**b * 5**c for a in range(5, 24) for b in range(3) for c in range(2)]
)
"""FFT lengths without an upper limit: PSFs that need longer FFTs than the engine
supports are refused when the cache is built."""

SAMPLES = 1536
"""Largest number of PSFs whose wavefronts are evaluated for a prediction."""

BYTES_PER_TEXEL = 2

COMPUTED_BEYOND = 0.2
"""Light that a computed kernel may lack, relative to the light that cropping may
drop."""


class PlanCost(TypedDict):
    """Cost of a plan; fields as in `PlanPrediction`."""

    psf_count: int
    memory_mb: float
    build_s: float
    core_count: int


def predicted_cost(eye: EyeOptics, spec: GridSpec, plan: CachePlan) -> PlanCost:
    """Predict the number, memory and build time of a plan's PSFs."""
    count = channel_count(spec) * len(plan.nodes.defocus.values_dpt)
    states = plan_states(spec, plan, SAMPLES)
    survey = state_survey(eye, spec, states)
    texels = float(np.mean(box_texels(spec, survey)))
    cores = thread_count()
    per_psf = len(spec.primary_wavelengths_nm)
    wavefront_us = sum(
        TERM_US[name] * float(np.mean(values))
        for name, values in cost_terms(spec, survey).items()
    )
    if spec.settings.pipeline == "published":
        wavefront_us = SERIES_US
    time_us = per_psf * relative_core_time() * wavefront_us
    return {
        "psf_count": count,
        "memory_mb": BYTES_PER_TEXEL * texels * count / 1e6,
        "build_s": time_us * count / cores / 1e6,
        "core_count": cores,
    }


def plan_states(spec: GridSpec, plan: CachePlan, most: int) -> PupilStates:
    """Return the states of a plan's PSFs, or of ``most`` evenly spaced ones."""
    n_channels = channel_count(spec)
    count = n_channels * len(plan.nodes.defocus.values_dpt)
    psfs = np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
    return states_of(spec, plan, psfs // n_channels, psfs % n_channels)


def channel_count(spec: GridSpec) -> int:
    """Return the number of channels that do not share PSFs: 3, or 1 without color."""
    return RGB if spec.settings.chromatic else 1


def states_of(
    spec: GridSpec,
    plan: CachePlan,
    nodes: NDArray[np.int64],
    channel: NDArray[np.int64],
) -> PupilStates:
    """Return the states (n,) of the eye at nodes and channels of a plan."""
    defocus = plan.nodes.defocus
    groups = defocus.group_at(nodes)
    pupil, accommodation, v, h = np.unravel_index(groups, plan.group_shape)
    return PupilStates(
        h_deg=plan.h_deg[h],
        v_deg=plan.v_deg[v],
        pupil_diameter_mm=plan.pupils_mm[pupil],
        accommodation_dpt=plan.accommodations_dpt[accommodation],
        wavelength_nm=spec.channel_wavelengths_nm[channel],
        total_defocus_dpt=defocus.values_dpt[nodes]
        + plan.nodes.channel_shift_dpt[groups, channel],
    )


def kernel_radius_px(
    spec: GridSpec, survey: PupilSurvey, *, share: float
) -> NDArray[np.int64]:
    """Return kernel radii (P,) that lose a share of the light that a cache may drop."""
    if not spec.settings.diffraction:
        radius_px = np.ceil(survey.blur_radius_px + PIXEL_CORNER_PX)
        return np.minimum(radius_px, LARGEST_RADIUS_PX).astype(np.int64)
    return needed_radius_px(
        survey,
        lost_energy_ratio=share * (1.0 - spec.kept_energy_ratio),
        tail_end_px=spec.max_blur_radius_px,
    )


def box_texels(spec: GridSpec, survey: PupilSurvey) -> NDArray[np.float64]:
    """Return the size (P,) of the boxes that kernels are cropped to (`psfs/pack.py`).

    The box is the bounding box of the rays, extended by the radius that diffraction
    adds to the disc.  For 24 plans, the result was 0.89 to 1.09 of the measured size of
    the cache.
    """
    beyond_px = np.maximum(
        kernel_radius_px(spec, survey, share=1.0)
        - np.ceil(survey.blur_radius_px + PIXEL_CORNER_PX),
        0,
    )
    sides_px = np.concatenate([-survey.slope_low_px, survey.slope_high_px], axis=1)
    reach_px = np.ceil(np.maximum(sides_px, 0.0) + beyond_px[:, None] - 0.5)
    return (reach_px[:, 0] + reach_px[:, 2] + 1.0) * (
        reach_px[:, 1] + reach_px[:, 3] + 1.0
    )


LARGEST_RADIUS_PX = 1e9
"""A radius beyond the limit of any plan and within the range of integers."""

TERM_US = {"psf": 56.5, "wave": 2.24e-4, "texels": 0.0134}
"""Processor time per unit of each term of `cost_terms` on an AMD EPYC, in us.
`relative_core_time` scales it for other machines.  36 batches of 768 PSFs of three eyes
and three image sizes, 56 to 465 us per PSF, took 0.77 to 1.19 of the prediction."""


SERIES_US = 1.5e5
"""Processor time of a PSF by the ENZ series on an AMD EPYC: 29 to 250 ms through six
eyes (`ocufilter bench published`)."""


def cost_terms(spec: GridSpec, survey: PupilSurvey) -> dict[str, NDArray[np.float64]]:
    """Return the work for each PSF (P,): a constant, its transform and its texels."""
    radius_px = kernel_radius_px(spec, survey, share=COMPUTED_BEYOND)
    count = survey.blur_radius_px.size
    share = geometric_shares(survey) if spec.settings.diffraction else np.ones(count)
    if survey.screen is not None:
        share = np.zeros(count)
    samples = np.zeros(count)
    chosen = share < 1.0
    if chosen.any():
        grids = plan_grids(
            extent_px=survey.extent_px[chosen],
            unit_px=survey.unit_px[chosen],
            accuracy=ACCURACY["normal"],
            lengths=_LENGTHS,
        )
        samples[chosen] = grids.length_count.prod(axis=1)
    return {
        "psf": np.ones(count),
        "wave": samples * np.log2(np.maximum(samples, 2.0)),
        "texels": np.asarray((2.0 * radius_px + 1.0) ** 2, dtype=np.float64),
    }
