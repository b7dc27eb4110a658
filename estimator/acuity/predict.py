"""Visual Strehl ratio and acuity: of a wavefront, through focus, over the field.

Acuity is that of the observer of `estimator.acuity.observer` in white light.

In the periphery the sampling density of the retina limits acuity: it does not resolve
detail finer than the spacing of midget ganglion cells of one type (ON or OFF).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.acuity.observer import ARCMIN_PER_DEG, log_mar_of
from estimator.acuity.transfer import (
    HIGHEST_CPD,
    Transfer,
    neural_sensitivity,
    optical_transfer,
    white_light_transfer,
)
from estimator.optics.prescription import C20
from estimator.optics.pupil_screen import PupilScreen
from estimator.optics.units import SPHERE_PER_C20

TILTS = slice(1, 3)

STREHL_STEP_CPD = 0.5
"""Largest frequency step of the visual Strehl ratio, which is within 0.0001 of 0.3."""


@dataclass(frozen=True)
class Acuity:
    """Acuity as limited by the optics of an eye.

    Attributes
    ----------
    log_mar : float
        Logarithm of the smallest legible gap, minutes of arc; 0 is 20/20.
    visual_strehl_ratio : float
        Integral of the real part of the transfer function, weighted by neural
        sensitivity, over the integral for a pupil without aberrations (VSOTF, the same
        as VSX; Thibos et al., J. Vision 4(4), 2004), at one wavelength.  Under strong
        blur, it is near 0 and may be negative, where most of the visible detail has
        reversed contrast (Iskander, Optom. Vis. Sci. 83:57, 2006).
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
    """Predict the visual acuity of a wavefront in white light.

    Parameters
    ----------
    zernike_um : (n_terms,)
        Wavefront, with the vergence of the object in C(2,0).
    zernike_radius_mm : float
        Radius of the circle of the coefficients.
    wavelength_nm : float
        Of the coefficients, and of the visual Strehl ratio.
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
    white = white_light_transfer(zernike_um, **pupil, pupil_screen=pupil_screen)
    pupil["frequency_step_cpd"] = STREHL_STEP_CPD
    transfer = optical_transfer(zernike_um, **pupil, pupil_screen=pupil_screen)
    perfect = optical_transfer(np.zeros_like(zernike_um), **pupil)
    return Acuity(
        log_mar=log_mar_of(white),
        visual_strehl_ratio=_neural_integral(transfer) / _neural_integral(perfect),
    )


def _neural_integral(transfer: Transfer) -> float:
    """Integrate the real part of a transfer, weighted by neural sensitivity."""
    step_cpd = transfer.frequency_cpd[1] - transfer.frequency_cpd[0]
    first, last = np.searchsorted(transfer.frequency_cpd, (-HIGHEST_CPD, HIGHEST_CPD))
    visible_cpd = transfer.frequency_cpd[first:last]
    radial_cpd = np.hypot(visible_cpd[:, None], visible_cpd)
    weight = np.where(radial_cpd <= HIGHEST_CPD, neural_sensitivity(radial_cpd), 0.0)
    real = transfer.transfer_ratio[first:last, first:last].real
    return float((weight * real).sum() * step_cpd**2)


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
