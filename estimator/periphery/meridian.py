"""Extension of wavefronts along the horizontal meridian to the whole visual field.

People were measured along the horizontal meridian.  A nearly rotationally symmetric eye
seen along its own axis (angle alpha) has aberrations whose form around that axis is
known (nodal theory: Thompson, JOSA A 22, 2005): defocus is proportional to |H|²,
astigmatism to the complex H², coma to H, with H = h + iv; a shifted axis adds H to the
first two.  So terms even along the meridian rotate with one multiple of the azimuth,
odd ones with another.  For five people measured over +-40 x 25 deg (Polans 2015), this
is as accurate as the mean of the other four; separate vertical terms, fitted to those
four, bring no improvement.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

TERMS = tuple(range(3, 15))
"""OSA indices of the measured terms: orders 2 to 4."""

CIRCLE_MM = 2.0
"""Radius of the circle on which they are given."""

KNOTS_DEG = (-40.0, -30.0, -20.0, -10.0, 10.0, 20.0, 30.0, 40.0)
"""Azimuths h of the knots at which a right eye's change from the axis is stored."""

MEASURED_DEG = 40.0
"""Largest measured angle; the slope there fades beyond it."""

FADE_DEG = 15.0

_SPINS = (
    # cosine and sine term, multiples of the azimuth of the parts even and odd along it
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

    This is the product of `field_matrix` and the knots, in a tenth of the time: most of
    the matrix is zero.
    """
    h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
    angle_deg, azimuth = np.hypot(h_deg, v_deg), np.arctan2(v_deg, h_deg)
    right, left = (meridian_weights(a) @ knots.T for a in (angle_deg, -angle_deg))
    parts = 0.5 * (right + left), 0.5 * (right - left)
    found = np.zeros((h_deg.size, len(TERMS)))
    turned = [(np.cos(k * azimuth), np.sin(k * azimuth)) for k in range(3)]
    for cosine, sine, *turns in _SPINS:
        c, s = TERMS.index(cosine), None if sine is None else TERMS.index(sine)
        for part, turn in zip(parts, turns, strict=True):
            cos, sin = turned[turn]
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
    for cosine, sine, *turns in _SPINS:
        parts = (0.5 * (right + left), 0.5 * (right - left))
        for part, turn in zip(parts, turns, strict=True):
            along = np.cos(turn * azimuth)[:, None] * part
            across = np.sin(turn * azimuth)[:, None] * part
            c = TERMS.index(cosine)
            matrix[:, c, c] += along
            if sine is not None:
                s = TERMS.index(sine)
                matrix[:, s, s] += along
                matrix[:, c, s] -= across
                matrix[:, s, c] += across
    return matrix
