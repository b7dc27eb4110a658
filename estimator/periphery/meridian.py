"""From wavefronts along the horizontal meridian to the whole visual field.

People were measured along the horizontal meridian.  A nearly round eye seen along an
axis of its own (angle alpha) has aberrations whose form around that axis is known
(nodal theory: Thompson, JOSA A 22, 2005): defocus goes with |H|², astigmatism with the
complex H², coma with H, H = h + iv; a shifted axis adds H to the first two.  So what is
even along the meridian turns with one multiple of the azimuth, what is odd with
another.  Judged by five people measured over +-40 x 25 deg (Polans 2015), it comes as
near as the mean of the other four, and vertical terms of its own, fitted to those four,
bring nothing.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

TERMS = tuple(range(3, 15))
"""OSA indices of what was measured: orders 2 to 4."""

CIRCLE_MM = 2.0
"""Radius of the circle that they are on."""

KNOTS_DEG = (-40.0, -30.0, -20.0, -10.0, 10.0, 20.0, 30.0, 40.0)
"""Azimuths h at which a right eye's change from the axis is held."""

MEASURED_DEG = 40.0
"""Farther out nothing was measured: the slope there fades away."""

FADE_DEG = 15.0

_SPINS = (
    # cosine and sine term, turns of what is even and of what is odd along the meridian
    (4, None, 0, 1),
    (5, 3, 2, 1),
    (8, 7, 0, 1),
    (9, 6, 2, 1),
    (12, None, 0, 1),
    (13, 11, 2, 1),
    (14, 10, 2, 1),
)


def meridian_weights(h_deg: ArrayLike) -> NDArray[np.float64]:
    """Weights (..., 8) of the knots at azimuths (...): a spline, 0 on the axis."""
    h_deg = np.asarray(h_deg, dtype=np.float64)
    spline = _spline()
    inside = np.clip(h_deg, -MEASURED_DEG, MEASURED_DEG)
    beyond = h_deg - inside
    faded = np.sign(beyond) * FADE_DEG * -np.expm1(-np.abs(beyond) / FADE_DEG)
    return spline(inside) + faded[..., None] * spline(inside, 1)


@cache
def _spline() -> CubicSpline:
    nodes = np.array(sorted((*KNOTS_DEG, 0.0)))
    values = np.delete(np.eye(nodes.size), KNOTS_DEG.index(10.0), axis=1)
    return CubicSpline(nodes, values)


def field_terms(
    h_deg: ArrayLike, v_deg: ArrayLike, knots: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Terms (n, 12) at directions (n,) from those at the knots (12, 8).

    The product of `field_matrix` and the knots in a tenth of its time, most of which
    would go into zeros.
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
    """Matrix (n, 12, 12, 8): terms at directions (n,) from terms at the knots."""
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
