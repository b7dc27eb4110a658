"""Toroid: a conic profile along y, revolved about an axis parallel to y."""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Toroid:
    """z = Rx - sqrt((Rx - p(y))² - x²), p the conic of radius Ry, as in Zemax.

    The radii and the conic constant are those of the surface.
    """

    kind: ClassVar[str] = "toroid"

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return ()

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 0.0
