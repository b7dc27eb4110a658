"""Wave-optical PSFs: one FFT per wavefront, integrated exactly over pixels.

The angular samples per pixel are a whole number, so a short filter integrates over
pixels.  The edge of the pupil is low-pass filtered, so that its diffracted light does
not alias into the window.  All arithmetic is in float32.
"""

import math
import threading
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import i0, sici

from estimator.optics.zernike import EXPONENTS
from estimator.psf.fourier_kernels import (
    EDGE_HALF_WIDTH,
    EDGE_STEPS,
    fill_pupils,
    integrate_batch,
)
from estimator.psf.kernel_types import KernelBuffer
from estimator.psf.survey import PupilSurvey

MARGIN_PX = 1.6
"""Minimum margin of the window, px: it contains the neighbors of the spot's pixels.

For large pupils, a pixel is 16 lambda/D wide, and its neighbors contain up to 10 % of
the light of a sharp spot.  The mean edge light would be too inaccurate there: 7 % L2
error instead of 2 %.
"""

MAX_LENGTH = 4096
"""Longest FFT."""

_EDGE_TAPER = 3.75
_CHUNK_SAMPLES = 1 << 17
"""Complex samples processed at a time: 1 MiB stays in a core's L2 cache."""


@dataclass(frozen=True)
class FourierAccuracy:
    """Sampling parameters of an accuracy level.

    Attributes
    ----------
    oversampling : float
        Minimum number of angular samples per lambda/D.  With 2 or more, the intensity
        is not aliased.  Fewer suffice if a pixel contains many samples, because it
        averages the undersampled fringes.
    min_samples_per_px : int
        Samples per pixel below which the oversampling is increased, up to 2.
    margin : float
        Margin of the window on each side of the geometric spot, lambda/D.
    filter_half_width : int
        Extent of the pixel filter beyond the pixel, samples.
    """

    oversampling: float
    min_samples_per_px: int
    margin: float
    filter_half_width: int


ACCURACY = {
    "normal": FourierAccuracy(
        oversampling=1.0, min_samples_per_px=7, margin=8.0, filter_half_width=4
    ),
    "fine": FourierAccuracy(
        oversampling=2.0, min_samples_per_px=8, margin=16.0, filter_half_width=8
    ),
}


@dataclass(frozen=True)
class FourierPlan:
    """Grids of M PSFs; columns are x and y.

    Attributes
    ----------
    length_count : (M, 2) int64
        FFT lengths.
    samples_per_px_count : (M, 2) int64
        Angular samples per pixel.
    pupil_samples : (M, 2)
        Samples across the bounding box of the pupil, in general not integers.
    """

    length_count: NDArray[np.int64]
    samples_per_px_count: NDArray[np.int64]
    pupil_samples: NDArray[np.float64]


def _fast_lengths() -> NDArray[np.int64]:
    """Return even 5-smooth FFT lengths.

    Their cost per sample was measured to be within 20 % of that of powers of two.
    """
    found = {
        2**a * 3**b * 5**c for a in range(2, 15) for b in range(6) for c in range(4)
    }
    return np.array(sorted(n for n in found if 32 <= n <= MAX_LENGTH))


FAST_LENGTHS = _fast_lengths()


def plan_grids(
    *,
    extent_px: NDArray[np.float64],
    unit_px: NDArray[np.float64],
    accuracy: FourierAccuracy,
    lengths: NDArray[np.int64] = FAST_LENGTHS,
) -> FourierPlan:
    """Return the smallest grids whose windows contain the spots and their margins.

    Parameters
    ----------
    extent_px : (M, 2)
        Sides of the geometric spots.
    unit_px : (M, 2)
        lambda/D in pixels.
    accuracy : FourierAccuracy
    lengths : (n,) int64
        Allowed FFT lengths, ascending.

    Raises
    ------
    ValueError
        A window exceeds the largest length.
    """
    margin_px = np.maximum(accuracy.margin * unit_px, MARGIN_PX)
    window_px = extent_px + 2.0 * margin_px
    samples_per_px = np.maximum(
        np.ceil(accuracy.oversampling / unit_px),
        np.minimum(np.ceil(2.0 / unit_px), accuracy.min_samples_per_px),
    )
    while True:
        wanted = window_px * samples_per_px
        if wanted.size and wanted.max() > lengths[-1]:
            raise ValueError(
                f"wave PSF needs an FFT of {wanted.max():.0f} samples; at most "
                f"{lengths[-1]} are allowed: use the geometric method"
            )
        length = lengths[np.searchsorted(lengths, wanted)]
        pupil = length / (samples_per_px * unit_px)
        too_wide = pupil + 2 * EDGE_HALF_WIDTH > length
        if not too_wide.any():
            return FourierPlan(length, samples_per_px.astype(np.int64), pupil)
        samples_per_px += too_wide


@lru_cache(maxsize=1)
def edge_response() -> NDArray[np.float32]:
    """Return the step response of a Kaiser-windowed sinc, in steps of 1/256 sample.

    With a half width of 8 and beta = 3.75, light from the edge of the pupil passes up
    to 0.43 of the window and is attenuated by 40 dB from 0.57 on, so little of it
    aliases.  Measurements with wider or less tapered windows were no better.
    """
    t: NDArray[Any] = np.arange(
        -EDGE_HALF_WIDTH * EDGE_STEPS, EDGE_HALF_WIDTH * EDGE_STEPS + 1
    )
    t = t / EDGE_STEPS
    window = i0(
        _EDGE_TAPER * np.sqrt(np.maximum(0.0, 1.0 - (t / EDGE_HALF_WIDTH) ** 2))
    )
    impulse = np.sinc(t) * window
    steps: NDArray[np.float64] = np.concatenate(
        [[0.0], np.cumsum((impulse[1:] + impulse[:-1]) / 2.0)]
    )
    ratio: NDArray[np.float32] = (steps / steps[-1]).astype(np.float32)
    return ratio


@lru_cache(maxsize=256)
def pixel_filter(samples_per_px: int, half_width: int) -> NDArray[np.float32]:
    """Return weights that integrate a band-limited intensity over one pixel.

    Weight l is that of the sample at l - reach from the center of the pixel, with reach
    = ceil(k/2) + half_width and k samples per pixel.  The weights are those of sinc
    interpolation, (Si(pi b) - Si(pi a)) / pi for distances a and b to the edges of the
    pixel, tapered outside the pixel.  Their sum is k.
    """
    reach = (samples_per_px + 1) // 2 + half_width
    t = np.arange(-reach, reach + 1)
    half = samples_per_px / 2.0
    weights: NDArray[np.float64] = (
        sici(np.pi * (t + half))[0] - sici(np.pi * (t - half))[0]
    ) / np.pi
    beyond = np.clip((np.abs(t) - half) / (half_width + 1.0), 0.0, 1.0)
    weights *= np.cos(np.pi / 2.0 * beyond) ** 2
    weights *= samples_per_px / weights.sum()
    return weights.astype(np.float32)


def _filter_table(
    samples_per_px: NDArray[np.int64], half_width: int
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Return pixel filters: table (n, longest), lengths (n,) and indices (M, 2)."""
    counts, which = np.unique(samples_per_px, return_inverse=True)
    filters = [pixel_filter(int(k), half_width) for k in counts]
    table = np.zeros((len(filters), max((f.size for f in filters), default=1)))
    for row, weights in zip(table, filters, strict=True):
        row[: weights.size] = weights
    length = np.array([f.size for f in filters], np.int64)
    return table.astype(np.float32), length, which.reshape(samples_per_px.shape)


def _chunks(plan: FourierPlan, shear: NDArray[Any]) -> list[NDArray[np.int64]]:
    """Return indices into the plan, in batches of equal FFT lengths.

    Equal pupils are adjacent, so that they share their mask.
    """
    keys = (*plan.pupil_samples.T, shear, *plan.length_count.T)
    order = np.lexsort(keys)
    length = plan.length_count[order]
    ends = np.flatnonzero(np.any(length[1:] != length[:-1], axis=1)) + 1
    chunks = []
    for group in np.split(order, ends):
        step = max(1, _CHUNK_SAMPLES // int(plan.length_count[group[0]].prod()))
        chunks += [group[i : i + step] for i in range(0, group.size, step)]
    # Longest first, so that threads finish at about the same time.
    return chunks[::-1]


class _Work:
    """State shared by the threads of one call."""

    def __init__(
        self,
        survey: PupilSurvey,
        members: NDArray[np.int64],
        accuracy: FourierAccuracy,
        output: KernelBuffer,
    ):
        self.survey, self.members, self.output = survey, members, output
        self.local = threading.local()
        unit_px = survey.unit_px[members]
        self.plan = plan_grids(
            extent_px=survey.extent_px[members], unit_px=unit_px, accuracy=accuracy
        )
        k = self.plan.samples_per_px_count
        middle_px = (survey.slope_low_px + survey.slope_high_px)[members] / 2.0
        self.center = np.rint(middle_px * k).astype(np.int64)
        self.center_px = self.center / k
        self.size = np.minimum(
            self.plan.length_count,
            np.ceil(self.plan.pupil_samples).astype(np.int64) + 2 * EDGE_HALF_WIDTH,
        )
        # The share of the light in an angular sample is |sum|² (area of a pupil
        # sample)² / (lambda² A) times (angle of a sample)².  The product of the areas
        # and angles is lambda²/N², which leaves 1/(N² A) for A in samples.
        shear = survey.frames.shear_ratio[members]
        ellipse = math.pi / 4.0 * np.sqrt(1.0 - shear**2)
        area = ellipse * self.plan.pupil_samples.prod(axis=1)
        self.scale = 1.0 / (area * self.plan.length_count.prod(axis=1))
        self.scale /= survey.passed_ratio[members]
        self.table, self.length, self.which = _filter_table(
            k, accuracy.filter_half_width
        )

    def _scratch(self, *shape: int) -> NDArray[np.complex64]:
        """Return zeros in memory that this thread reuses.

        Page faults in newly allocated memory would take a third of the total time.
        """
        count = math.prod(shape)
        if getattr(self.local, "field", np.empty(0)).size < count:
            self.local.field = np.empty(max(count, _CHUNK_SAMPLES), np.complex64)
        field: NDArray[np.complex64] = self.local.field[:count].reshape(shape)
        field[...] = 0.0
        return field

    def compute(self, part: NDArray[np.int64]) -> None:
        """Compute one batch of equal FFT lengths into the output."""
        frames, members = self.survey.frames, self.members[part]
        columns, rows = self.plan.length_count[part[0]].tolist()
        size = self.size[part]
        polynomial = frames.box_polynomial_um[members]
        half = frames.half_width_um_per_px[members]
        shear, log_amplitude = frames.shear_ratio[members], frames.log_amplitude
        wavelength_um = frames.wavelength_nm[members] / 1000.0
        field = self._scratch(part.size, rows, columns)
        fill_pupils(
            (polynomial, half, shear, log_amplitude[members], wavelength_um),
            EXPONENTS[:, 0],
            EXPONENTS[:, 1],
            (self.plan.pupil_samples[part], size),
            self.center_px[part],
            edge_response(),
            field,
        )
        if self.survey.screen is not None:
            samples = self.plan.pupil_samples[part]
            self.survey.screen.apply(members, samples, size, field)
        # In place; rows outside the pupil are zero.
        lit = field[:, : int(size[:, 1].max())]
        spectra = scipy.fft.fft(lit, axis=2, overwrite_x=True)
        if not np.may_share_memory(spectra, lit):
            lit[...] = spectra
        field = scipy.fft.fft(field, axis=1, overwrite_x=True)
        output = self.output
        total = np.empty(part.size)
        integrate_batch(
            field,
            (self.center[part], self.plan.samples_per_px_count[part], self.scale[part]),
            (self.table, self.length, self.which[part]),
            (
                self.survey.edge_slope_px[members],
                half,
                shear,
                self.survey.edge_light_um[members],
            ),
            (
                output.flat_kernels,
                output.offset_count[members],
                output.radius_px[members],
                1.0 - output.geometric_ratio[members],
                total,
            ),
        )
        output.total_ratio[members] += total


def fourier_kernels(
    survey: PupilSurvey,
    members: NDArray[np.int64],
    *,
    accuracy: FourierAccuracy,
    output: KernelBuffer,
    pool: Executor,
) -> None:
    """Add pixel-integrated PSFs by the wave method to a buffer.

    Parameters
    ----------
    survey : PupilSurvey
    members : (M,)
        Indices of the PSFs in the survey.
    accuracy : FourierAccuracy
    output : KernelBuffer
    pool : Executor
        Thread pool; tasks release the GIL for most of their time.

    Notes
    -----
    PSF(p) = |int_pupil exp(2 pi i (W - p.t) / lambda) dt|² / (lambda² A) in the
    coordinates of `pupil.py`, with A the pupil's area there.
    """
    if members.size == 0:
        return
    work = _Work(survey, members, accuracy, output)
    list(pool.map(work.compute, _chunks(work.plan, survey.frames.shear_ratio[members])))
