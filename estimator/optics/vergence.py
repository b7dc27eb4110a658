"""The plane of the entrance pupil: where distances, pupils and wavefronts are counted.

Instruments and prescriptions speak of the cornea, spectacles stand before it, but a
person's pupil and a camera's distances are those of the entrance pupil: there light of
any distance d fills the same pupil, and adds the vergence d to the eye's refraction.
"""

from dataclasses import dataclass
from typing import overload

from numpy.typing import NDArray

from estimator.optics.prescription import Prescription, power_at_cornea_dpt
from estimator.optics.units import MM_PER_M

TYPICAL_ENTRANCE_PUPIL_MM = 3.05
"""Entrance pupil behind the corneal apex, of a schematic eye: what a measured wavefront
alone does not tell."""


@dataclass(frozen=True)
class ObjectVergence:
    """Vergence of light from a distance less that from infinity: s d / (1 + o d).

    Distances count from the entrance pupil, vergences are those in its plane.

    Attributes
    ----------
    scale_ratio : float
        s, 1 without spectacles.
    offset_m : float
        o, 0 without.
    """

    scale_ratio: float = 1.0
    offset_m: float = 0.0

    @classmethod
    def seen_through(
        cls, correction: Prescription | None, *, entrance_pupil_mm: float
    ) -> "ObjectVergence":
        """Return that of an eye with its correction.

        A thin lens of power F, L before the entrance pupil, turns the vergence -u of
        light at it into (F - u) / (1 - L (F - u)) in the pupil.  Less that of u = 0
        this is u / ((1 - L F) (1 - L F + L u)): with minus lenses near objects ask for
        less.  The power is the mean of both meridians.

        Parameters
        ----------
        entrance_pupil_mm : float
            Behind the corneal apex.
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
    def vergence_dpt(self, object_dpt: NDArray) -> NDArray: ...
    def vergence_dpt(self, object_dpt):
        """Vergence of light from an object's distance."""
        return self.scale_ratio * object_dpt / (1.0 + self.offset_m * object_dpt)

    @overload
    def object_dpt(self, vergence_dpt: float) -> float: ...
    @overload
    def object_dpt(self, vergence_dpt: NDArray) -> NDArray: ...
    def object_dpt(self, vergence_dpt):
        """Distance whose light has a vergence."""
        return vergence_dpt / (self.scale_ratio - self.offset_m * vergence_dpt)


def refraction_at_cornea_dpt(
    refraction_dpt: float, *, entrance_pupil_mm: float
) -> float:
    """Move a refraction from the entrance pupil out to the cornea."""
    return power_at_cornea_dpt(refraction_dpt, vertex_mm=-entrance_pupil_mm)
