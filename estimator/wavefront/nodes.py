"""Quadrature nodes over the pupil: rings and azimuths.

If six orders do not describe a wavefront exactly, its coefficients depend on the
weighting of the pupil in the fit.  The weighting follows the reference data
(eye_reference.json): 14 rings of equal area, each sampled at its outer edge.  The Gauss
rule of this discrete measure needs fewer rings, with an error that falls exponentially
with their number.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import N_TERMS, radial_order, zernike_values

N_RINGS, N_AZIMUTHS = 8, 24
"""Default sampling of the stop: 192 rays; error of 2e-7 um at 7 mm and 45 deg."""

N_CIRCLE_RINGS, N_CIRCLE_AZIMUTHS = 6, 16
"""Default sampling of a circle: 96 rays, for 28 terms."""

DENSE_CIRCLE = (10, 26)
"""Sampling of a circle for up to 66 terms."""

N_REFERENCE_RINGS = 14

Nodes = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
CircleNodes = tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]
]


def _gauss_nodes(atoms: NDArray[Any], weights: NDArray[Any], n: int) -> NDArray[Any]:
    """Return the nodes of a discrete measure's n-point Gauss rule (Golub-Welsch)."""
    before, current = np.zeros_like(atoms), np.ones_like(atoms)
    diagonal, squares, last_norm = [], [], 1.0
    for k in range(n):
        norm = np.sum(weights * current**2)
        diagonal.append(np.sum(weights * atoms * current**2) / norm)
        squares.append(norm / last_norm if k else 0.0)
        before, current = (
            current,
            (atoms - diagonal[-1]) * current - squares[-1] * before,
        )
        last_norm = norm
    off = np.sqrt(squares[1:])
    return np.linalg.eigvalsh(np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1))


def _rule(
    atoms: NDArray[Any], weights: NDArray[Any], n: int, *, with_rim: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and weights on [0, 1]: Gauss, or Gauss-Radau with a node at 1."""
    weights = weights / weights.sum()
    if with_rim:
        inner = _gauss_nodes(atoms, weights * (1.0 - atoms), n - 1)
        nodes = np.append(inner, 1.0)
    else:
        nodes = _gauss_nodes(atoms, weights, n)
    legendre = np.polynomial.legendre.legvander
    moments = legendre(2.0 * atoms - 1.0, n - 1).T @ weights
    return nodes, np.linalg.solve(legendre(2.0 * nodes - 1.0, n - 1).T, moments)


def _azimuths(n: int) -> NDArray[np.float64]:
    angle = 2.0 * np.pi * np.arange(n) / n
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def fewest_nodes(n_terms: int) -> tuple[int, int]:
    """Return the smallest numbers of rings and azimuths that determine so many terms.

    Sixth-order fits need 5 and 14.
    """
    order = radial_order(n_terms)
    return order // 2 + 2, 2 * order + 2


@cache
def stop_nodes(n_rings: int = N_RINGS, n_azimuths: int = N_AZIMUTHS) -> Nodes:
    """Return quadrature nodes over the stop.

    Returns
    -------
    rings : (n_rings,)
        Radii relative to the radius of the stop; the last one is the rim.
    weights : (n_rings,)
    azimuths : (n_azimuths, 2)
        Cosine and sine.

    Raises
    ------
    ValueError
        There are fewer than 5 rings or 14 azimuths, too few for 28 coefficients.

    Notes
    -----
    From 14 rings on, the rule is the discrete measure itself.
    """
    if n_rings < 5 or n_azimuths < 14:
        raise ValueError(
            f"n_rings {n_rings}, n_azimuths {n_azimuths}: must be at least 5 and 14"
        )
    atoms = np.arange(1, N_REFERENCE_RINGS + 1) / N_REFERENCE_RINGS
    weights = np.ones(N_REFERENCE_RINGS) / N_REFERENCE_RINGS
    if n_rings < N_REFERENCE_RINGS:
        atoms, weights = _rule(atoms, weights, n_rings, with_rim=True)
    return np.sqrt(atoms), weights, _azimuths(n_azimuths)


def circle_sampling(n_terms: int) -> tuple[int, int]:
    """Return the numbers of rings and azimuths over a circle for so many terms."""
    return (N_CIRCLE_RINGS, N_CIRCLE_AZIMUTHS) if n_terms <= N_TERMS else DENSE_CIRCLE


@cache
def circle_nodes(
    n_rings: int = N_CIRCLE_RINGS,
    n_azimuths: int = N_CIRCLE_AZIMUTHS,
    n_terms: int = N_TERMS,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return nodes over a circle with uniform weight, and the projection of W.

    Rings, weights and azimuths are as in `stop_nodes`; the projection (n_terms, n)
    maps samples of W to coefficients.
    """
    legendre_nodes, legendre_weights = np.polynomial.legendre.leggauss(n_rings)
    rings, weights = np.sqrt((legendre_nodes + 1.0) / 2.0), legendre_weights / 2.0
    azimuths = _azimuths(n_azimuths)
    points = (azimuths[:, None, :] * rings[:, None]).reshape(-1, 2)
    share = np.tile(weights, n_azimuths)[:, None] / n_azimuths
    values = zernike_values(points[:, 0], points[:, 1], n_terms=n_terms)
    projection = (values * share).T
    return rings, weights, azimuths, np.ascontiguousarray(projection)
