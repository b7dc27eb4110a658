"""Gradient-index media, one module each.

polynomial          index is a polynomial in the squared radius and the depth
squared_polynomial  squared index is such a polynomial
goncharov_dainty    crystalline lens of Goncharov & Dainty

A gradient is a frozen dataclass with

kind : str
    Its name in files.
index : str
    The compiled function, of `INDEX_FUNCTIONS`, that returns n² and n times the
    gradient of n at a point, in the axes of the surface in front of the medium.
steps : int
    Number of integration steps through the medium.
vertex_index(wavelength_nm) -> float
    Index at the vertex of the surface in front.
numbers(wavelength_nm) -> tuple of float
    Parameters in the index row; their number is the same at all wavelengths.

To add a gradient, write its module and add its class to `GRADIENTS`.  If no function
computes its index, write one in `estimator/native/source`, and add it to
`INDEX_FUNCTIONS` and to the table of `gradients.h`, in the same order.
"""

from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from estimator.native import core
from estimator.optics.gradients.goncharov_dainty import GoncharovDaintyGradient
from estimator.optics.gradients.polynomial import PolynomialGradient
from estimator.optics.gradients.squared_polynomial import SquaredPolynomialGradient


class Gradient(Protocol):
    """Interface of the classes in `GRADIENTS`."""

    index: ClassVar[str]

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

INDEX_FUNCTIONS = ("polynomial", "squared_polynomial")
"""Index functions of `native/source/gradients.h`, in its order."""


def index_values(
    index_row: NDArray[np.float64], first: int, points_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return n² and n times the gradient of n (n_points, 4) of a medium.

    Parameters
    ----------
    index_row : (n,)
        See `surfaces.media_indices`.
    first : int
        Column at which the parameters of the medium start.
    points_mm : (n_points, 3)
        Points in the axes of the surface in front of the medium.
    """
    found = np.empty((len(points_mm), 4))
    core().call("gradient_indices", index_row, first, points_mm, len(points_mm), found)
    return found
