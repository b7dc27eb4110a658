"""Refractive index of homogeneous media by wavelength.

bounds    check of wavelengths against the range of a medium
formulas  dispersion formulas
values    constant index, index and Abbe number, table

A dispersion is a frozen dataclass with ``kind``, its name in files, and
``refractive_index(wavelength_nm)``, which raises ValueError outside its range.  To add
a dispersion, write its class and add it to `DISPERSIONS`.
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
    """Interface of the classes in `DISPERSIONS`."""

    def refractive_index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the refractive index (...) at wavelengths (...)."""


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
