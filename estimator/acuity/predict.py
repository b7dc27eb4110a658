"""Visual Strehl ratio and acuity: of a wavefront, through focus, over the field.

Acuity is predicted with the template-matching observer of Watson & Ahumada (J. Vision
8(4):17, 2008).  The image of an optotype, filtered by the optics and by the neural
sensitivity, plus noise, is correlated with templates, the images of all optotypes in
the mean eye.  The template with the highest score is the response.  The optotypes are
the Landolt rings of ISO 8596 in eight orientations.  The noise level gives the mean eye
the acuity of young adults.

Other observers agree less with measured acuity out of focus (Smith, Optom. Vis. Sci.
68, 1991): templates with the eye's own blur read 0.3 to 0.4 logMAR better, and an
observer that requires correct phase up to the limit reads 0.3 logMAR worse.

In the periphery the sampling density of the retina limits acuity: it does not resolve
detail finer than the spacing of midget ganglion cells of one type (ON or OFF).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from estimator.acuity.transfer import (
    Transfer,
    mean_eye_transfer,
    neural_sensitivity,
    optical_transfer,
)
from estimator.optics.prescription import C20
from estimator.optics.pupil_screen import PupilScreen
from estimator.optics.units import SPHERE_PER_C20

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
        Integral of the transfer function, weighted by neural sensitivity, over the
        integral for a pupil without aberrations (VSOTF, the same as VSX; Thibos et al.,
        J. Vision 4(4), 2004).
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
        return real + 1j * imaginary

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
    return 10.0 ** (0.5 * (low + high))


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
    return vectors * np.sqrt(np.maximum(values, 0.0))


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


PEAK_PER_DEG2 = 33163.2
"""Density of ganglion cell receptive fields at the fovea: two midget cells per cone."""

FOVEAL_MIDGET_RATIO = 1.0 / 1.12
MIDGET_SCALE_DEG = 41.03

MERIDIANS = {
    # Visual-field meridian: weight of the first term, and scales of both terms, deg
    "temporal": (0.9851, 1.058, 22.14),
    "superior": (0.9935, 1.035, 16.35),
    "nasal": (0.9729, 1.084, 7.633),
    "inferior": (0.9960, 0.9932, 12.13),
}

ARCMIN_PER_DEG = 60.0


def midget_density_per_deg2(
    eccentricity_deg: ArrayLike, meridian: str
) -> NDArray[np.float64]:
    """Return the density of ON and OFF midget receptive fields combined.

    Parameters
    ----------
    eccentricity_deg : (...)
    meridian : {"temporal", "superior", "nasal", "inferior"}
        Meridian of the visual field.

    Returns
    -------
    (...)
        Receptive fields per square degree.

    References
    ----------
    Watson, J. Vision 14(7):15, 2014, equations 4, 7 and 8, table 1.
    """
    weight, square_deg, exponential_deg = MERIDIANS[meridian]
    r = np.asarray(eccentricity_deg, dtype=np.float64)
    all_cells = PEAK_PER_DEG2 * (
        weight * (1.0 + r / square_deg) ** -2
        + (1.0 - weight) * np.exp(-r / exponential_deg)
    )
    return all_cells * FOVEAL_MIDGET_RATIO / (1.0 + r / MIDGET_SCALE_DEG)


def retina_nyquist_cpd(
    h_deg: ArrayLike, v_deg: ArrayLike, *, eye_side: str
) -> NDArray[np.float64]:
    """Return the Nyquist frequency of midget cells of one type.

    Parameters
    ----------
    h_deg, v_deg : (...)
        Directions in the visual field, to the person's right and up.
    eye_side : "OD" or "OS"

    Returns
    -------
    (...)
        Cycles per degree.

    Notes
    -----
    Between the meridians the spacing follows an ellipse (Watson 2014, equation 10).
    The blind spot is not modeled.
    """
    h, v = np.broadcast_arrays(
        np.asarray(h_deg, dtype=np.float64), np.asarray(v_deg, dtype=np.float64)
    )
    temporal = h if eye_side == "OD" else -h
    radius_deg = np.hypot(h, v)
    across_deg, up_deg = (
        np.where(
            positive >= 0.0,
            _spacing_deg(radius_deg, first),
            _spacing_deg(radius_deg, second),
        )
        for positive, first, second in (
            (temporal, "temporal", "nasal"),
            (v, "superior", "inferior"),
        )
    )
    between = np.hypot(h * across_deg, v * up_deg) / np.maximum(radius_deg, 1e-9)
    spacing_deg = np.where(radius_deg < 1e-9, _spacing_deg(0.0, "temporal"), between)
    return 1.0 / (np.sqrt(3.0) * spacing_deg)


def retina_log_mar(
    h_deg: ArrayLike, v_deg: ArrayLike, *, eye_side: str
) -> NDArray[np.float64]:
    """Return the acuity with perfect optics.

    The Landolt C gap (critical detail) is taken as half a cycle at the Nyquist
    frequency.  The arguments are the same as for `retina_nyquist_cpd`.

    Returns
    -------
    (...)
        logMAR.
    """
    nyquist_cpd = retina_nyquist_cpd(h_deg, v_deg, eye_side=eye_side)
    return np.log10(ARCMIN_PER_DEG / 2.0 / nyquist_cpd)


def _spacing_deg(eccentricity_deg: ArrayLike, meridian: str) -> NDArray[np.float64]:
    """Return the spacing of cells of one type in a hexagonal lattice.

    Returns
    -------
    (...)
        Distance between the centers of neighboring cells, deg.
    """
    one_type = midget_density_per_deg2(eccentricity_deg, meridian) / 2.0
    return np.sqrt(2.0 / (np.sqrt(3.0) * one_type))


@dataclass(frozen=True)
class FieldAcuity:
    """Acuity over the visual field.

    Attributes
    ----------
    optics_log_mar : (n,)
        Acuity as limited by the optics, with the neural sensitivity of the fovea.
    retina_log_mar : (n,)
        Acuity as limited by the sampling of the retina, with perfect optics.
    visual_strehl_ratio : (n,)
    """

    optics_log_mar: NDArray[np.float64]
    retina_log_mar: NDArray[np.float64]
    visual_strehl_ratio: NDArray[np.float64]

    @property
    def log_mar(self) -> NDArray[np.float64]:
        """Worse of the two limits, (n,)."""
        return np.maximum(self.optics_log_mar, self.retina_log_mar)


def acuity_through_focus(
    zernike_um: NDArray[np.float64],
    *,
    zernike_radius_mm: float,
    object_dpt: ArrayLike,
    wavelength_nm: float = 555.0,
    pupil_ellipse: NDArray[np.float64] | None = None,
    pupil_screen: PupilScreen | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return acuity and visual Strehl ratio at object distances.

    Parameters
    ----------
    zernike_um : (n_terms,)
        Wavefront of the eye in its state of accommodation, for an object at infinity.
    zernike_radius_mm : float
        Radius of the circle of the coefficients.
    object_dpt : (n,)
        Distances from the entrance pupil.  Negative values are virtual objects behind
        the eye, as seen through a plus lens.
    wavelength_nm : float
    pupil_ellipse : (5,), optional
    pupil_screen : PupilScreen, optional
        See `optical_transfer`.
    progress : callable, optional
        Callback with the completed fraction.

    Returns
    -------
    log_mar, visual_strehl_ratio : (n,)

    Raises
    ------
    ValueError
        The wavefront is too steep to be sampled.
    """
    distances_dpt = np.atleast_1d(np.asarray(object_dpt, dtype=np.float64))
    per_dpt_um = zernike_radius_mm**2 / SPHERE_PER_C20
    found = np.empty((2, distances_dpt.size))
    for k, distance_dpt in enumerate(distances_dpt):
        wavefront_um = np.array(zernike_um, dtype=np.float64)
        # M = -SPHERE_PER_C20 C(2,0) / r²: a near object requires more power.
        wavefront_um[C20] -= per_dpt_um * distance_dpt
        acuity = predict_acuity(
            wavefront_um,
            zernike_radius_mm=zernike_radius_mm,
            wavelength_nm=wavelength_nm,
            pupil_ellipse=pupil_ellipse,
            pupil_screen=pupil_screen,
        )
        found[:, k] = acuity.log_mar, acuity.visual_strehl_ratio
        if progress is not None:
            progress((k + 1) / distances_dpt.size)
    return found[0], found[1]


def acuity_over_field(
    zernike_um: NDArray[np.float64],
    *,
    zernike_radius_mm: ArrayLike,
    pupil_ellipse: NDArray[np.float64],
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    eye_side: str,
    object_dpt: float = 0.0,
    wavelength_nm: float = 555.0,
    progress: Callable[[float], None] | None = None,
) -> FieldAcuity:
    """Return the acuity in several directions, such as the nodes of a `FieldTable`.

    Parameters
    ----------
    zernike_um : (n, n_terms)
    zernike_radius_mm : scalar or (n,)
    pupil_ellipse : (n, 5)
        See `optical_transfer`.
    h_deg, v_deg : (n,)
        Directions in the visual field, to the person's right and up.
    eye_side : "OD" or "OS"
    object_dpt : float
        Object distance, the same in all directions.
    wavelength_nm : float
    progress : callable, optional
        Callback with the completed fraction.

    Raises
    ------
    ValueError
        A wavefront is too steep to be sampled.
    """
    radii_mm = np.broadcast_to(
        np.asarray(zernike_radius_mm, dtype=np.float64), (len(zernike_um),)
    )
    found = np.empty((len(zernike_um), 2))
    for k, wavefront_um in enumerate(zernike_um):
        log_mar, ratio = acuity_through_focus(
            wavefront_um,
            zernike_radius_mm=float(radii_mm[k]),
            pupil_ellipse=pupil_ellipse[k],
            object_dpt=object_dpt,
            wavelength_nm=wavelength_nm,
        )
        found[k] = log_mar[0], ratio[0]
        if progress is not None:
            progress((k + 1) / len(zernike_um))
    return FieldAcuity(
        optics_log_mar=found[:, 0],
        retina_log_mar=retina_log_mar(h_deg, v_deg, eye_side=eye_side),
        visual_strehl_ratio=found[:, 1],
    )
