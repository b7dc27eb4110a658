"""Stiles-Crawford effect: cones are less sensitive to light from the edge of the pupil.

It is an apodization of the pupil, off by default: it matters for pupils above 4 mm, and
for perceived images but not for images on the retina.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

WAVELENGTHS_NM = (460.0, 500.0, 560.0, 610.0, 670.0)
SLOPES_PER_MM2 = (0.0565, 0.049, 0.041, 0.045, 0.050)
"""rho of eta = 10^(-rho r²): Berendschot (2001), as adjusted in ISETBio."""

NASAL_MM = 0.51
SUPERIOR_MM = 0.20
"""Mean center of the apodization: Applegate & Lakshminarayanan (1993)."""

EYE_SIDES = ("OD", "OS")


@dataclass(frozen=True)
class StilesCrawford:
    """Relative sensitivity eta = 10^(-rho |u - u0|²) to light from pupil point u.

    Attributes
    ----------
    centre_mm : (x, y)
        u0, x to the person's right, y up.
    slope_ratio : float
        Factor on the tabulated rho.
    """

    centre_mm: tuple[float, float] = (0.0, 0.0)
    slope_ratio: float = 1.0

    @classmethod
    def of_eye(cls, eye_side: str) -> "StilesCrawford":
        """Return the effect in the average right ("OD") or left ("OS") eye.

        The nasal side is to the left in a right eye.

        Raises
        ------
        ValueError
            The side is unknown.
        """
        if eye_side not in EYE_SIDES:
            raise ValueError(f"eye_side {eye_side!r}: must be one of OD, OS")
        nasal_x = -NASAL_MM if eye_side == "OD" else NASAL_MM
        return cls(centre_mm=(nasal_x, SUPERIOR_MM))

    def slope_per_mm2(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return rho (...) at wavelengths (...), constant beyond the table's ends."""
        at_nm = cast("NDArray[np.float64]", wavelength_nm)  # `interp` converts it
        rho = np.interp(at_nm, WAVELENGTHS_NM, SLOPES_PER_MM2)
        return self.slope_ratio * rho

    def amplitude(self, wavelength_nm: ArrayLike) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return k (P,) per mm² and u0 (P, 2) mm of the factor exp(-k |u - u0|²).

        The amplitude is the root of the sensitivity: k = rho ln(10) / 2.
        """
        k = self.slope_per_mm2(wavelength_nm) * np.log(10.0) / 2.0
        return k, np.broadcast_to(self.centre_mm, (k.size, 2))
