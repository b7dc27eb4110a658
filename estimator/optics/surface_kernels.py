"""Compiled: intersection of a ray with one packed surface, and refraction there.

A ray is an array of 8: position (mm), direction cosines, optical path length (mm) and
distance from the last refracting surface (mm).  The functions work in float64, release
the GIL and start no threads.  `packed` describes the arrays.
"""

import math

from numba import njit

from estimator.optics.forms import FORMS
from estimator.optics.forms.base import add_offset, biconic_sag
from estimator.optics.packed import (
    CLEAR_SQUARED,
    CONIC,
    CURVATURE_X,
    CURVATURE_Y,
    FIRST_FORM,
    FORM,
    HAS_OFFSET,
    IS_TURNED,
    REVOLVED,
    ROTATION,
    VERTEX,
    WITH_OFFSET,
)

TRACED = 0
MISSED = 1  # no intersection with the sheet through the vertex
CLIPPED = 2  # outside the clear radius
TOTAL_REFLECTION = 3
OUT_OF_ORDER = 4  # surfaces cross: the next one lies behind the ray
NOT_CONVERGED = 5

RAY_SIZE = 8

ORDER_TOLERANCE_MM = 1e-9

_ORDER = 6
_MAX_STEPS = 30
_STEP_TOLERANCE_MM = 1e-13
_INFINITE = math.inf


@njit(cache=True, nogil=True, error_model="numpy")
def copy_values(source, target):
    """Copy (n,) numbers.

    A slice assignment takes 3 s longer to compile, for numba's check of the shapes.
    """
    for i in range(target.shape[0]):
        target[i] = source[i]


@njit(nogil=True, error_model="numpy")
def _no_sag(_packed, _i, _x, _y, out):
    """Return an error for an unknown form, which only a stale numba cache has."""
    out[:] = math.nan
    return False


def _chained(code, first, rest):
    """Return a compiled function that calls ``first`` for a form code, else ``rest``.

    It is not cached: numba's key of a closure includes the functions it captures, which
    differ in every process.  The cached loops that call it contain its code.
    """

    @njit(nogil=True, error_model="numpy")
    def sag(packed, i, x, y, out):
        if packed[i, FORM] == code:
            return first(packed, i, x, y, out)
        return rest(packed, i, x, y, out)

    return sag


_sag_of_table = _no_sag
for _place, _form in reversed(list(enumerate(FORMS))):
    _sag_of_table = _chained(FIRST_FORM + _place, _form.sag, _sag_of_table)


@njit(cache=True, nogil=True, error_model="numpy")
def _sag(packed, i, x, y, out):
    """Write the sag and its gradient (z, zx, zy) of a form without a closed solution.

    Return False outside the domain of the form.
    """
    form = packed[i, FORM]
    if form < FIRST_FORM:
        inside = biconic_sag(packed, i, x, y, out)
        has_offset = form == WITH_OFFSET
    else:
        inside = _sag_of_table(packed, i, x, y, out)
        has_offset = packed[i, HAS_OFFSET] != 0.0
    if has_offset:
        add_offset(packed, i, x, y, out)
    return inside


@njit(cache=True, nogil=True, error_model="numpy")
def _conic_distance(c, k, x, y, z, dx, dy, dz):
    """Return the distance to a conic of revolution; nan without an intersection.

    Of the two roots, it is the one that becomes that of the plane as the curvature
    vanishes.  For a ray inside a closed retina, this is the farther one.
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
    """Return the distance by Newton's method; nan outside, inf if not converged."""
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
def to_surface_axes(packed, i, x, y, z):
    """Rotate a vector from the eye's axes to those of a surface."""
    return (
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


@njit(cache=True, nogil=True, error_model="numpy")
def to_eye_axes(packed, i, x, y, z):
    """Rotate a vector from the axes of a surface to the eye's."""
    return (
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


@njit(cache=True, nogil=True, error_model="numpy")
def straight_distance(packed, i, ray, sag):
    """Return the distance of a ray to a surface along a straight line.

    It is nan if the ray misses the surface and inf if the iteration does not converge.
    """
    x, y, z = (
        ray[0] - packed[i, VERTEX],
        ray[1] - packed[i, VERTEX + 1],
        ray[2] - packed[i, VERTEX + 2],
    )
    dx, dy, dz = ray[3], ray[4], ray[5]
    if packed[i, IS_TURNED] != 0.0:
        x, y, z = to_surface_axes(packed, i, x, y, z)
        dx, dy, dz = to_surface_axes(packed, i, dx, dy, dz)
    if packed[i, FORM] == REVOLVED:
        c, k = packed[i, CURVATURE_X], packed[i, CONIC]
        return _conic_distance(c, k, x, y, z, dx, dy, dz)
    return _iterated_distance(packed, i, x, y, z, dx, dy, dz, sag)


@njit(cache=True, nogil=True, error_model="numpy")
def cross_surface(packed, i, ray, n_from, n_to, sag):
    """Trace a ray to a surface, refract it and return its status.

    Equal indices leave the direction unchanged.  ``sag`` is a scratch array of 3.
    """
    x, y, z = (
        ray[0] - packed[i, VERTEX],
        ray[1] - packed[i, VERTEX + 1],
        ray[2] - packed[i, VERTEX + 2],
    )
    dx, dy, dz = ray[3], ray[4], ray[5]
    rotated = packed[i, IS_TURNED] != 0.0
    if rotated:
        x, y, z = to_surface_axes(packed, i, x, y, z)
        dx, dy, dz = to_surface_axes(packed, i, dx, dy, dz)
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
    if ray[7] < -ORDER_TOLERANCE_MM:
        return OUT_OF_ORDER
    ray[7] = 0.0
    if n_from != n_to:
        inverse = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz)
        ratio = n_from / n_to
        cosine = (dx * gx + dy * gy + dz * gz) * inverse
        squared = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        if squared < 0.0:
            return TOTAL_REFLECTION
        normal_factor = (
            math.copysign(math.sqrt(squared), cosine) - ratio * cosine
        ) * inverse
        dx, dy, dz = (
            ratio * dx + normal_factor * gx,
            ratio * dy + normal_factor * gy,
            ratio * dz + normal_factor * gz,
        )
    if rotated:
        x, y, z = to_eye_axes(packed, i, x, y, z)
        dx, dy, dz = to_eye_axes(packed, i, dx, dy, dz)
    ray[0], ray[1], ray[2] = (
        x + packed[i, VERTEX],
        y + packed[i, VERTEX + 1],
        z + packed[i, VERTEX + 2],
    )
    ray[3], ray[4], ray[5] = dx, dy, dz
    return TRACED
