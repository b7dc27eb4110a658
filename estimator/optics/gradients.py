"""Gradient-index media.

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

To add a gradient, write its class and add its class to `GRADIENTS`.  If no function
computes its index, write one in `estimator/native/source`, and add it to
`INDEX_FUNCTIONS` and to the table of `gradients.h`, in the same order.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from estimator.native import core
from estimator.optics.media import Dispersion

DEFAULT_STEPS = 4
"""Integration steps: 4 have a path error of 2e-10 mm in the lens of Liou & Brennan."""


def polynomial_numbers(
    coefficients: tuple[tuple[float, ...], ...], *, first: float
) -> tuple[float, ...]:
    """Return the parameters of a polynomial, with ``first`` as its constant term.

    They are the number of powers of r², the number of powers of z, and the
    coefficients, where the power of z changes fastest.  Rows may have different
    lengths; missing coefficients are zero.
    """
    table = np.zeros((len(coefficients), max(len(row) for row in coefficients)))
    for i, row in enumerate(coefficients):
        table[i, : len(row)] = row
    table[0, 0] = first
    return (*table.shape, *table.ravel())


@dataclass(frozen=True)
class PolynomialGradient:
    """n(r, z) = sum over i, j of n_ij r^(2i) z^j, plus a shift with wavelength.

    r and z are in the axes of the surface in front of the medium, with their origin at
    its vertex.

    Attributes
    ----------
    coefficients : tuple of tuples, mm^-(2i+j)
        Row i holds n_i0, n_i1, ...
    reference_wavelength_nm : float
        Wavelength of the coefficients.
    dispersion : Dispersion or None
        Medium whose index shifts with wavelength by the same amount; no shift if None.
    steps : int
        Number of integration steps; see `native/source/gradients.h`.
    """

    kind: ClassVar[str] = "polynomial_gradient"
    index: ClassVar[str] = "polynomial"

    coefficients: tuple[tuple[float, ...], ...]
    reference_wavelength_nm: float = 555.0
    dispersion: Dispersion | None = None
    steps: int = DEFAULT_STEPS

    def vertex_index(self, wavelength_nm: float) -> float:
        """Return the index at r = z = 0."""
        if self.dispersion is None:
            return self.coefficients[0][0]
        shift = self.dispersion.refractive_index(
            wavelength_nm
        ) - self.dispersion.refractive_index(self.reference_wavelength_nm)
        return self.coefficients[0][0] + float(shift)

    def numbers(self, wavelength_nm: float) -> tuple[float, ...]:
        """Return the parameters for the index row."""
        first = self.vertex_index(wavelength_nm)
        return polynomial_numbers(self.coefficients, first=first)


@dataclass(frozen=True)
class SquaredPolynomialGradient:
    """n²(r, z) = sum over i, j of m_ij r^(2i) z^j, at every wavelength.

    r and z are the same as in `PolynomialGradient`.

    Attributes
    ----------
    coefficients : tuple of tuples, mm^-(2i+j)
        Row i holds m_i0, m_i1, ...
    steps : int
        Number of integration steps; see `native/source/gradients.h`.
    """

    kind: ClassVar[str] = "squared_polynomial_gradient"
    index: ClassVar[str] = "squared_polynomial"

    coefficients: tuple[tuple[float, ...], ...]
    steps: int = DEFAULT_STEPS

    def vertex_index(self, wavelength_nm: float) -> float:
        """Return the index at r = z = 0."""
        del wavelength_nm
        return math.sqrt(self.coefficients[0][0])

    def numbers(self, wavelength_nm: float) -> tuple[float, ...]:
        """Return the parameters for the index row."""
        del wavelength_nm
        return polynomial_numbers(self.coefficients, first=self.coefficients[0][0])


@dataclass(frozen=True)
class GoncharovDaintyGradient:
    """n(r, z) = n0 + n1 r² + n2 r⁴ + n3 z + n4 z² + n5 z³ + n6 z⁴.

    One half of a crystalline lens (Goncharov & Dainty 2007): n0 is the index at the
    lens surface for the anterior half, and the largest index, at the plane between the
    halves, for the posterior half.

    Attributes
    ----------
    coefficients : (n0, ..., n6)
    reference_wavelength_nm, dispersion, steps
        As for `PolynomialGradient`.
    """

    kind: ClassVar[str] = "goncharov_dainty"
    index: ClassVar[str] = PolynomialGradient.index

    coefficients: tuple[float, float, float, float, float, float, float]
    reference_wavelength_nm: float = 555.0
    dispersion: Dispersion | None = None
    steps: int = DEFAULT_STEPS

    def _polynomial(self) -> PolynomialGradient:
        n0, n1, n2, n3, n4, n5, n6 = self.coefficients
        return PolynomialGradient(
            ((n0, n3, n4, n5, n6), (n1,), (n2,)),
            reference_wavelength_nm=self.reference_wavelength_nm,
            dispersion=self.dispersion,
        )

    def vertex_index(self, wavelength_nm: float) -> float:
        """Return the index at r = z = 0."""
        return self._polynomial().vertex_index(wavelength_nm)

    def numbers(self, wavelength_nm: float) -> tuple[float, ...]:
        """Return the parameters for the index row."""
        return self._polynomial().numbers(wavelength_nm)


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
