"""Ray-optical PSFs: every pupil cell splats its footprint, then the edge diffracts.

The pupil's edge sends the only light that rays do not explain until blur is no wider
than diffraction: Fresnel's straight edge, laid along the edge's own image.  Without
diffraction the method is the answer at any blur, down to a perfect eye's delta.
"""

import math
from concurrent.futures import Executor
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import fresnel

from estimator.optics.zernike import EXPONENTS
from estimator.psf.geometric_kernels import trace_batch
from estimator.psf.kernel_types import KernelBuffer
from estimator.psf.survey import PupilSurvey

FRESNEL_LIMIT = 14.0
"""Fresnel's edge is tabulated to here; beyond, its fringes count as averaged."""

_FRESNEL_STEPS = 4096
_PART = 32
"""PSFs per task: a task handed to a thread costs as much as half a PSF."""


@lru_cache(maxsize=1)
def fresnel_table() -> NDArray[np.float64]:
    """Integral from the dark side of (1/2)[(1/2+C)² + (1/2+S)²] less the step."""
    fine = 16
    v = np.linspace(-FRESNEL_LIMIT, FRESNEL_LIMIT, fine * _FRESNEL_STEPS + 1)
    s, c = fresnel(v)
    difference = 0.5 * ((0.5 + c) ** 2 + (0.5 + s) ** 2)
    difference -= np.where(v > 0.0, 1.0, np.where(v < 0.0, 0.0, 0.5))
    steps = (difference[1:] + difference[:-1]) * (v[1] - v[0]) / 2.0
    dark = 1.0 / (2.0 * math.pi**2 * FRESNEL_LIMIT)
    table = dark + np.concatenate([[0.0], np.cumsum(steps)])
    return np.ascontiguousarray(table[::fine])


def geometric_kernels(
    survey: PupilSurvey,
    members: NDArray[np.int64],
    *,
    diffraction: bool,
    output: KernelBuffer,
    pool: Executor,
) -> None:
    """Add pixel-integrated PSFs by ray optics to a buffer.

    Parameters
    ----------
    survey : PupilSurvey
    members : (M,)
        Which PSFs of the survey.
    diffraction : bool
        False leaves the edge's light out.
    output : KernelBuffer
    pool : Executor
        Of threads.
    """
    frames = survey.frames
    extent_px = survey.extent_px.max(axis=1)

    def work(part: NDArray[np.int64]) -> None:
        total = np.empty(part.size)
        trace_batch(
            (
                frames.box_polynomial_um[part],
                frames.half_width_um_per_px[part],
                frames.shear_ratio[part],
                frames.log_amplitude[part],
                survey.passed_ratio[part],
            ),
            EXPONENTS[:, 0],
            EXPONENTS[:, 1],
            (survey.edge_slope_px[part], survey.edge_light_um[part], extent_px[part]),
            (
                frames.wavelength_nm[part] / 1000.0,
                fresnel_table(),
                FRESNEL_LIMIT,
                diffraction,
            ),
            (
                output.flat_kernels,
                output.offset_count[part],
                output.radius_px[part],
                output.geometric_ratio[part],
                total,
            ),
        )
        output.total_ratio[part] += total

    list(
        pool.map(work, [members[i : i + _PART] for i in range(0, members.size, _PART)])
    )
