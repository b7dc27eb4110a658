"""Biconic with a conic constant in each meridian; ellipsoids are a special case.

An ellipsoid with the semi-axes ax, ay and az has the radii ax² / az and ay² / az and
the conic constants ax² / az² - 1 and ay² / az² - 1.
"""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class TwoConics:
    """z = (cx x² + cy y²) / (1 + sqrt(1 - (1+kx) cx² x² - (1+ky) cy² y²)), c = 1 / R.

    Attributes
    ----------
    conic_constants : (kx, ky)
        They replace the conic constant of the surface.
    """

    kind: ClassVar[str] = "two_conics"

    conic_constants: tuple[float, float]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.conic_constants

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 0.0
