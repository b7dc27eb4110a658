"""Gradient-index media, one file each.

polynomial          index: polynomial in the squared radius and the depth
squared_polynomial  squared index: the same polynomial
goncharov_dainty    the crystalline lens of Goncharov & Dainty

A gradient is a frozen dataclass with

kind : str
    Its name in files.
index(media, start, x, y, z) -> 4 floats
    Compiled; returns n² and n times the gradient of n at a point in the axes of the
    surface in front of the medium.  ``media`` is the index row, in which the numbers of
    the gradient start at ``start``.
steps : int
    Steps of the integration through the medium.
vertex_index(wavelength_nm) -> float
    Index at the vertex of the surface in front.
numbers(wavelength_nm) -> tuple of float
    Numbers of the index row, as many at every wavelength.

To add a gradient, write its file and add its class to `GRADIENTS`, and delete numba's
cache (see `forms`).
"""

from typing import Any, ClassVar, Protocol

from estimator.optics.gradients.goncharov_dainty import GoncharovDaintyGradient
from estimator.optics.gradients.polynomial import PolynomialGradient
from estimator.optics.gradients.squared_polynomial import SquaredPolynomialGradient


class Gradient(Protocol):
    """What every gradient of the table has."""

    index: ClassVar[Any]

    @property
    def steps(self) -> int:
        """Steps of the integration through the medium."""

    def vertex_index(self, wavelength_nm: float) -> float:
        """Return the index at r = z = 0."""

    def numbers(self, wavelength_nm: float) -> tuple[float, ...]:
        """Return the numbers of the index row."""


GRADIENTS: tuple[type[Gradient], ...] = (
    PolynomialGradient,
    SquaredPolynomialGradient,
    GoncharovDaintyGradient,
)

INDEX_FUNCTIONS: tuple[Any, ...] = tuple(dict.fromkeys(g.index for g in GRADIENTS))
"""Compiled indices without repetition: each adds about 2 s to compiling all loops."""
