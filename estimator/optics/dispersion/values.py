"""Refractive index by values: constant, index and Abbe number, table."""

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.dispersion.bounds import bounded_nm
from estimator.optics.dispersion.formulas import VISIBLE_LIMITS_NM

D_LINE_NM, F_LINE_NM, C_LINE_NM = 587.5618, 486.1327, 656.2725


@dataclass(frozen=True)
class Constant:
    """The same refractive index at all wavelengths."""

    kind: ClassVar[str] = "constant"

    index: float

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        return np.full(np.shape(wavelength_nm), self.index)


@dataclass(frozen=True)
class AbbeNumber:
    """n = A + B / L², with A and B from the index at the d line and the Abbe number.

    The Abbe number is V = (n_d - 1) / (n_F - n_C), at 587.56, 486.13 and 656.27 nm.

    Raises
    ------
    ValueError
        The Abbe number is not positive.
    """

    kind: ClassVar[str] = "abbe_number"

    d_line_index: float
    abbe_number: float
    limits_nm: tuple[float, float] = VISIBLE_LIMITS_NM

    def __post_init__(self) -> None:
        if not self.abbe_number > 0.0:
            raise ValueError(f"Abbe number {self.abbe_number}: must be positive")

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        inverse = bounded_nm(wavelength_nm, self.limits_nm) ** -2.0
        share = (inverse - D_LINE_NM**-2.0) / (F_LINE_NM**-2.0 - C_LINE_NM**-2.0)
        found: NDArray[np.float64] = (
            self.d_line_index + (self.d_line_index - 1.0) / self.abbe_number * share
        )
        return found


@dataclass(frozen=True)
class IndexTable:
    """Indices at given wavelengths, with linear interpolation in 1 / L².

    Raises
    ------
    ValueError
        There are fewer than 2 entries, or wavelengths do not increase.
    """

    kind: ClassVar[str] = "table"

    wavelengths_nm: tuple[float, ...]
    indices: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.wavelengths_nm) != len(self.indices) or len(self.indices) < 2:
            raise ValueError(
                f"{len(self.wavelengths_nm)} wavelengths and {len(self.indices)} "
                "indices: must be equal numbers, at least 2"
            )
        for before, after in pairwise(self.wavelengths_nm):
            if not before < after:
                raise ValueError(
                    f"wavelengths {before:g} nm and {after:g} nm: must increase"
                )

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""
        limits_nm = (self.wavelengths_nm[0], self.wavelengths_nm[-1])
        wavelength_nm = bounded_nm(wavelength_nm, limits_nm)
        found: NDArray[np.float64] = np.interp(
            -(wavelength_nm**-2.0), -(np.array(self.wavelengths_nm) ** -2), self.indices
        )
        return found
