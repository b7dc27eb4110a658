"""Acuity through focus and over the visual field."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.acuity.predict import predict_acuity
from estimator.acuity.retina import retina_log_mar
from estimator.optics.prescription import C20
from estimator.optics.pupil_screen import PupilScreen
from estimator.optics.units import SPHERE_PER_C20


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
    """Return the acuity in several directions, for example those of a `FieldTable`.

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
