"""Ray-optical PSFs: footprints of pupil cells, plus diffraction at the pupil's edge.

If blur is wider than diffraction, light deviates from ray optics only near the image of
the edge of the pupil, where it follows Fresnel diffraction at a straight edge.  Without
diffraction, the method is exact at any blur; the PSF of a perfect eye is one pixel.
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
"""Limit of the table of straight-edge diffraction; fringes beyond it are averaged."""

_FRESNEL_STEPS = 4096
_PART = 32
"""PSFs per task: dispatching a task to a thread takes as long as half a PSF."""


@lru_cache(maxsize=1)
def fresnel_table() -> NDArray[np.float64]:
    """Return the integral of straight-edge diffraction minus the geometric shadow.

    The irradiance is (1/2)[(1/2+C)² + (1/2+S)²]; the integral starts in the shadow.
    """
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
        Indices of the PSFs in the survey.
    diffraction : bool
        Whether to include diffraction at the edge of the pupil.
    output : KernelBuffer
    pool : Executor
        Thread pool.
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
