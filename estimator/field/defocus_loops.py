"""Compiled loop for the total defocus at fixed fields, for one state of the eye.

It runs for every frame whose pupil or focus has changed.  Total defocus depends only on
sums of monomials of degrees 2, 4 and 6, or up to 10, and on the rim of the pupil.
`TracedFields.wavefronts` is the NumPy equivalent for complete wavefronts.
"""

import math

import numpy as np
from numba import njit

from estimator.estimate.measured_residual import OVERSHOOT
from estimator.field.interpolation import SMOOTH_NODES
from estimator.optics.units import SPHERE_PER_C20
from estimator.wavefront.field_wavefronts import (
    N_NEWTON_STEPS,
    N_RIM,
    N_SAMPLED,
    NEWTON_STEP_RAD,
)

_ANGLES = 2.0 * np.pi * np.arange(N_SAMPLED) / N_SAMPLED
_COSINES, _SINES = np.cos(_ANGLES), np.sin(_ANGLES)

LANES = 8
"""Rims that are processed at once: a vector of AVX-512, or two of AVX2."""

_X, _Y, _XX, _XY, _YY, _MOST, _COS, _SIN = (LANES * k for k in range(N_RIM + 3))
"""First lane of the five numbers of rims, and of the square of the distance, cosine and
sine of the farthest point so far."""

_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}
_VECTOR_OPTIONS = {**_OPTIONS, "fastmath": {"arcp", "contract"}}


@njit(**_OPTIONS)
def fill_defocus(pupil_mm, field, axis, state, added, found_dpt):
    """Compute total defocus (n,), dpt, of fields and wavelengths in one state.

    Parameters
    ----------
    pupil_mm : float
    field, axis : (nodes_mm, powers, weights, values)
        Grids over the field and on the axis: pupils (n_pupils,), powers (8,) of the
        pupil with which sums and rims change, weights (n_accommodations,) of this
        accommodation, and values (n_fields, n_channels, n_pupils, n_accommodations, 8):
        three sums, or more, and the rim.
    state : (number, channel, open_mm)
        Index of the field, index of the wavelength and unvignetted pupil, mm, of each
        of the n requests.
    added : (always, fading, fading_mm)
        Sums (n, k) to add, at least as many as the grid has: constant ones, and those
        of a phase that is stretched in pupils with a radius above ``fading_mm``.
    found_dpt : (n,) out
    """
    number, channel, open_mm = state
    always, fading, fading_mm = added
    values = np.empty((field[3].shape[-1], number.size))
    n_degrees = values.shape[0] - N_RIM
    weight, own_weight = np.empty((2, len(values))), np.empty((2, len(values)))
    lower = _pupil_weights(pupil_mm, field, weight)
    scale = _scales(pupil_mm, axis)
    fade = np.empty(number.size)
    for k in range(number.size):
        own_mm = min(pupil_mm, open_mm[k])
        if own_mm == pupil_mm:
            own_scale = scale[channel[k]]
            _between(number[k], channel[k], field, lower, weight, values[:, k])
        else:
            own_scale = _scales(own_mm, axis)[channel[k]]
            own_lower = _pupil_weights(own_mm, field, own_weight)
            _between(number[k], channel[k], field, own_lower, own_weight, values[:, k])
        _scale_rim(values[:, k], own_mm, own_scale)
        fade[k] = _stretch_ratio(0.5 * own_mm / fading_mm)
    radius_mm = _circumscribed_mm(values[n_degrees:])
    for k in range(number.size):
        total, fading_power, radius_power = 0.0, fade[k] ** 2, 1.0
        for d in range(always.shape[1]):
            traced = values[d, k] if d < n_degrees else 0.0
            part = traced + always[k, d] + fading[k, d] * fading_power
            total += part * radius_power
            fading_power *= fade[k] ** 2
            radius_power *= radius_mm[k] ** 2
        found_dpt[k] = -SPHERE_PER_C20 * total


@njit(**_OPTIONS)
def _stretch_ratio(pupil_ratio):
    """Return the factor of pupil coordinates; see `measured_residual.stretch_ratio`."""
    beyond = min(max(pupil_ratio - 1.0, 0.0), 2.0 * OVERSHOOT)
    rim = min(pupil_ratio, 1.0) + beyond - beyond**2 / (4.0 * OVERSHOOT)
    return rim / pupil_ratio


@njit(**_OPTIONS)
def _scales(pupil_mm, axis):
    """Return ratios (n_channels,) of the requested to the traced pupil, on axis."""
    count = axis[3].shape[1]
    values = np.empty((axis[3].shape[-1], count))
    weight = np.empty((2, len(values)))
    lower = _pupil_weights(pupil_mm, axis, weight)
    for channel in range(count):
        _between(0, channel, axis, lower, weight, values[:, channel])
        _scale_rim(values[:, channel], pupil_mm, 1.0)
    return 0.5 * pupil_mm / _circumscribed_mm(values[values.shape[0] - N_RIM :])


@njit(**_OPTIONS)
def _pupil_weights(pupil_mm, grid, weight):
    """Return the index of the first pupil; write weights (2, 8) of the next ones.

    See `interpolation.pupil_weights`.
    """
    nodes_mm, powers = grid[0], grid[1]
    weight[:] = 0.0
    if nodes_mm.size == 1:
        return 0
    if nodes_mm.size == SMOOTH_NODES:
        largest_mm = nodes_mm[2]
        first, middle = nodes_mm[0] / largest_mm, nodes_mm[1] / largest_mm
        here = pupil_mm / largest_mm
        for k in range(powers.size):
            low, high = powers[k], powers[k] + 2.0
            a, b = middle**low - first**low, middle**high - first**high
            c, d = 1.0 - first**low, 1.0 - first**high
            e, f = here**low - first**low, here**high - first**high
            weight[0, k] = (e * d - f * c) / (a * d - b * c)
            weight[1, k] = (a * f - b * e) / (a * d - b * c)
        return 0
    lower = 0
    while lower < nodes_mm.size - 2 and nodes_mm[lower + 1] <= pupil_mm:
        lower += 1
    high_mm = nodes_mm[lower + 1]
    for k in range(powers.size):
        least = (nodes_mm[lower] / high_mm) ** powers[k]
        weight[0, k] = ((pupil_mm / high_mm) ** powers[k] - least) / (1.0 - least)
    return lower


@njit(**_OPTIONS)
def _between(number, channel, grid, lower, weight, found):
    """Interpolate sums and rim (8,) between pupils and accommodations."""
    weights, values = grid[2], grid[3]
    last = values.shape[2] - 1
    upper, third = min(lower + 1, last), min(lower + 2, last)
    is_smooth = values.shape[2] == SMOOTH_NODES
    for k in range(found.size):
        found[k] = 0.0
    low, high = values[number, channel, lower], values[number, channel, upper]
    highest = values[number, channel, third]
    for a in range(weights.size):
        for k in range(found.size):
            part = low[a, k] + weight[0, k] * (high[a, k] - low[a, k])
            if is_smooth:
                part += weight[1, k] * (highest[a, k] - low[a, k])
            found[k] += weights[a] * part


@njit(**_OPTIONS)
def _scale_rim(values, pupil_mm, scale):
    """Scale a rim, stored relative to the pupil (its center, to the square)."""
    first = values.size - N_RIM
    for k in range(first, values.size):
        values[k] *= pupil_mm * scale
        if k < first + 2:
            values[k] *= pupil_mm


@njit(**_VECTOR_OPTIONS)
def _circumscribed_mm(rims):
    """Return radii (n,) of circumscribed circles; see `circumscribed_radius_mm`.

    Loops over the lanes of one array, without branches, are vector instructions: a
    fifth of the time of one rim (5,) after another.
    """
    n = rims.shape[1]
    radius_mm = np.empty(n)
    lanes = np.empty((_SIN // LANES + 1) * LANES)
    for first in range(0, n, LANES):
        for row in range(N_RIM):
            for i in range(LANES):
                lanes[LANES * row + i] = rims[row, min(first + i, n - 1)]
        _take_farthest_sample(lanes)
        for _ in range(N_NEWTON_STEPS):
            _step_to_farthest(lanes)
        for i in range(LANES):
            c, s = lanes[_COS + i], lanes[_SIN + i]
            px = lanes[_X + i] + lanes[_XX + i] * c + lanes[_XY + i] * s
            py = lanes[_Y + i] + lanes[_XY + i] * c + lanes[_YY + i] * s
            square = px * px + py * py
            is_less = square < lanes[_MOST + i]
            lanes[_MOST + i] = lanes[_MOST + i] if is_less else square
        for i in range(min(LANES, n - first)):
            radius_mm[first + i] = math.sqrt(lanes[_MOST + i])
    return radius_mm


@njit(**_VECTOR_OPTIONS)
def _take_farthest_sample(lanes):
    """Start with the farthest of points at equal angles."""
    for i in range(LANES):
        lanes[_MOST + i] = -1.0
    for k in range(N_SAMPLED):
        c, s = _COSINES[k], _SINES[k]
        for i in range(LANES):
            px = lanes[_X + i] + lanes[_XX + i] * c + lanes[_XY + i] * s
            py = lanes[_Y + i] + lanes[_XY + i] * c + lanes[_YY + i] * s
            square = px * px + py * py
            is_more = square > lanes[_MOST + i]
            lanes[_MOST + i] = square if is_more else lanes[_MOST + i]
            lanes[_COS + i] = c if is_more else lanes[_COS + i]
            lanes[_SIN + i] = s if is_more else lanes[_SIN + i]


@njit(**_VECTOR_OPTIONS)
def _step_to_farthest(lanes):
    """Turn the directions by one Newton step each."""
    for i in range(LANES):
        c, s = lanes[_COS + i], lanes[_SIN + i]
        xx, xy, yy = lanes[_XX + i], lanes[_XY + i], lanes[_YY + i]
        from_center_x, from_center_y = xx * c + xy * s, xy * c + yy * s
        px, py = lanes[_X + i] + from_center_x, lanes[_Y + i] + from_center_y
        tx, ty = xy * c - xx * s, yy * c - xy * s
        second = tx * tx + ty * ty - px * from_center_x - py * from_center_y
        is_concave = second < 0.0
        step = -(px * tx + py * ty) / (second if is_concave else 1.0)
        # Conditional expressions are vector instructions; min and max are not.
        step = step if step < NEWTON_STEP_RAD else NEWTON_STEP_RAD
        step = step if step > -NEWTON_STEP_RAD else -NEWTON_STEP_RAD
        step = step if is_concave else 0.0
        # Series of cosine and sine, exact to 1e-14 for such steps.
        q = step * step
        turn_c = 1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0))
        turn_c = 1.0 - q / 2.0 * turn_c
        turn_s = 1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0))
        turn_s = step * (1.0 - q / 6.0 * turn_s)
        lanes[_COS + i] = c * turn_c - s * turn_s
        lanes[_SIN + i] = s * turn_c + c * turn_s
