"""The entrance pupil as the reference plane of distances, pupils and wavefronts.

Instruments and prescriptions refer to the cornea, and spectacles are in front of it.
Pupil sizes and camera distances refer to the entrance pupil: there light of any
distance d fills the same pupil and adds the vergence d to the eye's refraction.
"""

from dataclasses import dataclass
from typing import Any, overload

from numpy.typing import NDArray

from estimator.optics.prescription import Prescription, power_at_cornea_dpt
from estimator.optics.units import MM_PER_M

TYPICAL_ENTRANCE_PUPIL_MM = 3.05
"""Depth of the entrance pupil behind the corneal apex in a schematic eye, used where
only a measured wavefront is given."""


@dataclass(frozen=True)
class ObjectVergence:
    """Vergence of light from a distance minus that from infinity: s d / (1 + o d).

    Distances are from the entrance pupil, vergences are in its plane.

    Attributes
    ----------
    scale_ratio : float
        s, 1 without spectacles.
    offset_m : float
        o, 0 without spectacles.
    """

    scale_ratio: float = 1.0
    offset_m: float = 0.0

    @classmethod
    def seen_through(
        cls, correction: Prescription | None, *, entrance_pupil_mm: float
    ) -> "ObjectVergence":
        """Return the object vergence of an eye with its correction.

        A thin lens of power F, at L in front of the entrance pupil, converts the
        vergence -u of light at it to (F - u) / (1 - L (F - u)) in the pupil.  Minus
        that of u = 0 this is u / ((1 - L F) (1 - L F + L u)): with minus lenses near
        objects require less.  The power is the mean of both meridians.

        Parameters
        ----------
        entrance_pupil_mm : float
            Depth behind the corneal apex.
        """
        if correction is None:
            return cls()
        before_m = (correction.vertex_mm + entrance_pupil_mm) / MM_PER_M
        power_dpt = correction.sphere_dpt + correction.cylinder_dpt / 2.0
        part = 1.0 - before_m * power_dpt
        return cls(part**-2, before_m / part - before_m)

    @overload
    def vergence_dpt(self, object_dpt: float) -> float: ...
    @overload
    def vergence_dpt(self, object_dpt: NDArray[Any]) -> NDArray[Any]: ...
    def vergence_dpt(self, object_dpt: float | NDArray[Any]) -> float | NDArray[Any]:
        """Return the vergence of light from an object's distance."""
        return self.scale_ratio * object_dpt / (1.0 + self.offset_m * object_dpt)

    @overload
    def object_dpt(self, vergence_dpt: float) -> float: ...
    @overload
    def object_dpt(self, vergence_dpt: NDArray[Any]) -> NDArray[Any]: ...
    def object_dpt(self, vergence_dpt: float | NDArray[Any]) -> float | NDArray[Any]:
        """Return the distance whose light has the given vergence."""
        return vergence_dpt / (self.scale_ratio - self.offset_m * vergence_dpt)


def refraction_at_cornea_dpt(
    refraction_dpt: float, *, entrance_pupil_mm: float
) -> float:
    """Convert a refraction from the entrance pupil to the cornea."""
    return power_at_cornea_dpt(refraction_dpt, vertex_mm=-entrance_pupil_mm)
