"""Gradient of one half of the crystalline lens of Goncharov & Dainty (2007).

n0 is the index at the lens surface for the anterior half, and the largest index, at the
plane between the halves, for the posterior half.
"""

from dataclasses import dataclass
from typing import ClassVar

from estimator.optics.dispersion import Dispersion
from estimator.optics.gradients.polynomial import DEFAULT_STEPS, PolynomialGradient


@dataclass(frozen=True)
class GoncharovDaintyGradient:
    """n(r, z) = n0 + n1 r² + n2 r⁴ + n3 z + n4 z² + n5 z³ + n6 z⁴.

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
