"""Refractive indices of homogeneous media by wavelength.

A dispersion is a frozen dataclass with ``kind``, its name in files, and
``refractive_index(wavelength_nm)``, which raises ValueError outside its range.  To add
a dispersion, write its class and add it to `DISPERSIONS`.  In formulas, L is the
wavelength in micrometers.  `refractive_index` has the ocular media by Herzberger's
formula, from 365 to 1014 nm.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.units import NM_PER_UM


def bounded_nm(
    wavelength_nm: ArrayLike, limits_nm: tuple[float, float]
) -> NDArray[np.float64]:
    """Return wavelengths as an array (...).

    Raises
    ------
    ValueError
        A wavelength is outside the limits or nan.
    """
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    low, high = limits_nm
    if not np.all((wavelength_nm >= low) & (wavelength_nm <= high)):
        raise ValueError(
            f"wavelength {wavelength_nm} nm: allowed is {low:g} to {high:g} nm"
        )
    return wavelength_nm


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
        return terms @ (_KNOT_WEIGHTS.T @ np.array(self.indices))


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
        return self.d_line_index + (self.d_line_index - 1.0) / self.abbe_number * share


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
        return np.interp(
            -(wavelength_nm**-2.0), -(np.array(self.wavelengths_nm) ** -2), self.indices
        )


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


WAVELENGTH_LIMITS_NM = (365.0, 1014.0)

AIR = "air"

OCULAR_MEDIA = {
    # n at 365.0, 486.1, 656.3 and 1014.0 nm (Navarro, Santamaria & Bescos 1985)
    "cornea": OcularHerzberger((1.3975, 1.3807, 1.37405, 1.3668)),
    "aqueous": OcularHerzberger((1.3593, 1.3422, 1.3354, 1.3278)),
    "lens": OcularHerzberger((1.4492, 1.42625, 1.4175, 1.4097)),
    "vitreous": OcularHerzberger((1.3565, 1.3407, 1.3341, 1.3273)),
}

MEDIA = (AIR, *OCULAR_MEDIA)

N_CACHED = 256
"""Number of pairs of medium and wavelengths whose indices are kept: preparing an eye
asks for the same ones hundreds of times."""


@lru_cache(N_CACHED)
def _ocular_index(
    medium: str, wavelengths_nm: bytes, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    known_nm = np.frombuffer(wavelengths_nm).reshape(shape)
    return OCULAR_MEDIA[medium].refractive_index(known_nm)


def refractive_index(
    medium: str,
    wavelength_nm: ArrayLike,
    *,
    indices: Mapping[str, float] | None = None,
    media: Mapping[str, Any] | None = None,
) -> NDArray[np.float64]:
    """Return the refractive index of a homogeneous medium.

    Parameters
    ----------
    medium : str
        ``cornea``, ``aqueous``, ``lens``, ``vitreous``, ``air``, or a key of
        ``indices`` or ``media``.
    wavelength_nm : (...)
    indices : mapping, optional
        Constant indices by medium, which take precedence over dispersions.
    media : mapping, optional
        Dispersions by medium, which take precedence over the formula below.

    Returns
    -------
    index : (...)

    Raises
    ------
    ValueError
        The medium is unknown, or a wavelength is outside its range: 365 to 1014 nm for
        the formula below.

    Notes
    -----
    n(L) = a1 n(365.0) + a2 n(486.1) + a3 n(656.3) + a4 n(1014.0).  Each a is a linear
    combination of 1, L², 1/(L² - 0.028) and 1/(L² - 0.028)², with L in micrometers
    (Navarro et al. 1985, after Herzberger).  The index of air is 1.
    """
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    if indices is not None and medium in indices:
        return np.full(wavelength_nm.shape, float(indices[medium]))
    if medium == AIR:
        return np.ones(wavelength_nm.shape)
    dispersion: Dispersion | None = media.get(medium) if media else None
    if dispersion is not None or medium in OCULAR_MEDIA:
        try:
            if dispersion is not None:
                return dispersion.refractive_index(wavelength_nm)
            key = medium, wavelength_nm.tobytes(), wavelength_nm.shape
            return _ocular_index(*key).copy()
        except ValueError as error:
            raise ValueError(f"medium '{medium}': {error}") from None
    given = [m for m in (*(indices or {}), *(media or {})) if m not in MEDIA]
    names = ", ".join((*MEDIA, *given))
    raise ValueError(f"medium '{medium}' has no refractive index; known: {names}")
