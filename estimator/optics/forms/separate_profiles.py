"""Sum of two conic profiles, along x and along y: the biconic of optiland."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from numba import njit

from estimator.optics.packed import CURVATURE_X, CURVATURE_Y, FORM_NUMBERS


@njit(cache=True, nogil=True, error_model="numpy")
def _sag(packed, i, x, y, out):
    cx, cy = packed[i, CURVATURE_X], packed[i, CURVATURE_Y]
    along_x = 1.0 - (1.0 + packed[i, FORM_NUMBERS]) * cx * cx * x * x
    along_y = 1.0 - (1.0 + packed[i, FORM_NUMBERS + 1]) * cy * cy * y * y
    root_x, root_y = math.sqrt(max(along_x, 1e-12)), math.sqrt(max(along_y, 1e-12))
    out[0] = cx * x * x / (1.0 + root_x) + cy * y * y / (1.0 + root_y)
    out[1], out[2] = cx * x / root_x, cy * y / root_y
    return along_x > 0.0 and along_y > 0.0


@dataclass(frozen=True)
class SeparateProfiles:
    """z = p(x; Rx, kx) + p(y; Ry, ky) with conic profiles p.

    Attributes
    ----------
    conic_constants : (kx, ky)
        They replace the conic constant of the surface.
    """

    kind: ClassVar[str] = "separate_profiles"
    sag: ClassVar[Any] = staticmethod(_sag)

    conic_constants: tuple[float, float]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.conic_constants

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 0.0
