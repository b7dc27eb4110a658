"""Functions and coefficients of the extended Nijboer-Zernike (ENZ) series.

V_n^m is the image of a Zernike function, with defocus; beta_n^m are the coefficients of
a pupil function:

    V_n^|m|(r, f) = int_0^1 exp(i f rho²) R_n^|m|(rho) J_|m|(2 pi r rho) rho drho

It is computed by Gauss-Legendre quadrature.  The Bessel-Bessel series of Braat et al.
(2008) is the same integral with exp(i f rho²) expanded by Bauer's formula; it needs
f/2 + 15 terms, a table of weights, and separate limits at r = 0 and f = 0.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.native import core
from estimator.optics.zernike import zernike_values

LogAmplitude = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Logarithm of an apodization at points (x, y) of the unit disc."""


def radial_polynomial(n: int, m: int, rho: ArrayLike) -> NDArray[np.float64]:
    """Return R_n^|m| by the recurrence of Jacobi polynomials, stable at any n."""
    from scipy.special import eval_jacobi

    m, rho = abs(m), np.asarray(rho, np.float64)
    values: NDArray[np.float64] = rho**m * eval_jacobi(
        (n - m) // 2, 0, m, 2.0 * rho**2 - 1.0
    )
    return values


NODE_COUNT = 8
"""Nodes that the loop in C processes at once."""


def hankel_table(
    r: NDArray[np.float64], rho: NDArray[np.float64], weighted: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return sums over nodes (n_r, n_rows, n_orders) of weighted J_m(2 pi r rho).

    Parameters
    ----------
    r : (n_r,)
    rho : (n_nodes,)
        A multiple of `NODE_COUNT`.
    weighted : (n_rows, n_orders, n_nodes)
        Weights of the orders m = 0, 1 ...
    """
    n_rows, n_orders, n_nodes = weighted.shape
    blocks = weighted.reshape(n_rows, n_orders, -1, NODE_COUNT)
    blocks = np.ascontiguousarray(np.moveaxis(blocks, 2, 0))
    found = np.empty((r.size, n_rows, n_orders))
    scratch = np.empty((n_rows + 1, n_orders, NODE_COUNT))
    sizes = r.size, n_nodes, n_rows, n_orders
    core().call("hankel_table", r, rho, blocks, found, scratch, *sizes)
    return found


def radial_nodes(
    degree: int, defocus_rad: float, r: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return Gauss-Legendre nodes and weights on [0, 1] for V.

    Parameters
    ----------
    degree : int
    defocus_rad : float
        Magnitude of f.
    r : float
        Largest image radius, in lambda / pupil radius.
    """
    phase_rad = defocus_rad + (degree + 2.0 * math.pi * r) / 2.0
    count = math.ceil(phase_rad / 2.0 + 3.0 * phase_rad ** (1.0 / 3.0)) + 8
    # Rounded up, so that PSFs share a few cached sets of nodes.
    node, weight = _legendre(32 * math.ceil(count / 32))
    return (node + 1.0) / 2.0, weight / 2.0


@lru_cache(maxsize=64)
def _legendre(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.polynomial.legendre.leggauss(count)


@lru_cache(maxsize=32)
def radial_basis(
    degree: int, n_nodes: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], dict[int, NDArray[np.float64]]]:
    """Return nodes, weights and sqrt(n+1) R_n^m as {m: (n, nodes)}, m = 0 .. degree."""
    node, weight = _legendre(n_nodes)
    rho, weight = (node + 1.0) / 2.0, weight / 2.0
    radial = {
        m: np.array(
            [
                math.sqrt(n + 1.0) * radial_polynomial(n, m, rho)
                for n in range(m, degree + 1, 2)
            ]
        )
        for m in range(degree + 1)
    }
    return rho, weight, radial


def zernike_betas(
    zernike_um: NDArray[np.float64],
    *,
    wavelength_um: float,
    degree: int,
    log_amplitude: LogAmplitude | None = None,
) -> dict[int, NDArray[np.complex128]]:
    """Return the coefficients beta of a pupil function.

    Parameters
    ----------
    zernike_um : (n_terms,)
        Coefficients on the unit disc, including piston, tilt and defocus.
    wavelength_um : float
    degree : int
        Largest n.
    log_amplitude : callable, optional
        Logarithm of the apodization at points (x, y) of the unit disc.

    Returns
    -------
    dict
        Arrays of beta_n^m for n = |m|, |m| + 2, ..., by m.

    Notes
    -----
    The projection uses a Gauss-Legendre times a trapezoidal rule, which converges for
    every wavefront that the degree can represent.  The sum of |beta|² is the captured
    share of the energy.
    """
    rho, weight, radial, x, y, modes = _pupil_nodes(degree, zernike_um.size)
    field = np.exp(2j * math.pi / wavelength_um * (modes @ zernike_um))
    if log_amplitude is not None:
        field = field * np.exp(log_amplitude(x, y))
    harmonics = np.fft.fft(field, axis=1) / x.shape[1]
    return {
        m: 2.0 * (radial[abs(m)] * (weight * rho)) @ harmonics[:, m]
        for m in range(-degree, degree + 1)
    }


@lru_cache(maxsize=2)
def _pupil_nodes(degree: int, n_terms: int) -> tuple[Any, ...]:
    """Return `radial_basis`, and points (x, y) of the pupil with their modes."""
    n_angles = 4 * degree + 64
    rho, weight, radial = radial_basis(degree, 2 * degree + 40)
    angle = 2.0 * math.pi * np.arange(n_angles) / n_angles
    x, y = rho[:, None] * np.cos(angle), rho[:, None] * np.sin(angle)
    return rho, weight, radial, x, y, zernike_values(x, y, n_terms=n_terms)
