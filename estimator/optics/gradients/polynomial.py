"""Gradient-index media whose index is a polynomial in squared radius and depth."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numba import njit

from estimator.optics.dispersion import Dispersion

DEFAULT_STEPS = 4
"""Integration steps: 4 have a path error of 2e-10 mm in the lens of Liou & Brennan."""


@njit(cache=True, nogil=True, error_model="numpy")
def polynomial(media, start, x, y, z):
    """Return a polynomial in r² and z and its derivatives by x, y and z.

    The parameters are the number of powers of r², the number of powers of z, and the
    coefficients, where the power of z changes fastest.
    """
    n_radial, n_depth = int(media[start]), int(media[start + 1])
    squared = x * x + y * y
    value, by_square, by_z = 0.0, 0.0, 0.0
    for i in range(n_radial - 1, -1, -1):
        at = start + 2 + i * n_depth
        q, dq = 0.0, 0.0
        for j in range(n_depth - 1, -1, -1):
            dq = dq * z + q
            q = q * z + media[at + j]
        by_square = by_square * squared + value
        value = value * squared + q
        by_z = by_z * squared + dq
    return value, 2.0 * x * by_square, 2.0 * y * by_square, by_z


@njit(cache=True, nogil=True, error_model="numpy")
def _index(media, start, x, y, z):
    n, nx, ny, nz = polynomial(media, start, x, y, z)
    return n * n, n * nx, n * ny, n * nz


def polynomial_numbers(
    coefficients: tuple[tuple[float, ...], ...], *, first: float
) -> tuple[float, ...]:
    """Return the parameters of `polynomial`, with ``first`` as the constant term.

    Rows may have different lengths; missing coefficients are zero.
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
        Number of integration steps; see `gradient_kernels`.
    """

    kind: ClassVar[str] = "polynomial_gradient"
    index: ClassVar[Any] = staticmethod(_index)

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
