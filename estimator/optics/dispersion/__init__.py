"""Refractive index of homogeneous media by wavelength.

bounds    check of wavelengths against the range of a medium
formulas  dispersion formulas
values    constant index, index with Abbe number, table

A dispersion is a frozen dataclass with ``kind``, its name in files, and
``refractive_index(wavelength_nm)``, which raises ValueError outside its range.  To add
one, write its class and add it to `DISPERSIONS`.
"""

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.dispersion.formulas import (
    Cauchy,
    Conrady,
    OcularHerzberger,
    Schott,
    Sellmeier,
    WavelengthPolynomial,
)
from estimator.optics.dispersion.values import AbbeNumber, Constant, IndexTable


class Dispersion(Protocol):
    """What every dispersion of the table has."""

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index (...) at wavelengths (...)."""


DISPERSIONS = (
    OcularHerzberger,
    Cauchy,
    WavelengthPolynomial,
    Conrady,
    Schott,
    Sellmeier,
    AbbeNumber,
    Constant,
    IndexTable,
)
