"""Gradient-index media, one module each.

polynomial          index is a polynomial in the squared radius and the depth
squared_polynomial  squared index is such a polynomial
goncharov_dainty    crystalline lens of Goncharov & Dainty

A gradient is a frozen dataclass with

kind : str
    Its name in files.
index(media, start, x, y, z) -> 4 floats
    Compiled function that returns n² and n times the gradient of n at a point, in the
    axes of the surface in front of the medium.  ``media`` is the index row, in which
    the parameters of the gradient start at ``start``.
steps : int
    Number of integration steps through the medium.
vertex_index(wavelength_nm) -> float
    Index at the vertex of the surface in front.
numbers(wavelength_nm) -> tuple of float
    Parameters in the index row; their number is the same at all wavelengths.

To add a gradient, write its module, add its class to `GRADIENTS` and delete numba's
cache (see `forms`).
"""

from typing import Any, ClassVar, Protocol

from estimator.optics.gradients.goncharov_dainty import GoncharovDaintyGradient
from estimator.optics.gradients.polynomial import PolynomialGradient
from estimator.optics.gradients.squared_polynomial import SquaredPolynomialGradient


class Gradient(Protocol):
    """Interface of the classes in `GRADIENTS`."""

    index: ClassVar[Any]

    @property
    def steps(self) -> int:
        """Number of integration steps through the medium."""

    def vertex_index(self, wavelength_nm: float) -> float:
        """Return the index at r = z = 0."""

    def numbers(self, wavelength_nm: float) -> tuple[float, ...]:
        """Return the parameters for the index row."""


GRADIENTS: tuple[type[Gradient], ...] = (
    PolynomialGradient,
    SquaredPolynomialGradient,
    GoncharovDaintyGradient,
)

INDEX_FUNCTIONS: tuple[Any, ...] = tuple(dict.fromkeys(g.index for g in GRADIENTS))
"""Distinct index functions; each adds about 2 s to the compilation of all loops."""
