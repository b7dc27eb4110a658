"""Object distances and vergences in the plane of the entrance pupil.

Instruments and prescriptions refer to the cornea.  Pupil diameters and object distances
refer to the entrance pupil: light from d dpt fills the same pupil for every d and adds
the vergence d to the refraction.
"""

from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from estimator.optics.prescription import Prescription, power_at_cornea_dpt
from estimator.optics.units import MM_PER_M

INDIANA_OFFSET_DPT = 1.68524
INDIANA_SLOPE_DPT_NM = 633.46
INDIANA_POLE_NM = 214.102


@overload
def chromatic_refraction_dpt(wavelength_nm: float) -> float: ...
@overload
def chromatic_refraction_dpt(
    wavelength_nm: NDArray[np.float64],
) -> NDArray[np.float64]: ...
def chromatic_refraction_dpt(
    wavelength_nm: float | NDArray[np.float64],
) -> float | NDArray[np.float64]:
    """Return the refraction (...), dpt, of the Indiana chromatic eye.

    It is zero at 589.98 nm and negative (myopic) at shorter wavelengths.  Only
    differences between wavelengths have a meaning.

    References
    ----------
    Thibos, Ye, Zhang & Bradley, Appl. Opt. 31, 1992: a fit to measured eyes.
    """
    return INDIANA_OFFSET_DPT - INDIANA_SLOPE_DPT_NM / (wavelength_nm - INDIANA_POLE_NM)


TYPICAL_ENTRANCE_PUPIL_MM = 3.05
"""Depth of the entrance pupil behind the corneal apex in a schematic eye, for profiles
that consist of a measured wavefront only."""


@dataclass(frozen=True)
class ObjectVergence:
    """Vergence of light from d dpt minus that from infinity: s d / (1 + o d).

    Distances are from the entrance pupil; vergences are in its plane.

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
        """Return the object vergence through a correction.

        Parameters
        ----------
        correction : Prescription or None
        entrance_pupil_mm : float
            Depth of the entrance pupil behind the corneal apex.

        Notes
        -----
        A thin lens of power F at a distance L in front of the entrance pupil converts
        the vergence -u at the lens to (F - u) / (1 - L (F - u)) in the pupil.  The
        difference from u = 0 is u / ((1 - L F) (1 - L F + L u)).  F is the spherical
        equivalent.
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
        """Return the vergence (...) of light from object distances (...), dpt."""
        return self.scale_ratio * object_dpt / (1.0 + self.offset_m * object_dpt)

    @overload
    def object_dpt(self, vergence_dpt: float) -> float: ...
    @overload
    def object_dpt(self, vergence_dpt: NDArray[Any]) -> NDArray[Any]: ...
    def object_dpt(self, vergence_dpt: float | NDArray[Any]) -> float | NDArray[Any]:
        """Return the object distances (...), dpt, of light with vergences (...)."""
        return vergence_dpt / (self.scale_ratio - self.offset_m * vergence_dpt)


def refraction_at_cornea_dpt(
    refraction_dpt: float, *, entrance_pupil_mm: float
) -> float:
    """Convert a refraction from the entrance pupil to the cornea."""
    return power_at_cornea_dpt(refraction_dpt, vertex_mm=-entrance_pupil_mm)
