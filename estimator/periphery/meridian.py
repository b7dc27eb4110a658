"""Extension of wavefronts from the horizontal meridian to the whole visual field.

Eyes were measured along the horizontal meridian.  About the symmetry axis of a nearly
rotationally symmetric eye (angle alpha), nodal aberration theory (Thompson, JOSA A 22,
2005) gives the dependence on direction H = h + iv: defocus is proportional to |H|²,
astigmatism to H² and coma to H.  A shift of the axis adds terms in H to the first two.
Terms that are even along the meridian therefore rotate with one multiple of the
azimuth, and odd terms with another.

For five eyes measured over +-40 x 25 deg (Polans 2015), this is as accurate as the mean
of the other four.  Separate vertical terms, fitted to those four, are no improvement.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

TERMS = tuple(range(3, 15))
"""OSA indices of the measured terms: orders 2 to 4."""

CIRCLE_MM = 2.0
"""Radius of the circle of the coefficients."""

KNOTS_DEG = (-40.0, -30.0, -20.0, -10.0, 10.0, 20.0, 30.0, 40.0)
"""Azimuths h of the knots, in a right eye."""

MEASURED_DEG = 40.0
"""Largest measured angle; beyond it, the slope decays exponentially."""

FADE_DEG = 15.0

_AZIMUTHAL_ORDERS = (
    # cosine term, sine term, azimuthal order of the even part and of the odd part
    (4, None, 0, 1),
    (5, 3, 2, 1),
    (8, 7, 0, 1),
    (9, 6, 2, 1),
    (12, None, 0, 1),
    (13, 11, 2, 1),
    (14, 10, 2, 1),
)


def meridian_weights(h_deg: ArrayLike) -> NDArray[np.float64]:
    """Return spline weights (..., 8) of the knots at azimuths (...), 0 on the axis."""
    h_deg = np.asarray(h_deg, dtype=np.float64)
    spline = _spline()
    inside = np.clip(h_deg, -MEASURED_DEG, MEASURED_DEG)
    beyond = h_deg - inside
    faded = np.sign(beyond) * FADE_DEG * -np.expm1(-np.abs(beyond) / FADE_DEG)
    weights: NDArray[np.float64] = spline(inside) + faded[..., None] * spline(inside, 1)
    return weights


@cache
def _spline() -> CubicSpline:
    nodes = np.array(sorted((*KNOTS_DEG, 0.0)))
    values = np.delete(np.eye(nodes.size), KNOTS_DEG.index(10.0), axis=1)
    return CubicSpline(nodes, values)


def field_terms(
    h_deg: ArrayLike, v_deg: ArrayLike, knots: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return terms (n, 12) at directions (n,) from those at the knots (12, 8).

    The result is the product of `field_matrix` and the knots, in a tenth of the time,
    because most of the matrix is zero.
    """
    h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
    angle_deg, azimuth = np.hypot(h_deg, v_deg), np.arctan2(v_deg, h_deg)
    right, left = (meridian_weights(a) @ knots.T for a in (angle_deg, -angle_deg))
    parts = 0.5 * (right + left), 0.5 * (right - left)
    found = np.zeros((h_deg.size, len(TERMS)))
    rotations = [(np.cos(k * azimuth), np.sin(k * azimuth)) for k in range(3)]
    for cosine, sine, *orders in _AZIMUTHAL_ORDERS:
        c, s = TERMS.index(cosine), None if sine is None else TERMS.index(sine)
        for part, order in zip(parts, orders, strict=True):
            cos, sin = rotations[order]
            found[:, c] += cos * part[:, c]
            if s is not None:
                found[:, c] -= sin * part[:, s]
                found[:, s] += cos * part[:, s] + sin * part[:, c]
    return found


def field_matrix(h_deg: ArrayLike, v_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix (n, 12, 12, 8) from terms at the knots to directions (n,)."""
    h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
    angle_deg, azimuth = np.hypot(h_deg, v_deg), np.arctan2(v_deg, h_deg)
    right, left = meridian_weights(angle_deg), meridian_weights(-angle_deg)
    matrix = np.zeros((h_deg.size, len(TERMS), len(TERMS), len(KNOTS_DEG)))
    for cosine, sine, *orders in _AZIMUTHAL_ORDERS:
        parts = (0.5 * (right + left), 0.5 * (right - left))
        for part, order in zip(parts, orders, strict=True):
            along = np.cos(order * azimuth)[:, None] * part
            across = np.sin(order * azimuth)[:, None] * part
            c = TERMS.index(cosine)
            matrix[:, c, c] += along
            if sine is not None:
                s = TERMS.index(sine)
                matrix[:, s, s] += along
                matrix[:, c, s] -= across
                matrix[:, s, c] += across
    return matrix
