"""Biconic with a conic constant in each meridian; ellipsoids are a special case.

An ellipsoid with the semi-axes ax, ay and az has the radii ax² / az and ay² / az and
the conic constants ax² / az² - 1 and ay² / az² - 1.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from numba import njit

from estimator.optics.packed import CURVATURE_X, CURVATURE_Y, FORM_NUMBERS


@njit(cache=True, nogil=True, error_model="numpy")
def _sag(packed, i, x, y, out):
    cx, cy = packed[i, CURVATURE_X], packed[i, CURVATURE_Y]
    kx, ky = 1.0 + packed[i, FORM_NUMBERS], 1.0 + packed[i, FORM_NUMBERS + 1]
    radicand = 1.0 - kx * cx * cx * x * x - ky * cy * cy * y * y
    root = math.sqrt(max(radicand, 1e-12))
    numerator, inverse = cx * x * x + cy * y * y, 1.0 / (1.0 + root)
    common = numerator * inverse * inverse / root
    out[0] = numerator * inverse
    out[1] = x * cx * (2.0 * inverse + common * kx * cx)
    out[2] = y * cy * (2.0 * inverse + common * ky * cy)
    return radicand > 0.0


@dataclass(frozen=True)
class TwoConics:
    """z = (cx x² + cy y²) / (1 + sqrt(1 - (1+kx) cx² x² - (1+ky) cy² y²)), c = 1 / R.

    Attributes
    ----------
    conic_constants : (kx, ky)
        They replace the conic constant of the surface.
    """

    kind: ClassVar[str] = "two_conics"
    sag: ClassVar[Any] = staticmethod(_sag)

    conic_constants: tuple[float, float]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.conic_constants

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 0.0
