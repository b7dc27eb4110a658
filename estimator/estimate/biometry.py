"""Lengths and powers of an eye, as an optometrist measures them."""

from dataclasses import dataclass

from estimator.optics.paraxial import cardinal_points, system_matrix
from estimator.optics.surfaces import EyeSurfaces, media_indices, pack_eye
from estimator.optics.units import MM_PER_M, REFERENCE_WAVELENGTH_NM

KERATOMETRIC_INDEX = 1.3375


@dataclass(frozen=True)
class EyeBiometry:
    """Lengths and powers of an eye.

    Attributes
    ----------
    axial_length_mm : float
        From the corneal apex to the retina.
    keratometry_dpt : float
        K of the mean anterior curvature at the apex, with an index of 1.3375.
    chamber_depth_mm : float
        From the corneal apex to the lens or implant.
    lens_thickness_mm, lens_power_dpt : float
        Of the natural lens or implant.
    """

    axial_length_mm: float
    keratometry_dpt: float
    chamber_depth_mm: float
    lens_thickness_mm: float
    lens_power_dpt: float


def eye_biometry(eye: EyeSurfaces) -> EyeBiometry:
    """Return the biometry of an eye with two surfaces each of cornea and lens.

    Raises
    ------
    ValueError
        The eye has other surfaces.
    """
    if len(eye.surfaces) != 4:
        raise ValueError(
            f"eye has {len(eye.surfaces)} surfaces; expected 4: cornea and lens"
        )
    indices = media_indices(eye, REFERENCE_WAVELENGTH_NM)
    matrix = system_matrix(pack_eye(eye), indices, first=0, last=1)
    curvature_per_mm = -float(matrix[1, 0]) / float(indices[1] - indices[0])
    points = cardinal_points(eye, wavelength_nm=REFERENCE_WAVELENGTH_NM)
    apex_mm, _, front_mm, back_mm = (surface.z_mm for surface in eye.surfaces)
    return EyeBiometry(
        axial_length_mm=float(eye.retina.z_mm - apex_mm),
        keratometry_dpt=MM_PER_M * (KERATOMETRIC_INDEX - 1.0) * curvature_per_mm,
        chamber_depth_mm=float(front_mm - apex_mm),
        lens_thickness_mm=float(back_mm - front_mm),
        lens_power_dpt=points.lens_power_dpt,
    )
