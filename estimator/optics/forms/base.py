"""Compiled: sag of a biconic, and of offset terms."""

import math

from numba import njit

from estimator.optics.packed import CONIC, CURVATURE_X, CURVATURE_Y, OFFSET

_ORDER = 6


@njit(cache=True, nogil=True, error_model="numpy")
def biconic_sag(packed, i, x, y, out):
    """Write sag and gradient (z, zx, zy) of a biconic; return False if undefined."""
    cx, cy, k1 = packed[i, CURVATURE_X], packed[i, CURVATURE_Y], 1.0 + packed[i, CONIC]
    radicand = 1.0 - k1 * (cx * cx * x * x + cy * cy * y * y)
    inside = radicand > 0.0
    root = math.sqrt(max(radicand, 1e-12))
    numerator = cx * x * x + cy * y * y
    inverse = 1.0 / (1.0 + root)
    common = numerator * k1 * inverse * inverse / root
    out[0] = numerator * inverse
    out[1] = x * cx * (2.0 * inverse + common * cx)
    out[2] = y * cy * (2.0 * inverse + common * cy)
    return inside


@njit(cache=True, nogil=True, error_model="numpy")
def add_offset(packed, i, x, y, out):
    """Add the offset polynomial and its gradient to (z, zx, zy)."""
    z, zx, zy, t = 0.0, 0.0, 0.0, OFFSET
    for b in range(_ORDER, -1, -1):
        q, dq = 0.0, 0.0
        for _ in range(_ORDER - b, -1, -1):
            dq = dq * x + q
            q = q * x + packed[i, t]
            t += 1
        zy = zy * y + z
        z = z * y + q
        zx = zx * y + dq
    out[0] += z
    out[1] += zx
    out[2] += zy
