"""Toroid: a conic profile along y, revolved about an axis parallel to y."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from numba import njit

from estimator.optics.packed import CONIC, CURVATURE_X, CURVATURE_Y


@njit(cache=True, nogil=True, error_model="numpy")
def _sag(packed, i, x, y, out):
    cx, cy, k1 = packed[i, CURVATURE_X], packed[i, CURVATURE_Y], 1.0 + packed[i, CONIC]
    radicand = 1.0 - k1 * cy * cy * y * y
    root = math.sqrt(max(radicand, 1e-12))
    profile, slope = cy * y * y / (1.0 + root), cy * y / root
    near = 1.0 - cx * profile
    squared = near * near - cx * cx * x * x
    far = math.sqrt(max(squared, 1e-12))
    out[0] = (profile * (1.0 + near) + cx * x * x) / (1.0 + far)
    out[1] = cx * x / far
    out[2] = near * slope / far
    return radicand > 0.0 and squared > 0.0


@dataclass(frozen=True)
class Toroid:
    """z = Rx - sqrt((Rx - p(y))² - x²), p the conic of radius Ry, as in Zemax.

    The radii and the conic constant are those of the surface.
    """

    kind: ClassVar[str] = "toroid"
    sag: ClassVar[Any] = staticmethod(_sag)

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return ()

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 0.0
