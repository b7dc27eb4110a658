"""Even asphere: a conic or biconic plus even powers of the distance from its axis."""

from dataclasses import dataclass
from typing import Any, ClassVar

from numba import njit

from estimator.optics.forms.base import biconic_sag
from estimator.optics.packed import FORM_NUMBERS, N_FORM_NUMBERS


@njit(cache=True, nogil=True, error_model="numpy")
def _sag(packed, i, x, y, out):
    inside = biconic_sag(packed, i, x, y, out)
    squared = x * x + y * y
    value, slope = 0.0, 0.0  # of the sum over powers of r², by Horner's rule
    for t in range(FORM_NUMBERS + N_FORM_NUMBERS - 1, FORM_NUMBERS - 1, -1):
        slope = slope * squared + value
        value = value * squared + packed[i, t]
    slope = slope * squared + value
    out[0] += value * squared
    out[1] += 2.0 * x * slope
    out[2] += 2.0 * y * slope
    return inside


@dataclass(frozen=True)
class EvenAsphere:
    """z = biconic + a2 r² + a4 r⁴ + a6 r⁶ + ...

    Attributes
    ----------
    coefficients : tuple of at most 12 floats
        (a2, a4, ...), in mm^(1-n) for r^n, as for the Even Asphere of Zemax.
    """

    kind: ClassVar[str] = "even_asphere"
    sag: ClassVar[Any] = staticmethod(_sag)

    coefficients: tuple[float, ...]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.coefficients

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 2.0 * self.coefficients[0] if self.coefficients else 0.0
