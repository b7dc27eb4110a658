"""Gradient-index media whose index is a polynomial in squared radius and depth."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from estimator.optics.dispersion import Dispersion

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
