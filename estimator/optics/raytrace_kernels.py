"""Compiled: one ray through packed surfaces, with intersection, refraction and status.

A ray is an array of 8: position (mm), direction cosines, optical path (mm), and the
distance since the last refracting surface (mm).  Everything is float64, releases the
GIL and starts no threads.  The packed form is described in `surfaces.py`.
"""

import math

import numpy as np
from numba import njit

from estimator.optics.surfaces import (
    CLEAR_SQUARED,
    CONIC,
    CURVATURE_X,
    CURVATURE_Y,
    FORM,
    IS_TURNED,
    N_BEFORE_STOP,
    OFFSET,
    REVOLVED,
    ROTATION,
    STOP_Z,
    VERTEX,
    WITH_OFFSET,
)

TRACED = 0
MISSED = 1  # no intersection with the surface's vertex sheet
CLIPPED = 2  # outside the clear radius
TOTAL_REFLECTION = 3
OUT_OF_ORDER = 4  # surfaces cross there: the next one lies behind the ray
NOT_CONVERGED = 5

RAY_SIZE = 8

_ORDER = 6
_MAX_STEPS = 30
_STEP_TOLERANCE_MM = 1e-13
_ORDER_TOLERANCE_MM = 1e-9
_INFINITE = math.inf


@njit(cache=True, nogil=True, error_model="numpy")
def put(source, to):
    """Copy (n,) numbers; a slice assignment takes 3 s longer to compile.

    (Numba compiles an error message in case the shapes differ.)
    """
    for i in range(to.shape[0]):
        to[i] = source[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _sag(packed, i, x, y, out):
    """Write sag and gradient (z, zx, zy) of an iterated form; return False outside."""
    cx, cy, k1 = packed[i, CURVATURE_X], packed[i, CURVATURE_Y], 1.0 + packed[i, CONIC]
    radicand = 1.0 - k1 * (cx * cx * x * x + cy * cy * y * y)
    inside = radicand > 0.0
    root = math.sqrt(max(radicand, 1e-12))
    top = cx * x * x + cy * y * y
    below = 1.0 / (1.0 + root)
    common = top * k1 * below * below / root
    out[0] = top * below
    out[1] = x * cx * (2.0 * below + common * cx)
    out[2] = y * cy * (2.0 * below + common * cy)
    if packed[i, FORM] == WITH_OFFSET:
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
    return inside


@njit(cache=True, nogil=True, error_model="numpy")
def _conic_distance(c, k, x, y, z, dx, dy, dz):
    """Return the distance to the vertex sheet of a conic of revolution; nan if none.

    Of the two roots, the one that tends to the plane's as the curvature vanishes; for a
    ray inside a closed retina it is the far one.
    """
    a = c * (1.0 + k * dz * dz)
    b = c * (x * dx + y * dy + (1.0 + k) * z * dz) - dz
    d = c * (x * x + y * y + (1.0 + k) * z * z) - 2.0 * z
    discriminant = b * b - a * d
    if discriminant < 0.0:
        return math.nan
    root = math.sqrt(discriminant)
    return d / (root - b) if dz > 0.0 else -d / (root + b)


@njit(cache=True, nogil=True, error_model="numpy")
def _iterated_distance(packed, i, x, y, z, dx, dy, dz, sag):
    """Return the distance to an iterated form; nan outside, inf if not converged."""
    c = 0.5 * (packed[i, CURVATURE_X] + packed[i, CURVATURE_Y])
    t = _conic_distance(c, packed[i, CONIC], x, y, z, dx, dy, dz)
    if t != t:
        t = -z / dz
    for _ in range(_MAX_STEPS):
        inside = _sag(packed, i, x + t * dx, y + t * dy, sag)
        step = (z + t * dz - sag[0]) / (dz - sag[1] * dx - sag[2] * dy)
        t -= step
        if abs(step) < _STEP_TOLERANCE_MM * (1.0 + abs(t)):
            return t if inside else math.nan
        if not abs(step) < 1e3:
            return math.nan
    return _INFINITE


@njit(cache=True, nogil=True, error_model="numpy")
def cross_surface(packed, i, ray, n_from, n_to, sag):
    """Trace a ray to one surface, refract it there and return its status.

    Equal indices leave its direction unchanged.  ``sag`` is a scratch array of 3.
    """
    x, y, z = (
        ray[0] - packed[i, VERTEX],
        ray[1] - packed[i, VERTEX + 1],
        ray[2] - packed[i, VERTEX + 2],
    )
    dx, dy, dz = ray[3], ray[4], ray[5]
    turned = packed[i, IS_TURNED] != 0.0
    if turned:
        x, y, z = (
            packed[i, ROTATION] * x
            + packed[i, ROTATION + 3] * y
            + packed[i, ROTATION + 6] * z,
            packed[i, ROTATION + 1] * x
            + packed[i, ROTATION + 4] * y
            + packed[i, ROTATION + 7] * z,
            packed[i, ROTATION + 2] * x
            + packed[i, ROTATION + 5] * y
            + packed[i, ROTATION + 8] * z,
        )
        dx, dy, dz = (
            packed[i, ROTATION] * dx
            + packed[i, ROTATION + 3] * dy
            + packed[i, ROTATION + 6] * dz,
            packed[i, ROTATION + 1] * dx
            + packed[i, ROTATION + 4] * dy
            + packed[i, ROTATION + 7] * dz,
            packed[i, ROTATION + 2] * dx
            + packed[i, ROTATION + 5] * dy
            + packed[i, ROTATION + 8] * dz,
        )
    revolved = packed[i, FORM] == REVOLVED
    c, k = packed[i, CURVATURE_X], packed[i, CONIC]
    if revolved:
        t = _conic_distance(c, k, x, y, z, dx, dy, dz)
    else:
        t = _iterated_distance(packed, i, x, y, z, dx, dy, dz, sag)
    if not t < _INFINITE:
        return NOT_CONVERGED if t == _INFINITE else MISSED
    x, y, z = x + t * dx, y + t * dy, z + t * dz
    if revolved:
        gx, gy, gz = -c * x, -c * y, 1.0 - c * (1.0 + k) * z
        if gz <= 0.0 and n_from != n_to:
            return MISSED
    else:
        gx, gy, gz = -sag[1], -sag[2], 1.0
    if x * x + y * y > packed[i, CLEAR_SQUARED]:
        return CLIPPED
    ray[6] += n_from * t
    ray[7] += t
    if ray[7] < -_ORDER_TOLERANCE_MM:
        return OUT_OF_ORDER
    ray[7] = 0.0
    if n_from != n_to:
        inverse = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz)
        ratio = n_from / n_to
        cosine = (dx * gx + dy * gy + dz * gz) * inverse
        squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        if squared < 0.0:
            return TOTAL_REFLECTION
        push = (math.copysign(math.sqrt(squared), cosine) - ratio * cosine) * inverse
        dx, dy, dz = (
            ratio * dx + push * gx,
            ratio * dy + push * gy,
            ratio * dz + push * gz,
        )
    if turned:
        x, y, z = (
            packed[i, ROTATION] * x
            + packed[i, ROTATION + 1] * y
            + packed[i, ROTATION + 2] * z,
            packed[i, ROTATION + 3] * x
            + packed[i, ROTATION + 4] * y
            + packed[i, ROTATION + 5] * z,
            packed[i, ROTATION + 6] * x
            + packed[i, ROTATION + 7] * y
            + packed[i, ROTATION + 8] * z,
        )
        dx, dy, dz = (
            packed[i, ROTATION] * dx
            + packed[i, ROTATION + 1] * dy
            + packed[i, ROTATION + 2] * dz,
            packed[i, ROTATION + 3] * dx
            + packed[i, ROTATION + 4] * dy
            + packed[i, ROTATION + 5] * dz,
            packed[i, ROTATION + 6] * dx
            + packed[i, ROTATION + 7] * dy
            + packed[i, ROTATION + 8] * dz,
        )
    ray[0], ray[1], ray[2] = (
        x + packed[i, VERTEX],
        y + packed[i, VERTEX + 1],
        z + packed[i, VERTEX + 2],
    )
    ray[3], ray[4], ray[5] = dx, dy, dz
    return TRACED


@njit(cache=True, nogil=True, error_model="numpy")
def to_stop(packed, ray, n):
    """Trace a ray to the stop plane, also backward (the plane may cut the lens)."""
    t = (packed[-1, STOP_Z] - ray[2]) / ray[5]
    ray[0] += t * ray[3]
    ray[1] += t * ray[4]
    ray[2] = packed[-1, STOP_Z]
    ray[6] += n * t
    ray[7] += t


@njit(cache=True, nogil=True, error_model="numpy")
def inward(packed, indices, ray, first, last, sag):
    """Trace a ray forward through surfaces first to last - 1; return its status."""
    for i in range(first, last):
        status = cross_surface(packed, i, ray, indices[i], indices[i + 1], sag)
        if status != TRACED:
            return status
    return TRACED


@njit(cache=True, nogil=True, error_model="numpy")
def outward(packed, indices, ray, first, last, sag):
    """Trace a ray in reverse through surfaces last - 1 to first; return its status."""
    for i in range(last - 1, first - 1, -1):
        status = cross_surface(packed, i, ray, indices[i + 1], indices[i], sag)
        if status != TRACED:
            return status
    return TRACED


@njit(cache=True, nogil=True, error_model="numpy")
def to_retina(packed, indices, ray, sag):
    """Trace a ray from the last surface straight to the retina."""
    n = indices[packed.shape[0] - 1]
    return cross_surface(packed, packed.shape[0] - 1, ray, n, n, sag)


@njit(cache=True, nogil=True, error_model="numpy")
def trace_bundle(packed, indices, rays, reverse, points, directions, paths, status):
    """Trace rays through every element and record each; see `raytrace.trace_rays`."""
    n_surfaces = packed.shape[0] - 1
    n_before = int(packed[n_surfaces, N_BEFORE_STOP])
    sag = np.empty(3)
    ray = np.empty(RAY_SIZE)
    for r in range(rays.shape[0]):
        put(rays[r], ray[:6])
        ray[6:] = 0.0
        status[r] = TRACED
        for step in range(n_surfaces + 2):
            # Elements in the order light meets them: surfaces and stop, then retina.
            e = n_surfaces + 1 - step if reverse else step
            if reverse and step == 0:
                code = TRACED  # the ray starts on the retina
            elif e == n_before:
                to_stop(packed, ray, indices[n_before])
                code = TRACED
            elif e == n_surfaces + 1:
                code = to_retina(packed, indices, ray, sag)
            else:
                i = e if e < n_before else e - 1
                inner, outer = indices[i + 1], indices[i]
                if reverse:
                    code = cross_surface(packed, i, ray, inner, outer, sag)
                else:
                    code = cross_surface(packed, i, ray, outer, inner, sag)
            if code != TRACED:
                status[r] = code
                if reverse:
                    points[r, : e + 1] = math.nan
                    directions[r, : e + 1] = math.nan
                    paths[r, : e + 1] = math.nan
                else:
                    points[r, e:] = math.nan
                    directions[r, e:] = math.nan
                    paths[r, e:] = math.nan
                break
            put(ray, points[r, e])
            put(ray[3:], directions[r, e])
            paths[r, e] = ray[6]
