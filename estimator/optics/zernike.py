"""Zernike circle polynomials to radial order 10, with OSA/ANSI index and normalization.

Coefficients are arrays in um, index = j, element 0 is piston; the radius of their
circle is a separate argument.  Values, gradients and rescaled coefficients are computed
from monomials x^a y^b, without approximation.

The last axis of an array has all terms up to an order: 28 up to order 6, the default,
and at most 66 up to order 10.  Terms and monomials are sorted by order, so that the
first terms of a longer array are the terms of a shorter one.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

DEFAULT_ORDER = 6
N_TERMS = (DEFAULT_ORDER + 1) * (DEFAULT_ORDER + 2) // 2
"""Radial order and number of terms by default."""

HIGHEST_ORDER = 10
MAX_TERMS = (HIGHEST_ORDER + 1) * (HIGHEST_ORDER + 2) // 2
"""Highest radial order, and its number of terms."""


@cache
def radial_order(n_terms: int) -> int:
    """Return the radial order that has a number of terms, for example 6 for 28.

    Raises
    ------
    ValueError
        No order up to 10 has this number of terms.
    """
    order = (math.isqrt(8 * max(n_terms, 0) + 1) - 3) // 2
    if (order + 1) * (order + 2) // 2 != n_terms or not 0 <= order <= HIGHEST_ORDER:
        allowed = [(n + 1) * (n + 2) // 2 for n in range(HIGHEST_ORDER + 1)]
        raise ValueError(
            f"{n_terms} Zernike terms: allowed are {', '.join(map(str, allowed))}"
        )
    return order


@cache
def exponents(n_terms: int = N_TERMS) -> NDArray[np.int64]:
    """Return the exponents (a, b) of the monomials x^a y^b, (n_terms, 2), by degree."""
    found = np.array(
        [
            (degree - b, b)
            for degree in range(radial_order(n_terms) + 1)
            for b in range(degree + 1)
        ]
    )
    found.setflags(write=False)
    return found


# a copy: compiled loops take a writable array
EXPONENTS: NDArray[np.int64] = exponents().copy()
"""Exponents of the default terms, (28, 2)."""


@cache
def monomial_degrees(n_terms: int = N_TERMS) -> NDArray[np.int64]:
    """Return the degree (n_terms,) of each monomial."""
    degrees: NDArray[np.int64] = exponents(n_terms).sum(axis=1)
    degrees.setflags(write=False)
    return degrees


def padded_terms(coefficients: ArrayLike, n_terms: int) -> NDArray[np.float64]:
    """Return coefficients or monomials (..., n_terms) with zeros for added terms.

    Raises
    ------
    ValueError
        There are more than ``n_terms`` terms.
    """
    coefficients = np.asarray(coefficients, dtype=np.float64)
    missing = n_terms - coefficients.shape[-1]
    if missing < 0:
        raise ValueError(f"{coefficients.shape[-1]} terms: must be at most {n_terms}")
    if not missing:
        return coefficients
    zeros = np.zeros((*coefficients.shape[:-1], missing))
    return np.concatenate([coefficients, zeros], axis=-1)


def nm_from_index(index: int) -> tuple[int, int]:
    """Return the radial order n and azimuthal frequency m of OSA/ANSI index j.

    Raises
    ------
    ValueError
        The index is negative.
    """
    if index < 0:
        raise ValueError(f"Zernike index {index}: must be 0 or more")
    n = math.ceil((-3.0 + math.sqrt(9.0 + 8.0 * index)) / 2.0)
    return n, 2 * index - n * (n + 2)


def index_from_nm(n: int, m: int) -> int:
    """Return the OSA/ANSI index j = (n(n+2)+m)/2.

    Raises
    ------
    ValueError
        There is no such term: n >= |m| is required, with n - |m| even.
    """
    if n < 0 or abs(m) > n or (n - abs(m)) % 2:
        raise ValueError(f"Zernike term ({n},{m}): needs n >= |m| >= 0, n - |m| even")
    return (n * (n + 2) + m) // 2


def summed_terms(*parts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of coefficients or monomials, padded to the longest of them."""
    n_terms = max(part.shape[-1] for part in parts)
    total = padded_terms(parts[0], n_terms)
    for part in parts[1:]:
        total = total + padded_terms(part, n_terms)
    return total


_Terms = dict[tuple[int, int], int]
"""Coefficients of monomials by their exponents."""


def _solid_harmonic(m: int) -> tuple[_Terms, _Terms]:
    """Return real and imaginary part of (x + iy)^m as {(a, b): coefficient}."""
    real: _Terms
    imaginary: _Terms
    real, imaginary = {}, {}
    for k in range(m + 1):
        sign = (1, 1, -1, -1)[k % 4]
        part = real if k % 2 == 0 else imaginary
        part[(m - k, k)] = sign * math.comb(m, k)
    return real, imaginary


def _radial_coefficients(n: int, m: int) -> list[tuple[int, float]]:
    """Return R_n^m / rho^m as [(power of rho², coefficient)]."""
    half_sum, half_difference = (n + m) // 2, (n - m) // 2
    return [
        (
            half_difference - k,
            (-1) ** k
            * math.factorial(n - k)
            / (
                math.factorial(k)
                * math.factorial(half_sum - k)
                * math.factorial(half_difference - k)
            ),
        )
        for k in range(half_difference + 1)
    ]


@cache
def norms(n_terms: int = N_TERMS) -> NDArray[np.float64]:
    """Return the factors (n_terms,) of polynomials that make their RMS 1."""
    terms = map(nm_from_index, range(n_terms))
    found = np.array([math.sqrt((2 - (m == 0)) * (n + 1)) for n, m in terms])
    found.setflags(write=False)
    return found


@cache
def monomial_matrix(n_terms: int = N_TERMS) -> NDArray[np.float64]:
    """Return the coefficients of every Zernike polynomial in the monomial basis.

    Returns
    -------
    matrix : (n_terms, n_terms)
        ``matrix[j, t]`` is the coefficient of ``x**a * y**b`` in Z_j, with
        ``(a, b) = exponents(n_terms)[t]``; ``zernike_um @ matrix`` are the monomial
        coefficients of a wavefront.
    """
    column = {tuple(e): t for t, e in enumerate(exponents(n_terms).tolist())}
    matrix = np.zeros((n_terms, n_terms))
    for j in range(n_terms):
        n, m = nm_from_index(j)
        norm = norms(n_terms)[j]
        harmonic = _solid_harmonic(abs(m))[0 if m >= 0 else 1]
        for power, radial in _radial_coefficients(n, abs(m)):
            for i in range(power + 1):
                binomial = math.comb(power, i)
                for (a, b), value in harmonic.items():
                    key = (a + 2 * (power - i), b + 2 * i)
                    matrix[j, column[key]] += norm * radial * binomial * value
    matrix.setflags(write=False)
    return matrix


@cache
def inverse_monomial_matrix(n_terms: int = N_TERMS) -> NDArray[np.float64]:
    """Return the inverse (n_terms, n_terms) of `monomial_matrix`."""
    inverse = np.linalg.inv(monomial_matrix(n_terms)).astype(np.float64)
    inverse.flags.writeable = False
    return inverse


def wavefront_polynomial(zernike_um: ArrayLike) -> NDArray[np.float64]:
    """Return the monomial coefficients (..., n_terms), um, of W on the unit circle.

    W is the sum of C_j Z_j over coefficients (..., n_terms), um.
    """
    zernike_um = np.asarray(zernike_um, dtype=np.float64)
    return zernike_um @ monomial_matrix(zernike_um.shape[-1])


def _powers(x: NDArray[np.float64], highest: int) -> NDArray[np.float64]:
    return np.stack([x**k for k in range(highest + 1)])


def zernike_values(
    x: ArrayLike, y: ArrayLike, *, n_terms: int = N_TERMS
) -> NDArray[np.float64]:
    """Return the values of the polynomials.

    Parameters
    ----------
    x, y : (...), unit pupil
        Positions on the unit circle, x to the person's right, y up.
    n_terms : int

    Returns
    -------
    values : (..., n_terms)
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    a, b = exponents(n_terms).T
    px, py = _powers(x, radial_order(n_terms)), _powers(y, radial_order(n_terms))
    return np.moveaxis(px[a] * py[b], 0, -1) @ monomial_matrix(n_terms).T


def zernike_gradient(
    x: ArrayLike, y: ArrayLike, *, n_terms: int = N_TERMS
) -> NDArray[np.float64]:
    """Return the gradients of the polynomials, per unit of the normalized pupil.

    Returns
    -------
    gradient : (..., 2, n_terms)
        d/dx and d/dy.
    """
    x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    px, py = _powers(x, radial_order(n_terms)), _powers(y, radial_order(n_terms))
    a, b = exponents(n_terms).T
    shape = (-1,) + (1,) * x.ndim
    d_x = a.reshape(shape) * px[np.maximum(a - 1, 0)] * py[b]
    d_y = b.reshape(shape) * px[a] * py[np.maximum(b - 1, 0)]
    monomials = np.stack([np.moveaxis(d_x, 0, -1), np.moveaxis(d_y, 0, -1)], axis=-2)
    return monomials @ monomial_matrix(n_terms).T


def rescale_pupil(zernike_um: ArrayLike, *, radius_ratio: ArrayLike) -> NDArray[Any]:
    """Return the coefficients of a wavefront on a concentric circle.

    Parameters
    ----------
    zernike_um : (..., n_terms), um
    radius_ratio : (...)
        New radius over old one.  Ratios above 1 extrapolate the wavefront.

    Returns
    -------
    zernike_um : (..., n_terms), um

    Raises
    ------
    ValueError
        A ratio is not positive.

    Notes
    -----
    The result agrees with the closed form of Dai (2006) to 1e-12.
    """
    ratio = np.asarray(radius_ratio, dtype=np.float64)
    if not np.all(ratio > 0):
        raise ValueError(f"pupil radius ratio {radius_ratio!s}: must be positive")
    polynomial_um = wavefront_polynomial(zernike_um)
    n_terms = polynomial_um.shape[-1]
    scaled = polynomial_um * ratio[..., None] ** monomial_degrees(n_terms)
    return np.linalg.solve(monomial_matrix(n_terms).T, scaled[..., None])[..., 0]


@cache
def _horizontal_parity(n_terms: int) -> NDArray[np.float64]:
    terms = [nm_from_index(j) for j in range(n_terms)]
    odd_in_x = [(m > 0 and m % 2 == 1) or (m < 0 and m % 2 == 0) for _, m in terms]
    return np.where(odd_in_x, -1.0, 1.0)


def flip_horizontal(zernike_um: ArrayLike) -> NDArray[np.float64]:
    """Mirror coefficients (..., n_terms) in x.

    This converts between the examiner's and the eye's frame, and between OD and OS.
    """
    zernike_um = np.asarray(zernike_um, dtype=np.float64)
    return zernike_um * _horizontal_parity(zernike_um.shape[-1])


def remove_central_tilt(zernike_um: ArrayLike) -> NDArray[np.float64]:
    """Return coefficients (..., n_terms) with C(1,±1) for zero slope of W at 0."""
    zernike_um = np.array(zernike_um, dtype=np.float64)
    slope = zernike_gradient(0.0, 0.0, n_terms=zernike_um.shape[-1])
    for row, j in ((0, index_from_nm(1, 1)), (1, index_from_nm(1, -1))):
        zernike_um[..., j] -= zernike_um @ slope[row] / slope[row, j]
    return zernike_um
