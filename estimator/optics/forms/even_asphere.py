"""Even asphere: a conic or biconic plus even powers of the distance from its axis."""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class EvenAsphere:
    """z = biconic + a2 r² + a4 r⁴ + a6 r⁶ + ...

    Attributes
    ----------
    coefficients : tuple of at most 12 floats
        (a2, a4, ...), in mm^(1-n) for r^n, as for the Even Asphere of Zemax.
    """

    kind: ClassVar[str] = "even_asphere"

    coefficients: tuple[float, ...]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.coefficients

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 2.0 * self.coefficients[0] if self.coefficients else 0.0
