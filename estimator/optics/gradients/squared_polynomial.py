"""Gradient-index media whose squared index is a polynomial, such as GRIN rods."""

import math
from dataclasses import dataclass
from typing import ClassVar

from estimator.optics.gradients.polynomial import DEFAULT_STEPS, polynomial_numbers


@dataclass(frozen=True)
class SquaredPolynomialGradient:
    """n²(r, z) = sum over i, j of m_ij r^(2i) z^j, at every wavelength.

    r and z are those of `PolynomialGradient`.

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
