"""Conversion from the plane of an intraocular lens to that of the entrance pupil.

The cornea converges light, so a ray from a distant object crosses the lens closer to
the axis than it crosses the entrance pupil.  Diameters in the pupil are larger than in
the lens by the ratio of the ray heights, and powers are smaller by its square: 3 dpt at
a depth of 4.6 mm act as 2.2 dpt.
"""

from estimator.optics.units import MM_PER_M

CORNEA_DPT = 43.04
AQUEOUS_INDEX = 1.3386
"""Values of the schematic eye of Escudero-Sanz and Navarro (1999) at 555 nm."""

TYPICAL_DEPTH_MM = 4.6
"""Depth of an implanted lens behind the cornea; 4 to 5 mm are usual."""


def height_ratio(depth_mm: float) -> float:
    """Return the ray height in the lens over that in the entrance pupil: 1 - d K / n.

    Parameters
    ----------
    depth_mm : float
        Depth d of the lens behind the cornea.
    """
    return 1.0 - depth_mm / MM_PER_M / AQUEOUS_INDEX * CORNEA_DPT


def power_at_pupil_dpt(power_dpt: float, *, depth_mm: float) -> float:
    """Return the power, dpt, of a lens in the plane of the entrance pupil."""
    return power_dpt * height_ratio(depth_mm) ** 2


def diameter_at_pupil_mm(diameter_mm: float, *, depth_mm: float) -> float:
    """Return the diameter, mm, of a zone of the lens in the entrance pupil."""
    return diameter_mm / height_ratio(depth_mm)
