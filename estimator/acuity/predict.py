"""Visual Strehl ratio and acuity of a wavefront.

Acuity is predicted by the method of Watson & Ahumada (J. Vision 8(4):17, 2008): the
optotype, filtered by the optics and then by the nerves, is compared under noise with
each optotype as the mean eye sees it, and the most similar one is the answer.  The
optotype is the Landolt ring of ISO 8596 in its eight directions; the noise is chosen so
that the mean eye has the acuity of young adults.  An observer who knew their own blur
would read 0.3 to 0.4 logMAR better out of focus than people do (Smith, Optom. Vis. Sci.
68, 1991), one who needs detail in phase up to the limit 0.3 worse.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from estimator.acuity.sensitivity import mean_eye_transfer, neural_sensitivity
from estimator.acuity.transfer import Transfer, optical_transfer
from estimator.optics.pupil_screen import PupilScreen

TILTS = slice(1, 3)

RING_GAPS = 5.0
"""Diameter of the ring in gaps; its stroke is one gap."""

DIRECTIONS = 8
MOST_CYCLES = 3.0
"""Highest frequency of the ring's spectrum, cycles per gap."""

CYCLES_PER_STEP = 1.0 / 24.0
RASTER_PER_GAP = 16

CORRECT_RATIO = 0.5625
"""Share of correct answers at the limit: halfway from chance to certainty."""

YOUNG_LOG_MAR, YOUNG_PUPIL_MM = -0.13, 4.0
"""Best corrected acuity at 18 to 24 years (Elliott, Yang & Whitaker 1995)."""

LOG_MAR_LIMITS = (-0.7, 2.5)
TRIALS, SEED = 4000, 7
HIGHEST_CPD = 60.0
"""Highest frequency that receptors of the fovea sample."""


Modulation = Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]
"""Transfer, real or complex, at frequencies x and y in cycles per degree."""


@dataclass(frozen=True)
class Acuity:
    """Acuity as limited by an eye's optics.

    Attributes
    ----------
    log_mar : float
        Logarithm of the smallest legible gap, minutes of arc; 0 is 20/20.
    visual_strehl_ratio : float
        Transfer weighted by neural sensitivity over that of a perfect pupil
        (VSOTF, the same as VSX; Thibos et al., J. Vision 4(4), 2004).
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
    """Return the acuity of a wavefront, as far as the optics determine it.

    Parameters
    ----------
    zernike_um : (28,)
        Wavefront with the object distance included: the C(2,0) of an eye out of focus.
    pupil_ellipse : (5,), optional
    pupil_screen : PupilScreen, optional
        See `optical_transfer`.

    Raises
    ------
    ValueError
        A wavefront too steep to be resolved.
    """
    pupil: dict[str, Any] = {
        "zernike_radius_mm": zernike_radius_mm,
        "wavelength_nm": wavelength_nm,
        "pupil_ellipse": pupil_ellipse,
    }
    # The position of the image on the retina does not matter.
    zernike_um = np.array(zernike_um, dtype=np.float64)
    zernike_um[TILTS] = 0.0
    seen = optical_transfer(zernike_um, **pupil, pupil_screen=pupil_screen)
    perfect = optical_transfer(np.zeros_like(zernike_um), **pupil)
    return Acuity(
        log_mar=log_mar_of(seen),
        visual_strehl_ratio=_weighted(seen) / _weighted(perfect),
    )


def log_mar_of(transfer: Transfer) -> float:
    """Return the acuity of a transfer function."""

    def modulation(x_cpd: NDArray[Any], y_cpd: NDArray[Any]) -> NDArray[np.complex128]:
        step_cpd = transfer.frequency_cpd[1] - transfer.frequency_cpd[0]
        middle = (transfer.frequency_cpd.size - 1) / 2
        places = middle + np.stack([y_cpd, x_cpd]) / step_cpd
        parts = (transfer.transfer_ratio.real, transfer.transfer_ratio.imag)
        real, imaginary = (map_coordinates(part, places, order=1) for part in parts)
        found: NDArray[np.complex128] = real + 1j * imaginary
        return found

    return _limit(modulation, _noise())


@cache
def _noise() -> float:
    """Return the noise at which the mean eye has the acuity of young adults."""

    def modulation(x_cpd: NDArray[Any], y_cpd: NDArray[Any]) -> NDArray[np.float64]:
        radial_cpd = np.hypot(x_cpd, y_cpd)
        return mean_eye_transfer(radial_cpd, pupil_diameter_mm=YOUNG_PUPIL_MM)

    low, high = -8.0, 8.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        if _limit(modulation, 10.0**middle) < YOUNG_LOG_MAR:
            low = middle
        else:
            high = middle
    noise: float = 10.0 ** (0.5 * (low + high))
    return noise


def _limit(modulation: Modulation, noise: float) -> float:
    """Return the logarithm of the smallest gap, minutes of arc, read often enough."""
    low, high = LOG_MAR_LIMITS
    for _ in range(14):
        middle = 0.5 * (low + high)
        if _correct_ratio(modulation, 10.0**middle, noise) > CORRECT_RATIO:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


def _correct_ratio(modulation: Modulation, gap_arcmin: float, noise: float) -> float:
    """Return the share of correct answers for rings with the given gap."""
    x, y, spectra = _rings()
    per_degree = 60.0 / gap_arcmin
    x_cpd, y_cpd = x * per_degree, y * per_degree
    radial_cpd = np.hypot(x_cpd, y_cpd)
    nerves = np.where(radial_cpd <= HIGHEST_CPD, neural_sensitivity(radial_cpd), 0.0)
    usual = mean_eye_transfer(radial_cpd, pupil_diameter_mm=YOUNG_PUPIL_MM)
    known = (spectra * usual * nerves).reshape(DIRECTIONS, -1)
    seen = (spectra * modulation(x_cpd, y_cpd) * nerves).reshape(DIRECTIONS, -1)
    # Per solid angle: a spectrum grows with the area, and its grid cell shrinks.
    answers_of = (seen @ known.conj().T).real * gap_arcmin**2
    products = (known @ known.conj().T).real * gap_arcmin**2
    scores = np.sqrt(noise) * _trials() @ _root(products).T
    right = 0.0
    for shown in range(DIRECTIONS):
        answers = scores + answers_of[shown]
        right += float(np.mean(np.argmax(answers, axis=1) == shown))
    return right / DIRECTIONS


def _root(products: NDArray[Any]) -> NDArray[np.float64]:
    """Return a matrix whose square is the products of the rings."""
    values, vectors = np.linalg.eigh(products)
    root: NDArray[np.float64] = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


@cache
def _trials() -> NDArray[np.float64]:
    return np.random.default_rng(SEED).standard_normal((TRIALS, DIRECTIONS))


@cache
def _rings() -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return frequencies in cycles per gap, and spectra (8, n, n) of the rings."""
    count = int(RASTER_PER_GAP * (RING_GAPS + 1))
    along = (np.arange(count) + 0.5) / RASTER_PER_GAP - 0.5 * (RING_GAPS + 1)
    x, y = np.meshgrid(along, along)
    radius = np.hypot(x, y)
    ring = (radius <= RING_GAPS / 2) & (radius >= RING_GAPS / 2 - 1.0)
    half = int(MOST_CYCLES / CYCLES_PER_STEP)
    cycles = np.arange(-half, half + 1) * CYCLES_PER_STEP
    wave = np.exp(-2j * np.pi * np.outer(cycles, along))
    spectra = []
    for k in range(DIRECTIONS):
        angle = 2.0 * np.pi * k / DIRECTIONS
        forward = x * np.cos(angle) + y * np.sin(angle)
        aside = y * np.cos(angle) - x * np.sin(angle)
        open_gap = (forward > 0.0) & (np.abs(aside) <= 0.5)
        picture = (ring & ~open_gap).astype(float) / RASTER_PER_GAP**2
        spectra.append(wave @ picture @ wave.T)
    u, v = np.meshgrid(cycles, cycles)
    return u, v, np.array(spectra)


def _weighted(transfer: Transfer) -> float:
    """Return the integral of the real transfer, weighted by neural sensitivity."""
    radial_cpd = transfer.radial_cpd
    step_cpd = transfer.frequency_cpd[1] - transfer.frequency_cpd[0]
    weight = np.where(radial_cpd <= HIGHEST_CPD, neural_sensitivity(radial_cpd), 0.0)
    return float((weight * transfer.transfer_ratio.real).sum() * step_cpd**2)
