"""Dispersion formulas.  L is the wavelength in micrometers."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.dispersion.bounds import bounded_nm
from estimator.optics.units import NM_PER_UM

VISIBLE_LIMITS_NM = (365.0, 1100.0)
"""Default range of the formulas."""

_POLE_UM2 = 0.028

_KNOT_WEIGHTS = np.array(
    # rows: a1 to a4; columns: 1, L², 1/(L² - 0.028), 1/(L² - 0.028)²
    [
        [0.66147196, -0.40352796, -0.28046790, 0.03385979],
        [-4.20146383, 2.73508956, 1.50543784, -0.11593235],
        [6.29834237, -4.69409935, -1.57508650, 0.10293038],
        [-1.75835059, 2.36253794, 0.35011657, -0.02085782],
    ]
)


def _polynomial(
    values: NDArray[np.float64], coefficients: tuple[float, ...]
) -> NDArray[np.float64]:
    return np.asarray(np.polynomial.polynomial.polyval(values, coefficients))


def _evaluated(squared_index: NDArray[np.float64]) -> NDArray[np.float64]:
    if not np.all(squared_index > 0.0):
        raise ValueError(f"squared refractive index {squared_index}: must be positive")
    return np.sqrt(squared_index)


@dataclass(frozen=True)
class OcularHerzberger:
    """Index of an ocular medium, interpolated between four measured indices.

    n = a1 n1 + a2 n2 + a3 n3 + a4 n4, where each a is a linear combination of 1, L²,
    1/(L² - 0.028) and 1/(L² - 0.028)² (Navarro, Santamaria & Bescos 1985, after
    Herzberger).

    Attributes
    ----------
    indices : (n1, n2, n3, n4)
        At 365.0, 486.1, 656.3 and 1014.0 nm.
    """

    kind: ClassVar[str] = "ocular_herzberger"

    indices: tuple[float, float, float, float]
    limits_nm: tuple[float, float] = (365.0, 1014.0)

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        squared = (bounded_nm(wavelength_nm, self.limits_nm) / NM_PER_UM) ** 2
        inverse = 1.0 / (squared - _POLE_UM2)
        terms = np.stack([np.ones_like(squared), squared, inverse, inverse**2], axis=-1)
        found: NDArray[np.float64] = terms @ (_KNOT_WEIGHTS.T @ np.array(self.indices))
        return found


@dataclass(frozen=True)
class Cauchy:
    """n = c0 + c1 / L² + c2 / L⁴ + c3 / L⁶ + ..."""

    kind: ClassVar[str] = "cauchy"

    coefficients: tuple[float, ...]
    limits_nm: tuple[float, float] = VISIBLE_LIMITS_NM

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        inverse = (bounded_nm(wavelength_nm, self.limits_nm) / NM_PER_UM) ** -2.0
        return _polynomial(inverse, self.coefficients)


@dataclass(frozen=True)
class WavelengthPolynomial:
    """n = a0 + a1 L + a2 L² + ..., as in Liou & Brennan (1997)."""

    kind: ClassVar[str] = "wavelength_polynomial"

    coefficients: tuple[float, ...]
    limits_nm: tuple[float, float] = VISIBLE_LIMITS_NM

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        length_um = bounded_nm(wavelength_nm, self.limits_nm) / NM_PER_UM
        return _polynomial(length_um, self.coefficients)


@dataclass(frozen=True)
class Conrady:
    """n = n0 + a / L + b / L^3.5; the coefficients are (n0, a, b)."""

    kind: ClassVar[str] = "conrady"

    coefficients: tuple[float, float, float]
    limits_nm: tuple[float, float] = VISIBLE_LIMITS_NM

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        length_um = bounded_nm(wavelength_nm, self.limits_nm) / NM_PER_UM
        n0, a, b = self.coefficients
        return n0 + a / length_um + b / length_um**3.5


@dataclass(frozen=True)
class Schott:
    """n² = a0 + a1 L² + a2 / L² + a3 / L⁴ + a4 / L⁶ + a5 / L⁸."""

    kind: ClassVar[str] = "schott"

    coefficients: tuple[float, float, float, float, float, float]
    limits_nm: tuple[float, float] = VISIBLE_LIMITS_NM

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        squared = (bounded_nm(wavelength_nm, self.limits_nm) / NM_PER_UM) ** 2
        a0, a1, *rest = self.coefficients
        return _evaluated(_polynomial(1.0 / squared, (a0, *rest)) + a1 * squared)


@dataclass(frozen=True)
class Sellmeier:
    """n² = 1 + sum of k L² / (L² - l), the Sellmeier 1 formula of Zemax.

    Attributes
    ----------
    coefficients : tuple of (k, l)
        l in um².
    """

    kind: ClassVar[str] = "sellmeier"

    coefficients: tuple[tuple[float, float], ...]
    limits_nm: tuple[float, float] = VISIBLE_LIMITS_NM

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        squared = (bounded_nm(wavelength_nm, self.limits_nm) / NM_PER_UM) ** 2
        total = np.ones_like(squared)
        for k, pole_um2 in self.coefficients:
            total = total + k * squared / (squared - pole_um2)
        return _evaluated(total)
