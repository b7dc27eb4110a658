"""Conversion of spectacle prescriptions, power vectors and Zernike coefficients."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.units import ASTIGMATISM_PER_C22, MM_PER_M, SPHERE_PER_C20
from estimator.optics.zernike import N_TERMS, index_from_nm

C20 = index_from_nm(2, 0)
C22 = index_from_nm(2, 2)
C2M2 = index_from_nm(2, -2)


@dataclass(frozen=True)
class Prescription:
    """Sphere, cylinder and axis in the plane of a lens.

    Attributes
    ----------
    sphere_dpt, cylinder_dpt : float
    axis_deg : float
        Axis as the examiner writes it, facing the person.
    vertex_mm : float
        Distance from lens to cornea; 0 for powers at the cornea.
    """

    sphere_dpt: float
    cylinder_dpt: float = 0.0
    axis_deg: float = 0.0
    vertex_mm: float = 0.0


def power_at_cornea_dpt(power_dpt: float, *, vertex_mm: float) -> float:
    """Convert a power F at vertex distance d to the corneal plane: F / (1 - d F)."""
    return power_dpt / (1.0 - vertex_mm / MM_PER_M * power_dpt)


def at_cornea(lens: Prescription) -> Prescription:
    """Convert a prescription to the corneal plane."""
    other_dpt = lens.sphere_dpt + lens.cylinder_dpt
    sphere_dpt, other_dpt = (
        power_at_cornea_dpt(power_dpt, vertex_mm=lens.vertex_mm)
        for power_dpt in (lens.sphere_dpt, other_dpt)
    )
    return Prescription(sphere_dpt, other_dpt - sphere_dpt, lens.axis_deg)


def at_vertex(lens: Prescription, vertex_mm: float) -> Prescription:
    """Convert a prescription at the cornea to a lens at a distance from it."""
    moved = at_cornea(
        Prescription(lens.sphere_dpt, lens.cylinder_dpt, lens.axis_deg, -vertex_mm)
    )
    return Prescription(moved.sphere_dpt, moved.cylinder_dpt, moved.axis_deg, vertex_mm)


def format_prescription(lens: Prescription) -> str:
    """Format a prescription as "sphere cylinder x axis"."""
    text = f"{lens.sphere_dpt:+.2f}"
    if abs(lens.cylinder_dpt) >= 0.005:
        text += f" {lens.cylinder_dpt:+.2f} x {lens.axis_deg:.0f}"
    return text


def power_vector(
    prescription: Prescription, *, depth_mm: float = 0.0
) -> tuple[float, float, float]:
    """Convert a prescription to a power vector (M, J0, J45) in the eye's frame.

    The examiner faces the person, so the axis A becomes 180 - A, which changes the sign
    of J45.

    Parameters
    ----------
    prescription : Prescription
    depth_mm : float
        Distance behind the cornea, mm, of the plane to which the powers are converted.

    Returns
    -------
    m_dpt, j0_dpt, j45_dpt : float

    References
    ----------
    Thibos, Wheeler & Horner, Optom. Vis. Sci. 74, 1997.
    """
    vertex_mm = prescription.vertex_mm + depth_mm
    sphere = power_at_cornea_dpt(prescription.sphere_dpt, vertex_mm=vertex_mm)
    other = prescription.sphere_dpt + prescription.cylinder_dpt
    cylinder = power_at_cornea_dpt(other, vertex_mm=vertex_mm) - sphere
    axis_rad = math.radians(180.0 - prescription.axis_deg)
    j0 = -0.5 * cylinder * math.cos(2.0 * axis_rad)
    j45 = -0.5 * cylinder * math.sin(2.0 * axis_rad)
    return sphere + 0.5 * cylinder, j0, j45


def zernike_from_power_vector(
    m_dpt: float, j0_dpt: float, j45_dpt: float, *, zernike_radius_mm: float
) -> NDArray[np.float64]:
    """Convert a power vector to Zernike coefficients.

    Parameters
    ----------
    m_dpt, j0_dpt, j45_dpt : float
    zernike_radius_mm : float
        Normalization radius of the coefficients.

    Returns
    -------
    (28,)
        Coefficients, um.
    """
    zernike_um = np.zeros(N_TERMS)
    radius_squared_mm2 = zernike_radius_mm**2
    zernike_um[C20] = -m_dpt * radius_squared_mm2 / SPHERE_PER_C20
    zernike_um[C22] = -j0_dpt * radius_squared_mm2 / ASTIGMATISM_PER_C22
    zernike_um[C2M2] = -j45_dpt * radius_squared_mm2 / ASTIGMATISM_PER_C22
    return zernike_um


def power_vector_from_zernike(
    zernike_um: NDArray[np.float64], *, zernike_radius_mm: float
) -> tuple[float, float, float]:
    """Convert Zernike coefficients to a least-squares power vector (M, J0, J45).

    It depends on the second-order coefficients alone (Thibos, Wheeler & Horner 1997).

    Parameters
    ----------
    zernike_um : (28,)
    zernike_radius_mm : float
        Normalization radius of the coefficients.

    Returns
    -------
    m_dpt, j0_dpt, j45_dpt : float
    """
    m, j0, j45 = power_vectors_dpt(np.asarray(zernike_um), zernike_radius_mm).tolist()
    return m, j0, j45


def power_vectors_dpt(
    zernike_um: NDArray[np.float64], zernike_radius_mm: ArrayLike
) -> NDArray[np.float64]:
    """Convert Zernike coefficients to least-squares power vectors (M, J0, J45).

    Parameters
    ----------
    zernike_um : (..., 28)
    zernike_radius_mm : (...)
        Normalization radius of the coefficients.

    Returns
    -------
    (..., 3)
        Power vectors, dpt.
    """
    second = zernike_um[..., [C20, C22, C2M2]]
    per_um = -np.array([SPHERE_PER_C20, ASTIGMATISM_PER_C22, ASTIGMATISM_PER_C22])
    return per_um * second / np.square(zernike_radius_mm)[..., None]


def prescription_from_power_vector(
    m_dpt: float, j0_dpt: float, j45_dpt: float
) -> Prescription:
    """Convert a power vector to a minus-cylinder prescription at the corneal plane."""
    cylinder_dpt = -2.0 * math.hypot(j0_dpt, j45_dpt)
    axis_deg = 180.0 - math.degrees(math.atan2(j45_dpt, j0_dpt)) / 2.0
    axis_deg = axis_deg % 180.0
    return Prescription(
        sphere_dpt=m_dpt - cylinder_dpt / 2.0,
        cylinder_dpt=cylinder_dpt,
        axis_deg=axis_deg if axis_deg > 0.0 else 180.0,
    )
