"""Cone fundamentals by age and field size, and color-matching functions.

The fundamentals are sensitivities at the cornea: they include the absorption of the
lens and of the macular pigment.  Light that a profile's yellowing has already dimmed
must not be weighted by them.

`cie_2006.csv` contains the published functions in steps of 1 nm.

References
----------
CIE 170-1:2006; Stockman & Sharpe, Vision Res. 40 (2000), 1711; Pokorny, Smith & Lutze,
Appl. Opt. 26 (1987), 1437 (age of the lens); CIE 170-2:2015 (XYZ from cones).
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Observer = Literal["cie_1931", "cie_2006"]
OBSERVERS: tuple[str, ...] = get_args(Observer)

STANDARD_AGE_YEARS = 32.0
AGES_YEARS = (20.0, 80.0)
"""Ages for which CIE 170-1 gives the density of the lens."""

FIELD_SIZES_DEG = (1.0, 10.0)
"""Field sizes for which CIE 170-1 gives the macular and photopigment densities."""

OLD_AGE_YEARS = 60.0
"""Age from which the lens changes faster."""

PUBLISHED_SIZES_DEG = (2.0, 10.0)
"""Field sizes with published tables, which the fundamentals reproduce exactly."""

XYZ_FROM_LMS = {
    2.0: (
        (1.94735469, -1.41445123, 0.36476327),
        (0.68990272, 0.34832189, 0.0),
        (0.0, 0.0, 1.93485343),
    ),
    10.0: (
        (1.93986443, -1.34664359, 0.43044935),
        (0.69283932, 0.34967567, 0.0),
        (0.0, 0.0, 2.14687945),
    ),
}
"""CIE 170-2:2015, by field size."""

MIN_BANDS = 2


class Tables(NamedTuple):
    """Published functions at the wavelengths (n,) of ``nm``.

    ``fundamentals`` (2, n, 3) are those of `PUBLISHED_SIZES_DEG` in energy units;
    ``absorbance`` (n, 3) is relative to its peak, 0 where none is published;
    ``macula`` (n,) is relative to 460 nm; ``media_aging`` and ``media_constant`` (n,)
    are the parts of the density of the lens that do and do not change with age;
    ``xyz_1931`` is (n, 3).
    """

    nm: NDArray[np.float64]
    fundamentals: NDArray[np.float64]
    absorbance: NDArray[np.float64]
    macula: NDArray[np.float64]
    media_aging: NDArray[np.float64]
    media_constant: NDArray[np.float64]
    xyz_1931: NDArray[np.float64]


@lru_cache(maxsize=1)
def _tables() -> Tables:
    path = Path(__file__).with_name("cie_2006.csv")
    rows = np.genfromtxt(path, delimiter=",", skip_header=1, filling_values=-np.inf)
    constant = rows[:, 12]
    return Tables(
        nm=rows[:, 0],
        fundamentals=np.stack([rows[:, 1:4], rows[:, 4:7]]),
        absorbance=10.0 ** rows[:, 7:10],
        macula=rows[:, 10],
        media_aging=rows[:, 11] - constant,
        media_constant=constant,
        xyz_1931=rows[:, 13:16],
    )


def cone_fundamentals(
    wavelengths_nm: ArrayLike,
    *,
    age_years: float = STANDARD_AGE_YEARS,
    field_size_deg: float = 2.0,
) -> NDArray[np.float64]:
    """Return the sensitivities of L, M and S cones at the cornea, in energy units.

    Parameters
    ----------
    wavelengths_nm : (n,)
    age_years : float, 20 to 80
        Age of the lens.
    field_size_deg : float, 1 to 10
        Diameter of the field, on which the macular pigment and the length of the cones
        depend.

    Returns
    -------
    (n, 3)
        Peaks are 1.  Linear between steps of 1 nm, and 0 outside 390 to 830 nm.

    Raises
    ------
    ValueError
        If an argument is out of range.

    Notes
    -----
    The published tables for 2 and 10 deg differ from the formula of CIE 170-1 by up to
    2.6e-4 of the peak.  This function returns them at the age of 32, and applies their
    ratio to the formula, interpolated between 2 and 10 deg, to other ages and sizes.
    """
    _check_range("age_years", age_years, AGES_YEARS)
    _check_range("field_size_deg", field_size_deg, FIELD_SIZES_DEG)
    return _interpolated(wavelengths_nm, _fundamentals(age_years, field_size_deg))


def _fundamentals(age_years: float, field_size_deg: float) -> NDArray[np.float64]:
    """Return the fundamentals (n, 3) at the wavelengths of the tables."""
    tables = _tables()
    small_deg, large_deg = PUBLISHED_SIZES_DEG
    share = (field_size_deg - small_deg) / (large_deg - small_deg)
    share = min(max(share, 0.0), 1.0)
    ratios = [
        np.divide(
            table,
            (found := _by_formula(STANDARD_AGE_YEARS, size_deg)),
            out=np.ones_like(table),
            where=(table > 0.0) & (found > 0.0),
        )
        for table, size_deg in zip(
            tables.fundamentals, PUBLISHED_SIZES_DEG, strict=True
        )
    ]
    ratio = (1.0 - share) * ratios[0] + share * ratios[1]
    return np.asarray(_by_formula(age_years, field_size_deg) * ratio)


def _by_formula(age_years: float, field_size_deg: float) -> NDArray[np.float64]:
    """Return the fundamentals (n, 3) of CIE 170-1, equations in chapter 5."""
    tables = _tables()
    shrinking = math.exp(-field_size_deg / 1.333)
    # CIE 170-1 rounds the peak densities to three decimals.
    long_density = round(0.38 + 0.54 * shrinking, 3)
    short_density = round(0.30 + 0.45 * shrinking, 3)
    macular_density = round(0.485 * math.exp(-field_size_deg / 6.132), 3)
    densities = np.array([long_density, long_density, short_density])
    absorptance = 1.0 - 10.0 ** (-densities * tables.absorbance)
    if age_years <= OLD_AGE_YEARS:
        aging = 1.0 + 0.02 * (age_years - STANDARD_AGE_YEARS)
    else:
        aging = 1.56 + 0.0667 * (age_years - OLD_AGE_YEARS)
    media = aging * tables.media_aging + tables.media_constant
    before = 10.0 ** -(media + macular_density * tables.macula)
    # a quantum carries energy in inverse proportion to the wavelength
    found = absorptance * (before * tables.nm)[:, None]
    return np.asarray(found / found.max(axis=0))


def color_matching(
    wavelengths_nm: ArrayLike,
    *,
    observer: Observer = "cie_1931",
    field_size_deg: float = 2.0,
) -> NDArray[np.float64]:
    """Return the color-matching functions x, y and z of a standard observer.

    Parameters
    ----------
    wavelengths_nm : (n,)
    observer : "cie_1931" or "cie_2006"
        The standard observer of 1931, or the one from cone fundamentals.
    field_size_deg : 2 or 10
        Of the latter; the former is for 2 deg.

    Returns
    -------
    (n, 3)
        Linear between steps of 1 nm, and 0 outside 390 to 830 nm.

    Raises
    ------
    ValueError
        If the observer is unknown, or has no functions for this field size.
    """
    if observer not in OBSERVERS:
        raise ValueError(f"observer {observer!r}: allowed are {', '.join(OBSERVERS)}")
    sizes_deg = PUBLISHED_SIZES_DEG if observer == "cie_2006" else (2.0,)
    if field_size_deg not in sizes_deg:
        allowed = " or ".join(f"{size:g}" for size in sizes_deg)
        raise ValueError(
            f"field_size_deg {field_size_deg!r} with {observer}: allowed is {allowed}"
        )
    tables = _tables()
    if observer == "cie_1931":
        return _interpolated(wavelengths_nm, tables.xyz_1931)
    own = tables.fundamentals[PUBLISHED_SIZES_DEG.index(field_size_deg)]
    return _interpolated(wavelengths_nm, own @ np.array(XYZ_FROM_LMS[field_size_deg]).T)


def lms_weights(
    wavelengths_nm: ArrayLike,
    *,
    age_years: float = STANDARD_AGE_YEARS,
    field_size_deg: float = 2.0,
) -> NDArray[np.float64]:
    """Return the weights (n, 3) of bands in the signals of L, M and S cones.

    Parameters
    ----------
    wavelengths_nm : (n,)
        Wavelengths of the bands, ascending.
    age_years, field_size_deg : float
        As for `cone_fundamentals`.

    Returns
    -------
    (n, 3)
        Integrals of the fundamentals, for spectra that are linear between bands and end
        at the first and the last.  A spectrum of 1 over the visible wavelengths has
        the signal 1 at every age: the cones are adapted to it.

    Raises
    ------
    ValueError
        If an argument is out of range, or there are less than two bands.
    """
    _check_range("age_years", age_years, AGES_YEARS)
    _check_range("field_size_deg", field_size_deg, FIELD_SIZES_DEG)
    functions = _fundamentals(age_years, field_size_deg)
    return _integrals(wavelengths_nm, functions) / functions.sum(axis=0)


def xyz_weights(
    wavelengths_nm: ArrayLike,
    *,
    observer: Observer = "cie_1931",
    field_size_deg: float = 2.0,
) -> NDArray[np.float64]:
    """Return the weights (n, 3) of bands in X, Y and Z.

    Parameters
    ----------
    wavelengths_nm : (n,)
        Wavelengths of the bands, ascending.
    observer, field_size_deg
        As for `color_matching`.

    Returns
    -------
    (n, 3)
        As for `lms_weights`: a spectrum of 1 has Y = 1.

    Raises
    ------
    ValueError
        If an argument is out of range, or there are less than two bands.
    """
    functions = color_matching(
        _tables().nm, observer=observer, field_size_deg=field_size_deg
    )
    return _integrals(wavelengths_nm, functions) / functions[:, 1].sum()


def _interpolated(
    wavelengths_nm: ArrayLike, functions: NDArray[np.float64]
) -> NDArray[np.float64]:
    at_nm = np.asarray(wavelengths_nm, dtype=np.float64)
    nm = _tables().nm
    found = [np.interp(at_nm, nm, column, 0.0, 0.0) for column in functions.T]
    return np.stack(found, axis=-1)


def _integrals(
    wavelengths_nm: ArrayLike, functions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sums (n, 3) of functions, in steps of 1 nm, times each band's share.

    The share of a band is a triangle between its neighbors.
    """
    bands_nm = np.asarray(wavelengths_nm, dtype=np.float64)
    is_valid = bands_nm.ndim == 1 and bands_nm.size >= MIN_BANDS
    if not (is_valid and np.isfinite(bands_nm).all() and (np.diff(bands_nm) > 0).all()):
        raise ValueError(
            f"wavelengths_nm of shape {bands_nm.shape}: allowed are at least "
            f"{MIN_BANDS}, ascending"
        )
    nm = _tables().nm
    is_inside = (nm >= bands_nm[0]) & (nm <= bands_nm[-1])
    share = np.stack([np.interp(nm, bands_nm, own) for own in np.eye(bands_nm.size)])
    return np.asarray((share * is_inside) @ functions)


def _check_range(name: str, value: float, limits: tuple[float, float]) -> None:
    low, high = limits
    if not low <= value <= high:
        raise ValueError(f"{name} {value!r}: allowed are {low:g} to {high:g}")
