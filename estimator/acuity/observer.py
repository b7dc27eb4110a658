"""An observer who reads a chart of letters through an optical transfer function.

The observer matches templates, as that of Watson & Ahumada (J. Vision 8(4):17, 2008)
does.  The image of a Sloan letter, filtered by the optics and by the neural
sensitivity, plus noise, is correlated with templates: the images of all ten letters in
the mean eye.  The most probable letter is the response.

- **Blur that reverses contrast.**  Beyond the first zero of its transfer function, a
  defocused eye shows detail with reversed contrast.  Templates leave such frequencies
  out: to remove them from blurred letters changes the smallest legible size neither way
  (Akutsu, Bedell & Patel, Optom. Vis. Sci. 77:524, 2000).
- **Noise.**  Its spectral density is the sum of photon noise, which falls with the
  light that enters the pupil, and of neural noise (Barten, "Contrast sensitivity of the
  human eye", SPIE, 1999).
- **Scoring.**  Lines of five letters are read from the largest to the first line
  without a correct letter, and every correct letter counts 0.02 logMAR (Bailey & Lovie,
  Am. J. Optom. Physiol. Opt. 53:740, 1976; Ferris et al., Am. J. Ophthalmol. 94:91,
  1982).

The only fitted value is `OBSERVER_NOISE`.
"""

import warnings
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from estimator.acuity.letters import SLOAN_LETTERS, UNITS
from estimator.acuity.transfer import (
    HIGHEST_CPD,
    OBSERVER_PUPIL_MM,
    Transfer,
    mean_eye_transfer,
    neural_sensitivity,
)

ARCMIN_PER_DEG = 60.0

LINES_LOG_MAR = 0.1 * np.arange(-7, 25)
"""Lines of the chart, the smallest first."""

LINE_STEP_LOG_MAR = 0.1
LETTERS_PER_LINE = 5
PERFECT_LINES = 3
"""Once as many consecutive lines are read without an error, larger ones are, too."""

MAX_CYCLES = 1.0
"""Highest frequency of the sampled spectra, cycles per stroke: five cycles per letter.

Acuity is within 0.003 logMAR of three cycles per stroke."""

CYCLES_PER_STEP = 1.0 / 24.0
SAMPLES_PER_STROKE = 16

TRIALS, SEED = 2000, 7

CHART_CD_M2 = 160.0
"""Luminance of the chart: the middle, as a ratio, of 80 to 320 cd/m² (ISO 8596)."""

PHOTONS_PER_TD = 1.24e6
"""Photons per second, deg² and troland; this and the next two by Barten 1999."""

QUANTUM_EFFICIENCY = 0.03
NEURAL_NOISE = 3e-8
"""Spectral density of neural noise above 7 cycles per degree, s deg²."""

OBSERVER_NOISE = 4.92e5
"""Variance of the noise of templates per `NEURAL_NOISE`.

With it, the typical young eye, best corrected for 4 mm, reads -0.13 logMAR, as people
of 18 to 24 years do (Elliott, Yang & Whitaker, Optom. Vis. Sci. 72:186, 1995).
"""


def log_mar_of(transfer: Transfer, *, n_bisections: int | None = None) -> float:
    """Return the acuity, logMAR, of an optical transfer function.

    Parameters
    ----------
    transfer : Transfer
        From `white_light_transfer` for people who read a chart.  One without a pupil
        area gets the light of a 4 mm pupil.
    n_bisections : int, optional
        Deprecated, without effect.

    Returns
    -------
    float
        From -0.7 to 2.5.
    """
    if n_bisections is not None:
        warnings.warn(
            "n_bisections has no effect and will be removed in version 0.4",
            DeprecationWarning,
            stacklevel=2,
        )
    noise = OBSERVER_NOISE * _noise_ratio(transfer.pupil_mm2)
    ratios: list[float] = []
    for log_mar in LINES_LOG_MAR.tolist():
        ratios.append(_correct_ratio(transfer, 10.0**log_mar, noise))
        if ratios[-PERFECT_LINES:] == [1.0] * PERFECT_LINES:
            break
    lines_read, reached = 0.0, 1.0
    for ratio in reversed(ratios):
        lines_read += reached * ratio
        reached *= 1.0 - (1.0 - ratio) ** LETTERS_PER_LINE
    largest_log_mar = float(LINES_LOG_MAR[len(ratios) - 1])
    return largest_log_mar + LINE_STEP_LOG_MAR * (1.0 - lines_read)


def _noise_ratio(pupil_mm2: float | None) -> float:
    """Return the density of photon and neural noise per that of neural noise."""
    if pupil_mm2 is None:
        pupil_mm2 = np.pi / 4.0 * OBSERVER_PUPIL_MM**2
    photons_per_deg2 = PHOTONS_PER_TD * CHART_CD_M2 * pupil_mm2
    return 1.0 + 1.0 / (QUANTUM_EFFICIENCY * photons_per_deg2 * NEURAL_NOISE)


def _correct_ratio(transfer: Transfer, stroke_arcmin: float, noise: float) -> float:
    """Return the proportion of correct responses to letters with the given stroke."""
    frequencies, spectra = _seen_half(stroke_arcmin)
    x_cpd, y_cpd = frequencies * (ARCMIN_PER_DEG / stroke_arcmin)
    radial_cpd = np.hypot(x_cpd, y_cpd)
    neural = np.where(radial_cpd <= HIGHEST_CPD, neural_sensitivity(radial_cpd), 0.0)
    seen = _at(transfer, x_cpd, y_cpd)
    mean_eye = mean_eye_transfer(radial_cpd, pupil_diameter_mm=OBSERVER_PUPIL_MM)
    # Per solid angle: a spectrum grows with the area, and its grid cell shrinks.
    template = stroke_arcmin * mean_eye * neural * (seen.real > 0.0)
    templates = _real(spectra * template)
    images = _real(spectra * (stroke_arcmin * neural * seen))
    overlaps, signals = templates @ templates.T, images @ templates.T
    # Of letters that are as probable, the likelihood is the correlation less half the
    # energy, at the contrast of the image.
    contrast = np.trace(signals) / np.trace(overlaps)
    means = signals - 0.5 * contrast * np.diag(overlaps)
    values, vectors = np.linalg.eigh(overlaps)
    root = vectors * np.sqrt(noise * np.maximum(values, 0.0))
    noises = root @ _trials().T
    correct = 0.0
    for shown, mean in enumerate(means):
        scores = noises + mean[:, None]
        correct += float(np.mean(scores[shown] == scores.max(axis=0)))
    return correct / len(means)


def _real(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the real and imaginary parts (m, 2 n) of values (m, n), interleaved."""
    return values.view(np.float64)


def _at(
    transfer: Transfer, x_cpd: NDArray[np.float64], y_cpd: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the transform of the PSF (n,) at frequencies (n,), exp(-2 pi i f . angle).

    Spectra of letters have this kernel; a `Transfer` has the conjugate one.
    """
    step_cpd = transfer.frequency_cpd[1] - transfer.frequency_cpd[0]
    middle = (transfer.frequency_cpd.size - 1) / 2
    positions = middle + np.stack([y_cpd, x_cpd]) / step_cpd
    parts = (transfer.transfer_ratio.real, transfer.transfer_ratio.imag)
    real, imaginary = (map_coordinates(part, positions, order=1) for part in parts)
    found: NDArray[np.complex128] = real - 1j * imaginary
    return found


def _seen_half(
    stroke_arcmin: float,
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Return the frequencies (2, n) of `_half_letters` that matter, and spectra.

    Frequencies above `HIGHEST_CPD`, for small letters nine of ten, have no weight.
    """
    frequencies, radius, spectra = _half_letters()
    highest_cycles = HIGHEST_CPD * stroke_arcmin / ARCMIN_PER_DEG
    count = np.searchsorted(radius, highest_cycles, side="right")
    return frequencies[:, :count], spectra[:, :count]


@cache
def _half_letters() -> tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.complex128]
]:
    """Return the spectra of letters for half a plane of frequencies.

    The other half is conjugate to it; spectra are scaled by the root of 2 to represent
    both.

    Returns
    -------
    frequencies : (2, n)
        Cycles per stroke.
    radius : (n,)
        Their radii, ascending.
    spectra : (10, n)
    """
    count = int(SAMPLES_PER_STROKE * (UNITS + 1))
    along = (np.arange(count) + 0.5) / SAMPLES_PER_STROKE - 0.5
    x, y = np.meshgrid(along, along)
    is_inside = (np.abs(x - UNITS / 2) <= UNITS / 2) & (
        np.abs(y - UNITS / 2) <= UNITS / 2
    )
    half = int(MAX_CYCLES / CYCLES_PER_STEP)
    cycles = np.arange(-half, half + 1) * CYCLES_PER_STEP
    wave = np.exp(-2j * np.pi * np.outer(cycles, along - UNITS / 2))
    spectra = np.array(
        [
            wave @ ((ink(x, y) & is_inside) / SAMPLES_PER_STROKE**2) @ wave.T
            for ink in SLOAN_LETTERS.values()
        ]
    )
    u, v = np.meshgrid(cycles, cycles)
    is_origin = (u == 0.0) & (v == 0.0)
    is_half = (v > 0.0) | ((v == 0.0) & (u > 0.0)) | is_origin
    spectra *= np.where(is_origin, 1.0, np.sqrt(2.0))
    radius = np.hypot(u, v)[is_half]
    order = np.argsort(radius, kind="stable")
    frequencies = np.stack([u[is_half], v[is_half]])
    half_spectra = np.ascontiguousarray(spectra[:, is_half][:, order])
    return frequencies[:, order], radius[order], half_spectra


@cache
def _trials() -> NDArray[np.float64]:
    return np.random.default_rng(SEED).standard_normal((TRIALS, len(SLOAN_LETTERS)))
