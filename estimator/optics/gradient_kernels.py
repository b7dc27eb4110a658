"""Compiled: rays through gradient-index media.

With dt = ds / n, a ray obeys r'' = n grad n, where r' is n times its direction (Sharma,
Kumar & Ghatak 1982), and its optical path S obeys S' = n².  Albrecht's Runge-Kutta-
Nystrom method integrates these equations to order 6 with five evaluations per step.

The number of steps per medium is fixed, so that results change smoothly from ray to
ray.  The length of a step is the straight distance to the next surface, divided by the
number of remaining steps.  Newton's method ends the last step on the surface.

The integration is compiled for each gradient: choosing the gradient at every evaluation
would triple the time.
"""

import math

import numpy as np
from numba import njit

from estimator.optics.gradients import INDEX_FUNCTIONS
from estimator.optics.packed import (
    GRADIENT,
    GRADIENT_FORM,
    GRADIENT_NUMBERS,
    GRADIENT_STEPS,
    IS_TURNED,
    VERTEX,
)
from estimator.optics.surface_kernels import (
    NOT_CONVERGED,
    ORDER_TOLERANCE_MM,
    OUT_OF_ORDER,
    TRACED,
    straight_distance,
    to_eye_axes,
    to_surface_axes,
)

_PARAXIAL_MM = 1e-6
_PARAXIAL_STEPS = 200
_LAST_STEPS = 12
_TAYLOR_MM = 1e-4
"""Largest distance to the surface that a Taylor step of order 2 covers to 1e-14 mm."""


@njit(cache=True, nogil=True, error_model="numpy")
def _to_medium_axes(packed, i, ray):
    """Return point and direction in the axes of surface ``i``, as one tuple."""
    x, y, z = (
        ray[0] - packed[i, VERTEX],
        ray[1] - packed[i, VERTEX + 1],
        ray[2] - packed[i, VERTEX + 2],
    )
    dx, dy, dz = ray[3], ray[4], ray[5]
    if packed[i, IS_TURNED] != 0.0:
        x, y, z = to_surface_axes(packed, i, x, y, z)
        dx, dy, dz = to_surface_axes(packed, i, dx, dy, dz)
    return x, y, z, dx, dy, dz


@njit(cache=True, nogil=True, error_model="numpy")
def _distance_left(packed, i, target, state, ray, sag):
    """Return the straight distance to surface ``target``, and the index n.

    ``state`` is (point, n times the direction) in the axes of surface ``i``.  Point and
    direction in the eye's axes are written to ``ray``.  If the straight line misses the
    surface, the distance is that to the plane through its vertex.
    """
    x, y, z, px, py, pz = state
    if packed[i, IS_TURNED] != 0.0:
        x, y, z = to_eye_axes(packed, i, x, y, z)
        px, py, pz = to_eye_axes(packed, i, px, py, pz)
    n = math.sqrt(px * px + py * py + pz * pz)
    ray[0], ray[1], ray[2] = (
        x + packed[i, VERTEX],
        y + packed[i, VERTEX + 1],
        z + packed[i, VERTEX + 2],
    )
    ray[3], ray[4], ray[5] = px / n, py / n, pz / n
    distance = straight_distance(packed, target, ray, sag)
    if not abs(distance) < math.inf:
        distance = (packed[target, VERTEX + 2] - ray[2]) / ray[5]
    return distance, n


def _travel_with(index):
    """Return the compiled integration through a medium with this index function.

    See `gradients` for the signature.  It is not cached (see `surface_kernels`).
    """

    @njit(nogil=True, error_model="numpy")
    def step(media, start, h, state, first):
        """Return the state after a step, and the optical path of the step.

        ``first`` is the value of the index function at the state.
        """
        x, y, z, px, py, pz = state
        qa, ax, ay, az = first
        g = h / 32.0
        qb, bx, by, bz = index(
            media,
            start,
            x + h * (0.25 * px + g * ax),
            y + h * (0.25 * py + g * ay),
            z + h * (0.25 * pz + g * az),
        )
        g = h / 24.0
        qc, cx, cy, cz = index(
            media,
            start,
            x + h * (0.5 * px + g * (4.0 * bx - ax)),
            y + h * (0.5 * py + g * (4.0 * by - ay)),
            z + h * (0.5 * pz + g * (4.0 * bz - az)),
        )
        g = h / 32.0
        qd, dx, dy, dz = index(
            media,
            start,
            x + h * (0.75 * px + g * (3.0 * ax + 4.0 * bx + 2.0 * cx)),
            y + h * (0.75 * py + g * (3.0 * ay + 4.0 * by + 2.0 * cy)),
            z + h * (0.75 * pz + g * (3.0 * az + 4.0 * bz + 2.0 * cz)),
        )
        g = h / 14.0
        qe, ex, ey, ez = index(
            media,
            start,
            x + h * (px + g * (6.0 * bx - cx + 2.0 * dx)),
            y + h * (py + g * (6.0 * by - cy + 2.0 * dy)),
            z + h * (pz + g * (6.0 * bz - cz + 2.0 * dz)),
        )
        g = h / 90.0
        after = (
            x + h * (px + g * (7.0 * ax + 24.0 * bx + 6.0 * cx + 8.0 * dx)),
            y + h * (py + g * (7.0 * ay + 24.0 * by + 6.0 * cy + 8.0 * dy)),
            z + h * (pz + g * (7.0 * az + 24.0 * bz + 6.0 * cz + 8.0 * dz)),
            px + g * (7.0 * (ax + ex) + 32.0 * (bx + dx) + 12.0 * cx),
            py + g * (7.0 * (ay + ey) + 32.0 * (by + dy) + 12.0 * cy),
            pz + g * (7.0 * (az + ez) + 32.0 * (bz + dz) + 12.0 * cz),
        )
        return after, g * (7.0 * (qa + qe) + 32.0 * (qb + qd) + 12.0 * qc)

    @njit(nogil=True, error_model="numpy")
    def taylor(h, state, first):
        """Return the state after a small step, and the optical path of the step."""
        x, y, z, px, py, pz = state
        q, ax, ay, az = first
        after = (
            x + h * (px + 0.5 * h * ax),
            y + h * (py + 0.5 * h * ay),
            z + h * (pz + 0.5 * h * az),
            px + h * ax,
            py + h * ay,
            pz + h * az,
        )
        return after, h * (q + h * (ax * px + ay * py + az * pz))

    @njit(nogil=True, error_model="numpy")
    def travel(packed, media, i, target, ray, sag):
        first = int(packed[i, GRADIENT])
        n_steps, start = int(media[first + GRADIENT_STEPS]), first + GRADIENT_NUMBERS
        path = ray[6]
        x, y, z, dx, dy, dz = _to_medium_axes(packed, i, ray)
        here = index(media, start, x, y, z)
        n = math.sqrt(here[0])
        state = (x, y, z, n * dx, n * dy, n * dz)
        distance, n = _distance_left(packed, i, target, state, ray, sag)
        s, tries, h = 0, 0, 0.0
        while tries < _LAST_STEPS:
            is_last = s == n_steps - 1
            if tries == 0:
                if distance < -ORDER_TOLERANCE_MM:
                    return OUT_OF_ORDER
                h = distance / (n * (n_steps - s))
                if is_last:
                    # Predicting the ray's curvature saves a repetition of the step.
                    bent, more = taylor(h, state, here)
                    distance, n = _distance_left(packed, i, target, bent, ray, sag)
                    h += distance / n
            after, more = step(media, start, h, state, here)
            distance, n = _distance_left(packed, i, target, after, ray, sag)
            if is_last and not abs(distance) < _TAYLOR_MM:
                h += distance / n
                tries += 1
                continue
            state, path = after, path + more
            here = index(media, start, state[0], state[1], state[2])
            if is_last:
                state, more = taylor(distance / n, state, here)
                _distance_left(packed, i, target, state, ray, sag)
                ray[6] = path + more
                return TRACED
            s += 1
        return NOT_CONVERGED

    return travel


@njit(nogil=True, error_model="numpy")
def _no_travel(_packed, _media, _i, _target, _ray, _sag):
    """Return an error for an unknown gradient, which only a stale numba cache has."""
    return NOT_CONVERGED


@njit(nogil=True, error_model="numpy")
def _no_index(_media, _first, _x, _y, _z):
    return math.nan, math.nan, math.nan, math.nan


def _chained_travel(code, this, rest):
    @njit(nogil=True, error_model="numpy")
    def travel(packed, media, i, target, ray, sag):
        if media[int(packed[i, GRADIENT]) + GRADIENT_FORM] == code:
            return this(packed, media, i, target, ray, sag)
        return rest(packed, media, i, target, ray, sag)

    return travel


def _chained_index(code, this, rest):
    @njit(nogil=True, error_model="numpy")
    def index(media, first, x, y, z):
        if media[first + GRADIENT_FORM] == code:
            return this(media, first + GRADIENT_NUMBERS, x, y, z)
        return rest(media, first, x, y, z)

    return index


_travel, _index = _no_travel, _no_index
for _code, _function in reversed(list(enumerate(INDEX_FUNCTIONS))):
    _travel = _chained_travel(_code, _travel_with(_function), _travel)
    _index = _chained_index(_code, _function, _index)


@njit(cache=True, nogil=True, error_model="numpy")
def travel(packed, media, i, target, ray, sag):
    """Trace a ray through the medium behind surface ``i`` to surface ``target``.

    On success the ray is on the surface, not yet refracted there.
    """
    return _travel(packed, media, i, target, ray, sag)


@njit(cache=True, nogil=True, error_model="numpy")
def index_at(packed, media, i, ray):
    """Return the index of the medium behind surface ``i`` (-1: in front) at the ray."""
    if i < 0 or packed[i, GRADIENT] == 0.0:
        return media[i + 1]
    x, y, z, _, _, _ = _to_medium_axes(packed, i, ray)
    return math.sqrt(_index(media, int(packed[i, GRADIENT]), x, y, z)[0])


@njit(cache=True, nogil=True, error_model="numpy")
def axial_index(media, first, z):
    """Return the index, at depth ``z`` on the axis, of the gradient at ``first``."""
    return math.sqrt(_index(media, first, 0.0, 0.0, z)[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _paraxial_rate(media, first, z, matrix, rate):
    """Write the derivative by depth of a matrix on (height, index * slope)."""
    squared, slope, _, _ = _index(media, first, _PARAXIAL_MM, 0.0, z)
    n = math.sqrt(squared)
    bend = slope / (n * _PARAXIAL_MM)
    for k in range(2):
        rate[0, k] = matrix[1, k] / n
        rate[1, k] = bend * matrix[0, k]


@njit(cache=True, nogil=True, error_model="numpy")
def paraxial_gap(media, first, from_z, to_z, matrix):
    """Apply the first-order transfer through a gradient to ``matrix`` (2, 2).

    The matrix acts on (height h, index * slope p): dh/dz = p / n(z), dp/dz = h d²n/dr².
    With Runge-Kutta steps of order 4, the relative error of the power is 1e-12 for
    published models of the crystalline lens.
    """
    rates, at = np.empty((4, 2, 2)), np.empty((2, 2))
    h = (to_z - from_z) / _PARAXIAL_STEPS
    for s in range(_PARAXIAL_STEPS):
        z = from_z + s * h
        _paraxial_rate(media, first, z, matrix, rates[0])
        for stage in range(1, 4):
            share = h if stage == 3 else 0.5 * h
            at[:] = matrix + share * rates[stage - 1]
            _paraxial_rate(media, first, z + share, at, rates[stage])
        matrix += h / 6.0 * (rates[0] + 2.0 * rates[1] + 2.0 * rates[2] + rates[3])
