"""Wave-optical PSFs: one FFT per wavefront, integrated exactly over pixels.

The angular sampling is an integer fraction of the pixel, so that the integral over
pixels is one short filter for all PSFs of a call; the pupil's edge is low-passed, so
that its diffraction does not fold back into the window.  float32 throughout.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import i0, sici

from estimator.psf_fourier_kernels import fill_pupils, integrate_pixels
from estimator.psf_survey import PupilSurvey
from estimator.psf_tail import add_tail
from estimator.zernike import EXPONENTS

EDGE_HALF_WIDTH = 8
"""Samples by which the smoothed pupil reaches beyond its edge."""

MARGIN_PX = 1.6
"""Least margin in pixels: the neighbours of the spot's pixels lie inside the window.

With large pupils a pixel is 16 lambda/D wide and its neighbours hold up to 10 % of a
sharp spot: the mean edge light is no answer there (L2 7 % instead of 2 %).
"""

_EDGE_TAPER = 3.75
_EDGE_STEPS = 256
_CHUNK_SAMPLES = 1 << 17
"""Complex samples worked on at a time: 1 MiB stays in a core's L2 cache."""


@dataclass(frozen=True)
class FourierAccuracy:
    """Sampling rule of one accuracy level.

    Attributes
    ----------
    oversampling : float
        Least field samples per lambda/D.  From 2 on the intensity is band-limited; less
        is enough where a pixel holds many samples, for it then averages the fringes
        that are sampled too coarsely.
    min_samples_per_px : int
        Samples in a pixel below which the oversampling rises, up to 2.
    margin : float
        Window beyond the geometric spot, lambda/D on each side.
    filter_half_width : int
        Reach of the pixel filter beyond the pixel, samples.
    """

    oversampling: float
    min_samples_per_px: int
    margin: float
    filter_half_width: int


@dataclass(frozen=True)
class FourierPlan:
    """Grid of one PSF: hashable, PSFs with equal plans share a batch.

    Attributes
    ----------
    n_samples : int
        FFT length N.
    samples_per_px : (x, y)
        Angular samples in a pixel; the sampling is pixel / samples_per_px.
    pupil_samples : (x, y)
        Pupil samples across the diameter, not whole numbers.
    """

    n_samples: int
    samples_per_px: tuple[int, int]
    pupil_samples: tuple[float, float]


def _fast_lengths() -> NDArray[np.int64]:
    """Even 5-smooth lengths: measured within 20 % of the cost of powers of two."""
    found = {
        2**a * 3**b * 5**c for a in range(2, 15) for b in range(6) for c in range(4)
    }
    return np.array(sorted(n for n in found if 32 <= n <= 4096))


_FAST_LENGTHS = _fast_lengths()


def plan_grid(
    *,
    half_extent_mrad: float,
    pupil_diameter_mm: float,
    wavelength_nm: float,
    pixel_pitch_mrad: tuple[float, float],
    accuracy: FourierAccuracy,
) -> FourierPlan:
    """Smallest grid whose window holds the spot and its margin.

    Raises
    ------
    ValueError
        No FFT up to 4096 holds the window.
    """
    unit_mrad = wavelength_nm / 1000.0 / pupil_diameter_mm
    margin_mrad = max(accuracy.margin * unit_mrad, MARGIN_PX * max(pixel_pitch_mrad))
    window_mrad = 2.0 * (half_extent_mrad + margin_mrad)
    samples_per_px = [
        max(
            math.ceil(accuracy.oversampling * pitch / unit_mrad),
            min(math.ceil(2.0 * pitch / unit_mrad), accuracy.min_samples_per_px),
        )
        for pitch in pixel_pitch_mrad
    ]
    while True:
        spacing_mrad = [
            pitch / k for pitch, k in zip(pixel_pitch_mrad, samples_per_px, strict=True)
        ]
        wanted = max(window_mrad / spacing for spacing in spacing_mrad)
        if wanted > _FAST_LENGTHS[-1]:
            raise ValueError(
                f"wave PSF needs an FFT of {wanted:.0f} samples; at most "
                f"{_FAST_LENGTHS[-1]} are allowed: use the geometric method"
            )
        n_samples = int(_FAST_LENGTHS[np.searchsorted(_FAST_LENGTHS, wanted)])
        pupil = [n_samples * spacing / unit_mrad for spacing in spacing_mrad]
        too_wide = [p + 2 * EDGE_HALF_WIDTH > n_samples for p in pupil]
        if not any(too_wide):
            return FourierPlan(n_samples, tuple(samples_per_px), tuple(pupil))
        samples_per_px = [
            k + wide for k, wide in zip(samples_per_px, too_wide, strict=True)
        ]


@lru_cache(maxsize=1)
def _edge_response() -> NDArray[np.float64]:
    """Response of a Kaiser-windowed sinc to a step, at 1/256 sample.

    Half width 8, beta 3.75: light from the pupil's edge is kept up to 0.43 of the
    window and 40 dB down from 0.57 on, so that hardly any folds back into the window.
    Wider or less tapered edges measured no better.
    """
    t = np.arange(-EDGE_HALF_WIDTH * _EDGE_STEPS, EDGE_HALF_WIDTH * _EDGE_STEPS + 1)
    t = t / _EDGE_STEPS
    window = i0(
        _EDGE_TAPER * np.sqrt(np.maximum(0.0, 1.0 - (t / EDGE_HALF_WIDTH) ** 2))
    )
    impulse = np.sinc(t) * window
    steps = np.concatenate([[0.0], np.cumsum((impulse[1:] + impulse[:-1]) / 2.0)])
    return steps / steps[-1]


@lru_cache(maxsize=256)
def _pupil_mask(
    pupil_samples: tuple[float, float], n_samples: int
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Smoothed pupil and the normalised positions of its columns and rows."""
    size = [min(n_samples, math.ceil(p) + 2 * EDGE_HALF_WIDTH) for p in pupil_samples]
    x, y = (
        (np.arange(m) - (m - 1) / 2.0) * 2.0 / p
        for m, p in zip(size, pupil_samples, strict=True)
    )
    rho = np.hypot(x, y[:, None])
    # Radial sample spacing in the direction of each point (the grid may be
    # anisotropic): |(x, y)| / |(x, y) in samples|, times 2 / diameter.
    in_samples = np.hypot(x * pupil_samples[0], y[:, None] * pupil_samples[1]) / 2.0
    per_radius = in_samples / np.maximum(rho, 1e-9)
    depth = (1.0 - rho) * per_radius
    table = _edge_response()
    mask = np.interp(
        depth * _EDGE_STEPS + EDGE_HALF_WIDTH * _EDGE_STEPS,
        np.arange(table.size),
        table,
    ).astype(np.float32)
    mask.setflags(write=False)
    return mask, x, y


@lru_cache(maxsize=256)
def _pixel_filter(samples_per_px: int, half_width: int) -> NDArray[np.float32]:
    """Weights that integrate a band-limited intensity over one pixel.

    Tap l stands for the sample at l - reach from the pixel's centre,
    reach = ceil(k/2) + half_width.  Exact weights of the sinc interpolation,
    (Si(pi b) - Si(pi a)) / pi with a, b the distances to the pixel's edges, tapered
    beyond the pixel; their sum is k, the pixel in samples.
    """
    reach = (samples_per_px + 1) // 2 + half_width
    t = np.arange(-reach, reach + 1)
    half = samples_per_px / 2.0
    weights = (sici(np.pi * (t + half))[0] - sici(np.pi * (t - half))[0]) / np.pi
    beyond = np.clip((np.abs(t) - half) / (half_width + 1.0), 0.0, 1.0)
    weights *= np.cos(np.pi / 2.0 * beyond) ** 2
    weights *= samples_per_px / weights.sum()
    return weights.astype(np.float32)


def _dense_polynomials(polynomial_um, wavelength_nm) -> NDArray[np.float64]:
    """(P, 7, 7): turns of phase, ``[p, b, a]`` multiplies y^b x^a."""
    dense = np.zeros((polynomial_um.shape[0], 7, 7))
    turns = polynomial_um / (wavelength_nm[:, None] / 1000.0)
    dense[:, EXPONENTS[:, 1], EXPONENTS[:, 0]] = turns
    return dense


@dataclass(frozen=True)
class _Batch:
    """PSFs that share a plan; arrays lead with the PSF."""

    plan: FourierPlan
    members: NDArray[np.int64]


def _centers_in_samples(survey, members, plan, pixel_pitch_mrad):
    """Window centres (P, 2) on the angular grid, whole samples."""
    center = (survey.slope_low_mrad[members] + survey.slope_high_mrad[members]) / 2.0
    spacing = np.asarray(pixel_pitch_mrad) / np.asarray(plan.samples_per_px)
    return np.rint(center / spacing).astype(np.int64), spacing


def _window_pixels(center, n_samples, samples_per_px) -> tuple[int, int]:
    """First and last pixel that lie wholly inside the window along one axis."""
    half = n_samples / 2.0 - 1.0
    first = math.ceil((center - half) / samples_per_px + 0.5)
    last = math.floor((center + half) / samples_per_px - 0.5)
    return first, last


def _compute_chunk(survey, batch, members, radius_px, pixel_pitch_mrad, accuracy):
    plan = batch.plan
    n = plan.n_samples
    kx, ky = plan.samples_per_px
    center, spacing = _centers_in_samples(survey, members, plan, pixel_pitch_mrad)
    mask, x, y = _pupil_mask(plan.pupil_samples, n)
    turns = _dense_polynomials(
        survey.polynomial_um[members], survey.wavelength_nm[members]
    )
    radius_turns = survey.pupil_diameter_mm[members] / 2.0
    radius_turns = radius_turns / (survey.wavelength_nm[members] / 1000.0)
    turns[:, 0, 1] -= radius_turns * center[:, 0] * spacing[0]
    turns[:, 1, 0] -= radius_turns * center[:, 1] * spacing[1]
    field = np.zeros((len(members), mask.shape[0], n), np.complex64)
    fill_pupils(turns, mask, x, y, field)
    field = scipy.fft.fft(field, axis=2, overwrite_x=True)
    field = scipy.fft.fft(field, n=n, axis=1, overwrite_x=True)
    # |sum|² (area of a pupil sample)² / (lambda² pi R²) (angle of a sample)² is the
    # share of the light in one angular sample; areas and angles multiply to
    # lambda²/N², leaving 1/N² times the pupil's area in samples.
    scale = 4.0 / (math.pi * plan.pupil_samples[0] * plan.pupil_samples[1] * n * n)
    half_width = accuracy.filter_half_width
    filters = _pixel_filter(kx, half_width), _pixel_filter(ky, half_width)
    kernels = []
    for i, p in enumerate(members):
        radius = int(radius_px[p])
        kernel = np.zeros((2 * radius + 1, 2 * radius + 1), np.float32)
        x0, x1 = _window_pixels(center[i, 0], n, kx)
        y0, y1 = _window_pixels(center[i, 1], n, ky)
        window = (
            max(x0, -radius),
            min(x1, radius),
            max(y0, -radius),
            min(y1, radius),
        )
        integrate_pixels(
            field[i], center[i], np.array(window), kx, ky, *filters, scale, kernel
        )
        add_tail(kernel, survey, p, pixel_pitch_mrad=pixel_pitch_mrad)
        kernels.append(kernel)
    return kernels


def fourier_kernels(
    survey: PupilSurvey,
    members: NDArray[np.int64],
    *,
    radius_px: NDArray[np.int64],
    pixel_pitch_mrad: tuple[float, float],
    accuracy: FourierAccuracy,
    workers: int,
) -> list[NDArray[np.float32]]:
    """Pixel-integrated PSFs by the wave method, not yet cut to a disc or normalised.

    Parameters
    ----------
    survey : PupilSurvey
    members : (M,)
        Which PSFs of the survey.
    radius_px : (P,)
        Kernel radius of every PSF of the survey.
    pixel_pitch_mrad : (x, y)
    accuracy : FourierAccuracy
    workers : int
        Threads; the work of each holds no Python lock for most of its time.

    Returns
    -------
    kernels : M arrays (2R+1, 2R+1) float32
        Shares of the whole light, image orientation.

    Notes
    -----
    PSF(theta) = |int_pupil exp(2 pi i (W - theta.u) / lambda) du|² / (lambda² pi R²).
    """
    batches: dict[FourierPlan, list[int]] = {}
    half_extent = survey.half_extent_mrad
    for p in members.tolist():
        plan = plan_grid(
            half_extent_mrad=float(half_extent[p]),
            pupil_diameter_mm=float(survey.pupil_diameter_mm[p]),
            wavelength_nm=float(survey.wavelength_nm[p]),
            pixel_pitch_mrad=pixel_pitch_mrad,
            accuracy=accuracy,
        )
        batches.setdefault(plan, []).append(p)
    chunks = []
    for plan, indices in batches.items():
        step = max(1, _CHUNK_SAMPLES // plan.n_samples**2)
        batch = _Batch(plan, np.array(indices))
        chunks += [
            (batch, batch.members[i : i + step]) for i in range(0, len(indices), step)
        ]

    def work(chunk):
        batch, part = chunk
        return part, _compute_chunk(
            survey, batch, part, radius_px, pixel_pitch_mrad, accuracy
        )

    found: dict[int, NDArray[np.float32]] = {}
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        for part, kernels in pool.map(work, chunks):
            found.update(zip(part.tolist(), kernels, strict=True))
    return [found[p] for p in members.tolist()]
