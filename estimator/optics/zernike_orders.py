"""Zernike coefficients in the orders, normalizations and units of other programs.

Everywhere else, coefficients are in um, in the order and normalization of OSA/ANSI
(ANSI Z80.28, ISO 24157:2008; Thibos et al., J. Refract. Surg. 18, S652, 2002), in the
frame of the eye and positive where light is ahead.

    osa        j = (n(n+2) + m) / 2, from 0; the RMS of each polynomial is 1
    noll       from 1, by n and |m|; even numbers are cosines; RMS 1 (Noll, J. Opt. Soc.
               Am. 66, 207, 1976); the "standard" order of Zemax
    fringe     from 1, by n + |m|, 37 terms of the University of Arizona (Loomis, ASTM
               STP 666, 71, 1978; Wyant and Creath, Appl. Opt. Opt. Eng. 11, 1, 1992,
               who count from 0); the 37th is (12,0); not normalized
    malacara   from 1, by n and from sines to cosines of an angle that is clockwise from
               +y; not normalized (Malacara, Optical Shop Testing, 2nd ed., table 13.2,
               1992)
    born-wolf  from 1, by n and from m = n down to -n; not normalized; as in MACOS
               (NASA JPL), after Born and Wolf, Principles of Optics, section 9.2, who
               do not number the terms
    nm         radial order and azimuthal frequency (n,m) of OSA/ANSI instead of a
               number; sines have m < 0

Polynomials that are not normalized are 1 at the edge of the circle, at the angle where
their sine or cosine is 1.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.units import NM_PER_UM
from estimator.optics.zernike import (
    HIGHEST_ORDER,
    MAX_TERMS,
    flip_horizontal,
    index_from_nm,
    nm_from_index,
    norms,
)

FIRST_INDEX = {"osa": 0, "noll": 1, "fringe": 1, "malacara": 1, "born-wolf": 1}
"""Number of piston in the orders of single numbers."""

ORDERS = (*FIRST_INDEX, "nm")
NORMALIZATIONS = ("rms", "none")
UNITS = ("um", "nm", "waves")
FRAMES = ("eye", "examiner")
SIGNS = ("ahead", "behind")

DEFAULT_NORMALIZATION = {
    **dict.fromkeys(("osa", "noll", "nm"), "rms"),
    **dict.fromkeys(("fringe", "malacara", "born-wolf"), "none"),
}
"""Normalization in the publication that an order is named after."""

N_FRINGE = 37
MAX_VALUES = 231
"""Largest number of coefficients: all terms up to order 20."""

TERM_COUNTS = (28, 36, 45, 55, 66)
"""Numbers of terms of results, up to orders 6 to 10."""


def zernike_from(
    values: ArrayLike | Mapping[Any, float],
    *,
    order: str,
    unit: str = "um",
    normalization: str | None = None,
    wavelength_nm: ArrayLike | None = None,
    frame: str = "eye",
    positive: str = "ahead",
) -> NDArray[np.float64]:
    """Convert coefficients from another order, normalization, unit, frame or sign.

    Parameters
    ----------
    values : (..., n) or mapping
        Coefficients, piston first; or values by number, or for the order ``"nm"`` by
        ``"n,m"`` or ``(n, m)``.  Terms that are not given are 0.
    order : {"osa", "noll", "fringe", "malacara", "born-wolf", "nm"}
        The module's description has definitions and sources.
    unit : {"um", "nm", "waves"}, optional
    normalization : {"rms", "none"}, optional
        Whether the polynomials have an RMS of 1; by default, as in the publication that
        the order is named after.
    wavelength_nm : (...), optional
        Wavelength of the unit ``"waves"``, which requires it.
    frame : {"eye", "examiner"}, optional
        ``"eye"`` has x to the person's right, ``"examiner"`` to the right of someone
        who faces the person, as OSA/ANSI and ISO 24157 (with the axes of ISO 8429) have
        it for either eye.
    positive : {"ahead", "behind"}, optional
        Where the wavefront is positive: where light is ahead, as in OSA/ANSI, or where
        it is behind because its optical path is longer.

    Returns
    -------
    zernike_um : (..., n_terms), um
        OSA/ANSI coefficients in the eye frame, index = j: 28, or up to 66 if higher
        orders are not zero.

    Raises
    ------
    ValueError
        A name, a term or the wavelength is invalid, a coefficient is not finite, or a
        term above the tenth order is not zero.
    """
    um_per_unit = _um_per_unit(unit, wavelength_nm, positive)
    place, factor = _places(order, normalization)
    given = _listed(values, order)
    last = int(np.flatnonzero(_is_used(given)).max(initial=0))
    if last > place.max():
        name = term_names(order, last + 1)[last]
        if order == "fringe" and last >= N_FRINGE:
            raise ValueError(f"fringe has no term {name}; allowed: 1 to {N_FRINGE}")
        raise ValueError(
            f"{order} term {name} has radial order {term_of(order, last)[0]}: must be "
            f"0 above order {HIGHEST_ORDER}"
        )
    is_given = (place >= 0) & (place < given.shape[-1])
    zernike_um = np.zeros((*given.shape[:-1], MAX_TERMS))
    zernike_um[..., is_given] = given[..., place[is_given]] / factor[is_given]
    zernike_um = um_per_unit[..., None] * zernike_um
    n_used = int(np.flatnonzero(_is_used(zernike_um)).max(initial=-1)) + 1
    n_terms = next(count for count in TERM_COUNTS if count >= n_used)
    return _in_frame(zernike_um[..., :n_terms], frame)


def zernike_to(
    zernike_um: ArrayLike,
    *,
    order: str,
    unit: str = "um",
    normalization: str | None = None,
    wavelength_nm: ArrayLike | None = None,
    frame: str = "eye",
    positive: str = "ahead",
) -> NDArray[np.float64]:
    """Convert OSA/ANSI coefficients to another order, normalization, unit or frame.

    Parameters
    ----------
    zernike_um : (..., n_terms), um
        OSA/ANSI coefficients in the eye frame, index = j.
    order, unit, normalization, wavelength_nm, frame, positive
        See `zernike_from`.  The order ``"nm"`` has the same array as ``"osa"``.

    Returns
    -------
    values : (..., n)
        Coefficients, piston first.  `term_names` has their names.

    Raises
    ------
    ValueError
        A name or the wavelength is invalid, or a term that the order lacks is not zero,
        as (6,6) in Fringe.
    """
    um_per_unit = _um_per_unit(unit, wavelength_nm, positive)
    place, factor = _places(order, normalization)
    given_um = _in_frame(zernike_um, frame)
    n_terms = given_um.shape[-1]
    if lacking := lacking_terms(given_um, order):
        shown = ", ".join(f"({n},{m})" for n, m in lacking)
        raise ValueError(f"order '{order}' lacks the terms {shown}: they must be 0")
    has_place = place[:n_terms] >= 0
    indices = place[:n_terms][has_place]
    values = np.zeros((*given_um.shape[:-1], int(indices.max()) + 1))
    values[..., indices] = (given_um * factor[:n_terms])[..., has_place]
    return values / um_per_unit[..., None]


def lacking_terms(zernike_um: ArrayLike, order: str) -> list[tuple[int, int]]:
    """Return (n, m) of the coefficients (..., n_terms) that an order lacks, if not 0.

    Fringe has all terms up to the fifth order, and some of each higher one.
    """
    used = np.flatnonzero(_is_used(np.asarray(zernike_um, dtype=np.float64)))
    place, _ = _places(order, None)
    return [nm_from_index(int(j)) for j in used if place[j] < 0]


def term_names(order: str, count: int) -> list[str]:
    """Return the names of the first terms of an order: numbers, or ``"n,m"``."""
    if order == "nm":
        return ["{},{}".format(*nm_from_index(index)) for index in range(count)]
    return [str(index + FIRST_INDEX[order]) for index in range(count)]


def _is_used(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which (n,) of coefficients (..., n) are not all zero."""
    return (values != 0.0).any(axis=tuple(range(values.ndim - 1)))


def _in_frame(zernike_um: ArrayLike, frame: str) -> NDArray[np.float64]:
    """Convert coefficients from the eye frame to another one, or back."""
    _check_name("frame", frame, FRAMES)
    if frame == "examiner":
        return flip_horizontal(zernike_um)
    return np.asarray(zernike_um, dtype=np.float64)


def _um_per_unit(
    unit: str, wavelength_nm: ArrayLike | None, positive: str
) -> NDArray[np.float64]:
    """Return the unit (...) in um; negative where light that is behind is positive."""
    _check_name("unit", unit, UNITS)
    _check_name("positive", positive, SIGNS)
    unit_um = np.asarray({"um": 1.0, "nm": 1.0 / NM_PER_UM}.get(unit, 0.0))
    if unit == "waves":
        if wavelength_nm is None:
            raise ValueError("wavelength_nm is required by the unit 'waves'")
        unit_um = np.asarray(wavelength_nm, dtype=np.float64) / NM_PER_UM
        if not (np.isfinite(unit_um).all() and (unit_um > 0.0).all()):
            raise ValueError(f"wavelength_nm {wavelength_nm!s}: must be above 0")
    return unit_um if positive == "ahead" else -unit_um


def _check_name(field: str, name: str, allowed: tuple[str, ...]) -> None:
    if name not in allowed:
        raise ValueError(f"{field} {name!r} is unknown; allowed: {', '.join(allowed)}")


def _listed(values: ArrayLike | Mapping[Any, float], order: str) -> NDArray[np.float64]:
    """Return coefficients as a finite array (..., n), piston first."""
    if isinstance(values, Mapping):
        found: dict[int, Any] = {}
        for key, value in values.items():
            index = _index_of(key, order)
            if index in found:
                raise ValueError(f"{order} term {key!r} is given twice")
            found[index] = value
        values = [found.get(index, 0.0) for index in range(max(found, default=0) + 1)]
    elif order == "nm":
        raise ValueError(
            "order 'nm' requires coefficients by term, as {'3,-1': 0.25}; allowed: for "
            f"a list, the order {', '.join(FIRST_INDEX)}"
        )
    given = np.asarray(values, dtype=np.float64)
    if given.ndim == 0 or not 0 < given.shape[-1] <= MAX_VALUES:
        raise ValueError(
            f"coefficients of shape {given.shape}: allowed are 1 to {MAX_VALUES} in "
            "the last axis"
        )
    if not np.isfinite(given).all():
        raise ValueError(f"{order} coefficients must be finite")
    return given


def _index_of(key: Any, order: str) -> int:
    """Return the place of a term in a list, from its number or its n and m."""
    try:
        if order == "nm":
            n, m = (
                int(part) for part in (key.split(",") if isinstance(key, str) else key)
            )
            return _bounded(index_from_nm(n, m), key)
        return _bounded(int(key) - FIRST_INDEX[order], key)
    except (TypeError, ValueError):
        first = FIRST_INDEX.get(order)
        form = "'n,m', n >= |m|, n - |m| even" if first is None else f"{first} or more"
        raise ValueError(f"{order} has no term {key!r}; allowed: {form}") from None


def _bounded(index: int, key: object) -> int:
    if not 0 <= index < MAX_VALUES:
        raise ValueError(f"term {key!r} is out of range")
    return index


@cache
def _places(
    order: str, normalization: str | None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return where an order has the OSA/ANSI terms, and their factors.

    Returns
    -------
    place : (66,)
        Place in a list of the order, from 0; -1 for terms that it lacks.
    factor : (66,)
        Coefficient in the order over the OSA/ANSI coefficient.
    """
    _check_name("order", order, ORDERS)
    if normalization is None:
        normalization = DEFAULT_NORMALIZATION[order]
    _check_name("normalization", normalization, NORMALIZATIONS)
    place = np.full(MAX_TERMS, -1)
    factor = np.ones(MAX_TERMS) if normalization == "rms" else norms(MAX_TERMS).copy()
    for index in range(N_FRINGE - 1 if order == "fringe" else MAX_TERMS):
        n, m, sign = term_of(order, index)
        j = index_from_nm(n, m)
        place[j] = index
        factor[j] *= sign
    place.setflags(write=False)
    factor.setflags(write=False)
    return place, factor


def term_of(order: str, index: int) -> tuple[int, int, int]:
    """Return n, m and the sign of the OSA/ANSI polynomial at a place in an order."""
    if order == "fringe":
        return (*_fringe_term(index), 1)
    n = (math.isqrt(8 * index + 1) - 1) // 2
    k = index - n * (n + 1) // 2
    if order == "noll":
        m = k + (k + n) % 2
        return n, m if index % 2 else -m, 1  # the number is index + 1
    if order == "born-wolf":
        return n, n - 2 * k, 1
    if order == "malacara":
        return (n, *_from_vertical(n - 2 * k))
    return n, 2 * k - n, 1


def _fringe_term(index: int) -> tuple[int, int]:
    if index == N_FRINGE - 1:
        return 12, 0
    half = math.isqrt(index)  # half of n + |m|
    k = index - half**2
    m = half - k // 2
    return 2 * half - m, m if k % 2 == 0 else -m


def _from_vertical(m: int) -> tuple[int, int]:
    """Return the m of OSA/ANSI, and the sign, of a term of Malacara.

    His sines have m > 0, of an angle pi/2 - theta.
    """
    frequency, turns = abs(m), abs(m) % 4
    if m > 0:
        return (frequency if turns % 2 else -frequency), (-1, 1, 1, -1)[turns]
    return (-frequency if turns % 2 else frequency), (1, 1, -1, -1)[turns]
