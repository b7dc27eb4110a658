"""Conversion from the plane of an intraocular lens to that of the entrance pupil.

Because the cornea refracts, rays of a distant object cross the lens closer to the axis
than the entrance pupil.  A phase in the lens is therefore stretched by that ratio in
the pupil, and its power is weakened by the square of it: 3 dpt at a depth of 4.6 mm act
as 2.2 dpt.
"""

from estimator.optics.units import MM_PER_M

CORNEA_DPT = 43.04
AQUEOUS_INDEX = 1.3386
"""Values of the schematic eye of Escudero-Sanz and Navarro (1999) at 555 nm."""

TYPICAL_DEPTH_MM = 4.6
"""Depth of an implanted lens behind the cornea; 4 to 5 mm are usual."""


def height_ratio(depth_mm: float) -> float:
    """Return the height of a ray in the lens over that in the entrance pupil."""
    return 1.0 - depth_mm / MM_PER_M / AQUEOUS_INDEX * CORNEA_DPT


def power_at_pupil_dpt(power_dpt: float, *, depth_mm: float) -> float:
    """Return the effective power of the lens in the plane of the entrance pupil."""
    return power_dpt * height_ratio(depth_mm) ** 2


def diameter_at_pupil_mm(diameter_mm: float, *, depth_mm: float) -> float:
    """Return the diameter of a zone of the lens as seen in the entrance pupil."""
    return diameter_mm / height_ratio(depth_mm)
