"""Sum of two conic profiles, along x and along y: the biconic of optiland."""

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class SeparateProfiles:
    """z = p(x; Rx, kx) + p(y; Ry, ky) with conic profiles p.

    Attributes
    ----------
    conic_constants : (kx, ky)
        They replace the conic constant of the surface.
    """

    kind: ClassVar[str] = "separate_profiles"

    conic_constants: tuple[float, float]

    def numbers(self) -> tuple[float, ...]:
        """Return the parameters for the packed row."""
        return self.conic_constants

    def added_curvature(self, curvatures: tuple[float, float]) -> float:
        """Return the mean curvature, 1/mm, that the form adds at the vertex."""
        del curvatures
        return 0.0
