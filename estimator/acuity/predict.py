"""Visual Strehl ratio and acuity of a wavefront.

Acuity is predicted with the template-matching observer of Watson & Ahumada (J. Vision
8(4):17, 2008).  The image of an optotype, filtered by the optics and by the neural
sensitivity, plus noise, is correlated with templates, the images of all optotypes in
the mean eye.  The template with the highest score is the response.  The optotypes are
the Landolt rings of ISO 8596 in eight orientations.  The noise level gives the mean eye
the acuity of young adults.

Other observers agree less with measured acuity out of focus (Smith, Optom. Vis. Sci.
68, 1991): templates with the eye's own blur read 0.3 to 0.4 logMAR better, and an
observer that requires correct phase up to the limit reads 0.3 logMAR worse.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from estimator.acuity.sensitivity import mean_eye_transfer, neural_sensitivity
from estimator.acuity.transfer import Transfer, optical_transfer
from estimator.optics.pupil_screen import PupilScreen

TILTS = slice(1, 3)

RING_GAPS = 5.0
"""Outer diameter of the ring in gaps; its stroke is one gap wide."""

DIRECTIONS = 8
MAX_CYCLES = 3.0
"""Highest frequency of the sampled spectra, cycles per gap."""

CYCLES_PER_STEP = 1.0 / 24.0
SAMPLES_PER_GAP = 16

CORRECT_RATIO = 0.5625
"""Proportion correct at threshold: halfway between chance (1/8) and 1."""

YOUNG_ADULT_LOG_MAR, YOUNG_ADULT_PUPIL_MM = -0.13, 4.0
"""Best-corrected acuity at 18 to 24 years (Elliott, Yang & Whitaker 1995)."""

LOG_MAR_LIMITS = (-0.7, 2.5)
BISECTIONS = 14
"""Halvings of this range: acuity to 0.0001 logMAR."""

TRIALS, SEED = 4000, 7
HIGHEST_CPD = 60.0
"""Nyquist frequency of the foveal cones."""


TransferFunction = Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]
"""Transfer, real or complex, at frequencies x and y in cycles per degree."""


@dataclass(frozen=True)
class Acuity:
    """Acuity as limited by the optics of an eye.

    Attributes
    ----------
    log_mar : float
        Logarithm of the smallest legible gap, minutes of arc; 0 is 20/20.
    visual_strehl_ratio : float
        Integral of the transfer function, weighted by neural sensitivity, over that of
        a pupil without aberrations (VSOTF, the same as VSX; Thibos et al., J. Vision
        4(4), 2004).
    """

    log_mar: float
    visual_strehl_ratio: float


def predict_acuity(
    zernike_um: NDArray[np.float64],
    *,
    zernike_radius_mm: float,
    wavelength_nm: float = 555.0,
    pupil_ellipse: NDArray[np.float64] | None = None,
    pupil_screen: PupilScreen | None = None,
) -> Acuity:
    """Predict the visual acuity of a wavefront.

    Parameters
    ----------
    zernike_um : (n_terms,)
        Wavefront, with the vergence of the object in C(2,0).
    zernike_radius_mm : float
        Radius of the circle of the coefficients.
    wavelength_nm : float
    pupil_ellipse : (5,), optional
    pupil_screen : PupilScreen, optional
        See `optical_transfer`.

    Raises
    ------
    ValueError
        The wavefront is too steep to be sampled.
    """
    pupil: dict[str, Any] = {
        "zernike_radius_mm": zernike_radius_mm,
        "wavelength_nm": wavelength_nm,
        "pupil_ellipse": pupil_ellipse,
    }
    # Tilt only moves the image.
    zernike_um = np.array(zernike_um, dtype=np.float64)
    zernike_um[TILTS] = 0.0
    transfer = optical_transfer(zernike_um, **pupil, pupil_screen=pupil_screen)
    perfect = optical_transfer(np.zeros_like(zernike_um), **pupil)
    return Acuity(
        log_mar=log_mar_of(transfer),
        visual_strehl_ratio=_neural_integral(transfer) / _neural_integral(perfect),
    )


def log_mar_of(transfer: Transfer, *, n_bisections: int = BISECTIONS) -> float:
    """Return the acuity, logMAR, of an optical transfer function.

    Parameters
    ----------
    transfer : Transfer
    n_bisections : int
        Halvings of the range of acuity, 3.2 logMAR.
    """

    def interpolated(
        x_cpd: NDArray[Any], y_cpd: NDArray[Any]
    ) -> NDArray[np.complex128]:
        step_cpd = transfer.frequency_cpd[1] - transfer.frequency_cpd[0]
        middle = (transfer.frequency_cpd.size - 1) / 2
        positions = middle + np.stack([y_cpd, x_cpd]) / step_cpd
        parts = (transfer.transfer_ratio.real, transfer.transfer_ratio.imag)
        real, imaginary = (map_coordinates(part, positions, order=1) for part in parts)
        values: NDArray[np.complex128] = real + 1j * imaginary
        return values

    return _threshold_log_mar(interpolated, _observer_noise(), n_bisections)


@cache
def _observer_noise() -> float:
    """Return the noise variance at which the mean eye has young adults' acuity."""

    def mean_eye(x_cpd: NDArray[Any], y_cpd: NDArray[Any]) -> NDArray[np.float64]:
        radial_cpd = np.hypot(x_cpd, y_cpd)
        return mean_eye_transfer(radial_cpd, pupil_diameter_mm=YOUNG_ADULT_PUPIL_MM)

    low, high = -8.0, 8.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        if _threshold_log_mar(mean_eye, 10.0**middle) < YOUNG_ADULT_LOG_MAR:
            low = middle
        else:
            high = middle
    noise: float = 10.0 ** (0.5 * (low + high))
    return noise


def _threshold_log_mar(
    transfer: TransferFunction, noise: float, n_bisections: int = BISECTIONS
) -> float:
    """Return the logarithm of the gap, minutes of arc, read at `CORRECT_RATIO`."""
    low, high = LOG_MAR_LIMITS
    for _ in range(n_bisections):
        middle = 0.5 * (low + high)
        if _correct_ratio(transfer, 10.0**middle, noise) > CORRECT_RATIO:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


def _correct_ratio(
    transfer: TransferFunction, gap_arcmin: float, noise: float
) -> float:
    """Return the proportion of correct responses to rings with the given gap."""
    frequencies, spectra = _seen_half(gap_arcmin)
    frequencies_cpd = frequencies * (60.0 / gap_arcmin)
    neural, mean_eye = _observer(np.hypot(*frequencies_cpd))
    # Images are seen through the transfer, templates through the mean eye.
    images = spectra * (transfer(*frequencies_cpd) * mean_eye * neural**2)
    # Per solid angle: a spectrum grows with the area, and its grid cell shrinks.
    signals = (images @ spectra.conj().T).real * gap_arcmin**2
    noises = np.sqrt(noise) * _noise_root(gap_arcmin) @ _trials().T
    correct = 0.0
    for shown in range(DIRECTIONS):
        scores = noises + signals[shown][:, None]
        correct += float(np.mean(scores[shown] == scores.max(axis=0)))
    return correct / DIRECTIONS


def _observer(
    radial_cpd: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the neural sensitivity and the transfer of the mean eye, (...)."""
    neural = np.where(radial_cpd <= HIGHEST_CPD, neural_sensitivity(radial_cpd), 0.0)
    mean_eye = mean_eye_transfer(radial_cpd, pupil_diameter_mm=YOUNG_ADULT_PUPIL_MM)
    return neural, mean_eye


def _seen_half(gap_arcmin: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the frequencies (2, n) of `_half_rings` that matter, and spectra (8, n).

    Frequencies above `HIGHEST_CPD`, for small rings nine of ten, have no weight.
    """
    frequencies, radius, spectra = _half_rings()
    count = np.searchsorted(radius, HIGHEST_CPD * gap_arcmin / 60.0, side="right")
    return frequencies[:, :count], spectra[:, :count]


@cache
def _half_rings() -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return `_rings` for half a plane: frequencies (2, n), radii (n,), spectra (8, n).

    The other half is conjugate to it; spectra are scaled by the root of 2 to represent
    both.  Radii ascend.
    """
    x, y, spectra = _rings()
    is_origin = (x == 0.0) & (y == 0.0)
    is_half = (y > 0.0) | ((y == 0.0) & (x > 0.0)) | is_origin
    spectra = spectra * np.where(is_origin, 1.0, np.sqrt(2.0))
    radius = np.hypot(x, y)[is_half]
    order = np.argsort(radius, kind="stable")
    frequencies = np.stack([x[is_half], y[is_half]])
    return frequencies[:, order], radius[order], spectra[:, is_half][:, order]


@lru_cache(maxsize=4096)
def _noise_root(gap_arcmin: float) -> NDArray[np.float64]:
    """Return a matrix A (8, 8) with A A^T equal to the covariance of the noise.

    It depends on the gap alone, and bisections share most of their gaps.
    """
    x, y, spectra = _rings()
    per_degree = 60.0 / gap_arcmin
    neural, mean_eye = _observer(np.hypot(x * per_degree, y * per_degree))
    templates = (spectra * mean_eye * neural).reshape(DIRECTIONS, -1)
    covariance = (templates @ templates.conj().T).real * gap_arcmin**2
    values, vectors = np.linalg.eigh(covariance)
    root: NDArray[np.float64] = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


@cache
def _trials() -> NDArray[np.float64]:
    return np.random.default_rng(SEED).standard_normal((TRIALS, DIRECTIONS))


@cache
def _rings() -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return frequencies x and y (n, n), cycles per gap, and spectra (8, n, n)."""
    count = int(SAMPLES_PER_GAP * (RING_GAPS + 1))
    along = (np.arange(count) + 0.5) / SAMPLES_PER_GAP - 0.5 * (RING_GAPS + 1)
    x, y = np.meshgrid(along, along)
    radius = np.hypot(x, y)
    ring = (radius <= RING_GAPS / 2) & (radius >= RING_GAPS / 2 - 1.0)
    half = int(MAX_CYCLES / CYCLES_PER_STEP)
    cycles = np.arange(-half, half + 1) * CYCLES_PER_STEP
    wave = np.exp(-2j * np.pi * np.outer(cycles, along))
    spectra = []
    for k in range(DIRECTIONS):
        angle = 2.0 * np.pi * k / DIRECTIONS
        forward = x * np.cos(angle) + y * np.sin(angle)
        across = y * np.cos(angle) - x * np.sin(angle)
        gap = (forward > 0.0) & (np.abs(across) <= 0.5)
        optotype = (ring & ~gap).astype(float) / SAMPLES_PER_GAP**2
        spectra.append(wave @ optotype @ wave.T)
    u, v = np.meshgrid(cycles, cycles)
    return u, v, np.array(spectra)


def _neural_integral(transfer: Transfer) -> float:
    """Integrate the real part of a transfer, weighted by neural sensitivity."""
    radial_cpd = transfer.radial_cpd
    step_cpd = transfer.frequency_cpd[1] - transfer.frequency_cpd[0]
    weight = np.where(radial_cpd <= HIGHEST_CPD, neural_sensitivity(radial_cpd), 0.0)
    return float((weight * transfer.transfer_ratio.real).sum() * step_cpd**2)
