"""Zernike coefficients in words: powers, and where light goes.

Directions are those of the image of a point as the person sees it; on the retina they
are inverted.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from estimator.optics import prescription as rx
from estimator.optics.zernike import index_from_nm, nm_from_index

SHOWN_UM = 0.0005
"""Smallest coefficient that is not printed as 0."""

FIRST_HIGHER = 6
N_LARGEST = 3

DIRECTIONS = (
    "to the person's right",
    "up and to the person's right",
    "up",
    "up and to the person's left",
    "to the person's left",
    "down and to the person's left",
    "down",
    "down and to the person's right",
)
"""Every 45 deg from the person's right, counterclockwise as the person sees it."""

COMA_X, COMA_Y = index_from_nm(3, 1), index_from_nm(3, -1)
SPHERICAL = index_from_nm(4, 0)


def describe_zernike(
    zernike_um: ArrayLike, *, pupil_diameter_mm: float
) -> tuple[str, ...]:
    """Describe coefficients in words: refraction, coma, spherical aberration.

    Parameters
    ----------
    zernike_um : (n_terms,), um
        OSA/ANSI coefficients in the eye frame, index = j.
    pupil_diameter_mm : float
        Diameter of their circle.

    Returns
    -------
    tuple of str
        Terms below 0.0005 um are left out.
    """
    zernike_um = np.asarray(zernike_um, dtype=np.float64)
    found = [*_second_order(zernike_um, pupil_diameter_mm)]
    if zernike_um.size > COMA_X and _are_shown(zernike_um, COMA_Y, COMA_X):
        turns = math.atan2(zernike_um[COMA_Y], zernike_um[COMA_X]) / math.radians(45.0)
        direction = DIRECTIONS[round(turns) % len(DIRECTIONS)]
        terms = _terms(zernike_um, COMA_Y, COMA_X)
        found.append(f"{terms}: the tail of the image of a point points {direction}")
    if zernike_um.size > SPHERICAL and _are_shown(zernike_um, SPHERICAL):
        power = "more" if zernike_um[SPHERICAL] > 0.0 else "less"
        terms = _terms(zernike_um, SPHERICAL)
        found.append(
            f"{terms}: the edge of the pupil has {power} power than its center"
        )
    rest_um = np.where(
        np.isin(np.arange(zernike_um.size), [COMA_Y, COMA_X, SPHERICAL]),
        0.0,
        zernike_um,
    )
    rest_um[:FIRST_HIGHER] = 0.0
    largest = np.argsort(-np.abs(rest_um), kind="stable")[:N_LARGEST].tolist()
    if _are_shown(rest_um, *largest):
        higher_um = np.linalg.norm(zernike_um[FIRST_HIGHER:])
        terms = _terms(rest_um, *largest)
        found.append(f"{terms}; orders from 3 on: {higher_um:.3f} um RMS")
    return tuple(found)


def _second_order(zernike_um: np.ndarray, pupil_diameter_mm: float) -> list[str]:
    if zernike_um.size <= rx.C22:
        return []
    m_dpt, j0_dpt, j45_dpt = rx.power_vector_from_zernike(
        zernike_um, zernike_radius_mm=pupil_diameter_mm / 2.0
    )
    found = []
    if _are_shown(zernike_um, rx.C20):
        name = "myopia" if m_dpt < 0.0 else "hyperopia"
        found.append(f"{_terms(zernike_um, rx.C20)}: {name}, M {m_dpt:+.2f} dpt")
    if _are_shown(zernike_um, rx.C2M2, rx.C22):
        lens = rx.prescription_from_power_vector(m_dpt, j0_dpt, j45_dpt)
        found.append(
            f"{_terms(zernike_um, rx.C2M2, rx.C22)}: astigmatism, cylinder "
            f"{lens.cylinder_dpt:+.2f} dpt, axis {lens.axis_deg:.0f} deg"
        )
    return found


def _are_shown(zernike_um: np.ndarray, *indices: int) -> bool:
    return bool(np.abs(zernike_um[list(indices)]).max() >= SHOWN_UM)


def _terms(zernike_um: np.ndarray, *indices: int) -> str:
    """Return terms that are not 0 with their names, as "+0.250 um Z(3,-1)"."""
    shown = [
        "{:+.3f} um Z({},{})".format(zernike_um[j], *nm_from_index(j))
        for j in indices
        if _are_shown(zernike_um, j)
    ]
    return ", ".join(shown)
