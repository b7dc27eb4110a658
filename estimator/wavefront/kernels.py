"""Compiled: chief ray, ray aiming and wavefront samples of one eye and field.

The chief ray is traced from air through the center of the stop to the retina.  From its
retinal point, rays are traced out of the eye (Algorithm 1 of the paper).  All rays have
the same origin, so their optical paths to a plane outside sample the eikonal of one
wave: an aiming error moves a sample, but its value is exact at the new position.
"""

import math

import numpy as np
from numba import njit

from estimator.optics.packed import (
    CURVATURE_X,
    CURVATURE_Y,
    N_BEFORE_STOP,
    STOP_Z,
    VERTEX,
)
from estimator.optics.raytrace_kernels import inward, outward, to_retina, to_stop
from estimator.optics.surface_kernels import (
    NOT_CONVERGED,
    RAY_SIZE,
    TRACED,
    copy_values,
)

UM_PER_MM = 1000.0

_START_MM = 30.0  # in front of the entrance pupil
_CHIEF_TOLERANCE_MM = 1e-12
_CHIEF_ACCEPTED_MM = 1e-9  # where rounding stops Newton earlier
_CHIEF_STEPS = 40
_DIFFERENCE_MM = 1e-6
_DIFFERENCE_COSINE = 1e-6
_AIM_STEPS = 25
_HALVINGS = 12
_SMALLEST_SHARE = 1e-3
_CONTINUATION_STEPS = 10
_FIRST = np.int64(0)
"""First surface; a plain 0 has a different type and would compile everything twice."""

# --- columns of one sample of the wavefront ---
X, Y, W, SLOPE_X, SLOPE_Y = 0, 1, 2, 3, 4
N_SAMPLE = 5


@njit(cache=True, nogil=True, error_model="numpy")
def field_axes(h_rad, v_rad, axes):
    """Write ex, ey and u, the unit vector to the source, to the rows of ``axes``."""
    ex, ey, u = axes[0], axes[1], axes[2]
    u[0] = math.sin(h_rad) * math.cos(v_rad)
    u[1] = math.sin(v_rad)
    u[2] = -math.cos(h_rad) * math.cos(v_rad)
    length = math.hypot(u[0], u[2])
    ex[0], ex[1], ex[2] = -u[2] / length, 0.0, u[0] / length
    ey[0] = ex[1] * u[2] - ex[2] * u[1]
    ey[1] = ex[2] * u[0] - ex[0] * u[2]
    ey[2] = ex[0] * u[1] - ex[1] * u[0]


@njit(cache=True, nogil=True, error_model="numpy")
def entrance_pupil_z(packed, indices):
    """Return z of the paraxial entrance pupil, mm, from mean curvatures."""
    n_before = int(packed[-1, N_BEFORE_STOP])
    z, height, slope = packed[-1, STOP_Z], 0.0, 1.0 / indices[n_before]
    for i in range(n_before - 1, -1, -1):
        row = packed[i]
        height += slope * (row[VERTEX + 2] - z)
        z = row[VERTEX + 2]
        curvature = 0.5 * (row[CURVATURE_X] + row[CURVATURE_Y])
        power = (indices[i + 1] - indices[i]) * curvature
        slope = (indices[i + 1] * slope + power * height) / indices[i]
    return z - height / slope


@njit(cache=True, nogil=True, error_model="numpy")
def _chief_shot(packed, indices, axes, base_z, a, b, ray, sag):
    """Trace a parallel ray from (a, b) in the entrance pupil's plane to the stop."""
    for i in range(3):
        ray[i] = a * axes[0, i] + b * axes[1, i] + _START_MM * axes[2, i]
        ray[3 + i] = -axes[2, i]
    ray[2] += base_z
    ray[6], ray[7] = 0.0, 0.0
    n_before = int(packed[-1, N_BEFORE_STOP])
    status = inward(packed, indices, ray, _FIRST, n_before, sag)
    if status == TRACED:
        to_stop(packed, ray, indices[n_before])
    return status


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_chief(packed, indices, axes, base_z, start, ray, sag):
    """Aim the chief ray at the center of the stop by Newton's method.

    ``start`` (2,) is the initial value and receives the solution.
    """
    a, b = start[0], start[1]
    status = _chief_shot(packed, indices, axes, base_z, a, b, ray, sag)
    if status != TRACED:
        return status
    x, y = ray[0], ray[1]
    h = _DIFFERENCE_MM
    for _ in range(_CHIEF_STEPS):
        miss = math.hypot(x, y)
        if miss < _CHIEF_TOLERANCE_MM:
            break
        xa, ya, xb, yb = 0.0, 0.0, 0.0, 0.0
        for k in range(2):
            ta, tb = (a + h, b) if k == 0 else (a, b + h)
            status = _chief_shot(packed, indices, axes, base_z, ta, tb, ray, sag)
            if status != TRACED:
                return status
            if k == 0:
                xa, ya = (ray[0] - x) / h, (ray[1] - y) / h
            else:
                xb, yb = (ray[0] - x) / h, (ray[1] - y) / h
        determinant = xa * yb - xb * ya
        da, db = (xb * y - yb * x) / determinant, (ya * x - xa * y) / determinant
        share, better = 1.0, False
        for _ in range(_HALVINGS):
            ta, tb = a + share * da, b + share * db
            status = _chief_shot(packed, indices, axes, base_z, ta, tb, ray, sag)
            if status == TRACED and math.hypot(ray[0], ray[1]) < miss:
                a, b, x, y, better = ta, tb, ray[0], ray[1], True
                break
            share *= 0.5
        if not better:
            break
    start[0], start[1] = a, b
    status = _chief_shot(packed, indices, axes, base_z, a, b, ray, sag)
    if status == TRACED and not math.hypot(ray[0], ray[1]) < _CHIEF_ACCEPTED_MM:
        return NOT_CONVERGED
    return status


@njit(cache=True, nogil=True, error_model="numpy")
def chief_ray(packed, indices, h_rad, v_rad, axes, start, ray, sag):
    """Trace the chief ray of a field to the retina and return its status.

    On return, ``ray`` is at the retina, and ``axes`` and ``start`` are those of the
    field.  If aiming from the paraxial entrance pupil fails, the field angle is
    increased in steps from the axis (continuation).
    """
    base_z = entrance_pupil_z(packed, indices)
    field_axes(h_rad, v_rad, axes)
    status = NOT_CONVERGED
    for step in range(-1, _CONTINUATION_STEPS + 1):
        if step <= 0:
            start[0], start[1] = 0.0, 0.0
        share = 1.0 if step < 0 else step / _CONTINUATION_STEPS
        field_axes(share * h_rad, share * v_rad, axes)
        status = _solve_chief(packed, indices, axes, base_z, start, ray, sag)
        # Direct aiming ends the loop on success, continuation on failure.
        if (status == TRACED) == (step < 0):
            break
    if status != TRACED:
        return status
    n_before, n_surfaces = int(packed[-1, N_BEFORE_STOP]), packed.shape[0] - 1
    status = inward(packed, indices, ray, n_before, n_surfaces, sag)
    if status != TRACED:
        return status
    return to_retina(packed, indices, ray, sag)


@njit(cache=True, nogil=True, error_model="numpy")
def magnification(packed, indices):
    """Return the parabasal magnification of the entrance pupil, about the chief ray.

    Parallel rays at height h cross the stop at h / m.  For an astigmatic eye, 1 / m is
    the root of the determinant of this map.  nan if a ray fails.
    """
    axes, start = np.empty((3, 3)), np.empty(2)
    ray, sag = np.empty(RAY_SIZE), np.empty(3)
    if chief_ray(packed, indices, 0.0, 0.0, axes, start, ray, sag) != TRACED:
        return math.nan
    base_z, h = entrance_pupil_z(packed, indices), 1e-3
    ends = np.empty((4, 2))
    for i in range(4):
        a = start[0] + (h if i == 0 else -h if i == 1 else 0.0)
        b = start[1] + (h if i == 2 else -h if i == 3 else 0.0)
        if _chief_shot(packed, indices, axes, base_z, a, b, ray, sag) != TRACED:
            return math.nan
        copy_values(ray, ends[i])
    ax, ay = ends[0, 0] - ends[1, 0], ends[0, 1] - ends[1, 1]
    bx, by = ends[2, 0] - ends[3, 0], ends[2, 1] - ends[3, 1]
    return 2.0 * h / math.sqrt(abs(ax * by - ay * bx))


@njit(cache=True, nogil=True, error_model="numpy")
def magnifications(packed, indices):
    """Return `magnification` (n_eyes,) of eyes (n_eyes, n_surfaces + 1, N_COLUMNS)."""
    found = np.empty(packed.shape[0])
    for e in range(packed.shape[0]):
        found[e] = magnification(packed[e], indices)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def transverse_axes(direction, frame):
    """Write two unit vectors to ``frame`` that complete ``direction`` to a basis."""
    dx, dy, dz = direction[0], direction[1], direction[2]
    length = math.hypot(dx, dz)
    frame[0, 0], frame[0, 1], frame[0, 2] = dz / length, 0.0, -dx / length
    frame[1, 0] = dy * frame[0, 2] - dz * frame[0, 1]
    frame[1, 1] = dz * frame[0, 0] - dx * frame[0, 2]
    frame[1, 2] = dx * frame[0, 1] - dy * frame[0, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def distance_along(chief, axes, pupil_z):
    """Return the distance along the chief ray from the plane to z = ``pupil_z``, mm."""
    along = 0.0
    for i in range(3):
        along += (chief[1, i] - (pupil_z if i == 2 else 0.0)) * axes[2, i]
    return along


@njit(cache=True, nogil=True, error_model="numpy")
def move_plane_inward(chief, axes, along):
    """Move the plane inward along the chief ray in object space."""
    for i in range(3):
        chief[1, i] -= along * axes[2, i]


@njit(cache=True, nogil=True, error_model="numpy")
def launch(chief, frame, a, b, ray):
    """Start a ray at the retinal point, with direction cosines (a, b) in ``frame``.

    Return False if it does not point out of the eye.
    """
    squared = 1.0 - a * a - b * b
    if squared <= 0.0:
        return False
    c = math.sqrt(squared)
    for i in range(3):
        ray[i] = chief[0, i]
        ray[3 + i] = a * frame[0, i] + b * frame[1, i] + c * frame[2, i]
    ray[6], ray[7] = 0.0, 0.0
    return ray[5] < 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def leave_eye(packed, indices, chief, axes, chief_path, ray, sample, sag):
    """Trace a ray from the stop to the plane through ``chief[1]``; write its sample."""
    n_before = int(packed[-1, N_BEFORE_STOP])
    status = outward(packed, indices, ray, _FIRST, n_before, sag)
    if status != TRACED:
        return status
    x, y, z = ray[0] - chief[1, 0], ray[1] - chief[1, 1], ray[2] - chief[1, 2]
    cosine = ray[3] * axes[2, 0] + ray[4] * axes[2, 1] + ray[5] * axes[2, 2]
    t = -(x * axes[2, 0] + y * axes[2, 1] + z * axes[2, 2]) / cosine
    x, y, z = x + t * ray[3], y + t * ray[4], z + t * ray[5]
    path = ray[6] + t * indices[0]
    sample[X] = x * axes[0, 0] + y * axes[0, 1] + z * axes[0, 2]
    sample[Y] = x * axes[1, 0] + y * axes[1, 1] + z * axes[1, 2]
    sample[W] = UM_PER_MM * (chief_path - path)
    slope = -UM_PER_MM * indices[0]
    sample[SLOPE_X] = slope * (
        ray[3] * axes[0, 0] + ray[4] * axes[0, 1] + ray[5] * axes[0, 2]
    )
    sample[SLOPE_Y] = slope * (
        ray[3] * axes[1, 0] + ray[4] * axes[1, 1] + ray[5] * axes[1, 2]
    )
    return TRACED


@njit(cache=True, nogil=True, error_model="numpy")
def back_to_stop(packed, indices, chief, frame, a, b, ray, sag):
    """Trace a ray from the retinal point through the lens to the stop plane."""
    if not launch(chief, frame, a, b, ray):
        return NOT_CONVERGED
    n_before, n_surfaces = int(packed[-1, N_BEFORE_STOP]), packed.shape[0] - 1
    status = outward(packed, indices, ray, n_before, n_surfaces, sag)
    if status == TRACED:
        to_stop(packed, ray, indices[n_before])
    return status


@njit(cache=True, nogil=True, error_model="numpy")
def stop_response(packed, indices, chief, frame, ray, inverse, sag):
    """Write the inverse Jacobian (2, 2) of position in the stop by (a, b)."""
    h = _DIFFERENCE_COSINE
    ends = np.empty((3, 2))
    for i in range(3):
        a, b = (h if i == 1 else 0.0), (h if i == 2 else 0.0)
        status = back_to_stop(packed, indices, chief, frame, a, b, ray, sag)
        if status != TRACED:
            return status
        copy_values(ray, ends[i])
    xa, ya = (ends[1, 0] - ends[0, 0]) / h, (ends[1, 1] - ends[0, 1]) / h
    xb, yb = (ends[2, 0] - ends[0, 0]) / h, (ends[2, 1] - ends[0, 1]) / h
    determinant = xa * yb - xb * ya
    inverse[0, 0], inverse[0, 1] = yb / determinant, -xb / determinant
    inverse[1, 0], inverse[1, 1] = -ya / determinant, xa / determinant
    return TRACED


@njit(cache=True, nogil=True, error_model="numpy")
def update_inverse(inverse, da, db, cx, cy):
    """Apply Broyden's update (Sherman-Morrison): inverse @ change becomes the step."""
    va = da * inverse[0, 0] + db * inverse[1, 0]
    vb = da * inverse[0, 1] + db * inverse[1, 1]
    scale = va * cx + vb * cy
    if scale == 0.0:
        return
    ea = (da - inverse[0, 0] * cx - inverse[0, 1] * cy) / scale
    eb = (db - inverse[1, 0] * cx - inverse[1, 1] * cy) / scale
    inverse[0, 0] += ea * va
    inverse[0, 1] += ea * vb
    inverse[1, 0] += eb * va
    inverse[1, 1] += eb * vb


@njit(cache=True, nogil=True, error_model="numpy")
def aim(packed, indices, chief, frame, x, y, tolerance, guess, inverse, ray, sag):
    """Aim a ray at (x, y) of the stop by Broyden's method and return its status.

    ``guess`` (2,) is the initial (a, b) and receives the solution; ``inverse`` is the
    inverse Jacobian, which is updated.
    """
    a, b = guess[0], guess[1]
    status = back_to_stop(packed, indices, chief, frame, a, b, ray, sag)
    if status != TRACED:
        return status
    mx, my = ray[0] - x, ray[1] - y
    for _ in range(_AIM_STEPS):
        miss = mx * mx + my * my
        if miss < tolerance * tolerance:
            guess[0], guess[1] = a, b
            return TRACED
        da = -(inverse[0, 0] * mx + inverse[0, 1] * my)
        db = -(inverse[1, 0] * mx + inverse[1, 1] * my)
        share = 1.0
        while True:
            status = back_to_stop(
                packed, indices, chief, frame, a + share * da, b + share * db, ray, sag
            )
            nx, ny = ray[0] - x, ray[1] - y
            if status == TRACED and nx * nx + ny * ny < 4.0 * miss:
                break
            share *= 0.5
            if share < _SMALLEST_SHARE:
                return NOT_CONVERGED if status == TRACED else status
        da, db = share * da, share * db
        update_inverse(inverse, da, db, nx - mx, ny - my)
        a, b, mx, my = a + da, b + db, nx, ny
    return NOT_CONVERGED
