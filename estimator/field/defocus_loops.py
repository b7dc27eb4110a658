"""Compiled loop for the total defocus at fixed fields, for one state of the eye.

It runs for every frame whose pupil or focus has changed.  Total defocus depends only on
three sums of monomials, by degree, and on the rim of the pupil.
`TracedFields.wavefronts` is the NumPy equivalent for complete wavefronts.
"""

import math

import numpy as np
from numba import njit

from estimator.estimate.measured_residual import OVERSHOOT
from estimator.optics.units import SPHERE_PER_C20
from estimator.wavefront.field_wavefronts import (
    N_NEWTON_STEPS,
    N_RIM,
    N_SAMPLED,
    NEWTON_STEP_RAD,
)

SMOOTH_NODES = 3
"""Number of traced pupils whose interpolation is smooth; see
`interpolation.pupil_weights`."""

N_DEGREES = 3
"""Degrees 2, 4 and 6, which contribute to C(2,0)."""

_ANGLES = 2.0 * np.pi * np.arange(N_SAMPLED) / N_SAMPLED
_COSINES, _SINES = np.cos(_ANGLES), np.sin(_ANGLES)

_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def weights_at(nodes, at):
    """Return Lagrange weights (n,) of the polynomial through nodes (n,)."""
    weights = np.ones(nodes.size)
    for i in range(nodes.size):
        for j in range(nodes.size):
            if j != i:
                weights[i] *= (at - nodes[j]) / (nodes[i] - nodes[j])
    return weights


@njit(**_OPTIONS)
def all_weights(nodes, at):
    """Return Lagrange weights (n, n_nodes) at positions (n,)."""
    weights = np.empty((at.size, nodes.size))
    for n in range(at.size):
        weights[n] = weights_at(nodes, at[n])
    return weights


@njit(**_OPTIONS)
def fill_defocus(pupil_mm, field, axis, state, added, found_dpt):
    """Compute total defocus (n,), dpt, of fields and wavelengths in one state.

    Parameters
    ----------
    pupil_mm : float
    field, axis : (nodes_mm, powers, weights, values)
        Grids over the field and on the axis: pupils (n_pupils,), powers (8,) of the
        pupil with which sums and rims change, weights (n_accommodations,) of this
        accommodation, and values (n_fields, n_channels, n_pupils, n_accommodations, 8).
    state : (number, channel, open_mm)
        Index of the field, index of the wavelength and unvignetted pupil, mm, of each
        of the n requests.
    added : (always, fading, fading_mm)
        Sums (n, 3) to add: constant ones, and those of a phase that is stretched in
        pupils with a radius above ``fading_mm``.
    found_dpt : (n,) out
    """
    number, channel, open_mm = state
    always, fading, fading_mm = added
    values = np.empty(N_DEGREES + N_RIM)
    weight, own_weight = np.empty((2, values.size)), np.empty((2, values.size))
    lower = _pupil_weights(pupil_mm, field, weight)
    scale = _scales(pupil_mm, axis)
    for k in range(number.size):
        own_mm = min(pupil_mm, open_mm[k])
        if own_mm == pupil_mm:
            own_scale = scale[channel[k]]
            _between(number[k], channel[k], field, lower, weight, values)
        else:
            own_scale = _scales(own_mm, axis)[channel[k]]
            own_lower = _pupil_weights(own_mm, field, own_weight)
            _between(number[k], channel[k], field, own_lower, own_weight, values)
        _scale_rim(values, own_mm, own_scale)
        radius_mm = _circumscribed_mm(values[N_DEGREES:])
        fade = _stretch_ratio(0.5 * own_mm / fading_mm)
        total = 0.0
        for d in range(N_DEGREES):
            degree = 2 * d + 2
            part = values[d] + always[k, d] + fading[k, d] * fade**degree
            total += part * radius_mm ** (degree - 2)
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
    values = np.empty(N_DEGREES + N_RIM)
    weight = np.empty((2, values.size))
    scale = np.empty(axis[3].shape[1])
    lower = _pupil_weights(pupil_mm, axis, weight)
    for channel in range(scale.size):
        _between(0, channel, axis, lower, weight, values)
        _scale_rim(values, pupil_mm, 1.0)
        scale[channel] = 0.5 * pupil_mm / _circumscribed_mm(values[N_DEGREES:])
    return scale


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
        low, high, highest = 0.0, 0.0, 0.0
        for a in range(weights.size):
            low += weights[a] * values[number, channel, lower, a, k]
            high += weights[a] * values[number, channel, upper, a, k]
            if is_smooth:
                highest += weights[a] * values[number, channel, third, a, k]
        found[k] = low + weight[0, k] * (high - low)
        if is_smooth:
            found[k] += weight[1, k] * (highest - low)


@njit(**_OPTIONS)
def _scale_rim(values, pupil_mm, scale):
    """Scale a rim, stored relative to the pupil (its center, to the square)."""
    for k in range(N_DEGREES, N_DEGREES + N_RIM):
        values[k] *= pupil_mm * scale
        if k < N_DEGREES + 2:
            values[k] *= pupil_mm


@njit(**_OPTIONS)
def _circumscribed_mm(rim):
    """Return the radius of the circumscribed circle; see `circumscribed_radius_mm`."""
    x, y, xx, xy, yy = rim
    sampled, angle = -1.0, 0.0
    for k in range(N_SAMPLED):
        square = _half_square(rim, _COSINES[k], _SINES[k])
        if square > sampled:
            sampled, angle = square, _ANGLES[k]
    for _ in range(N_NEWTON_STEPS):
        cosine, sine = math.cos(angle), math.sin(angle)
        px, py = x + xx * cosine + xy * sine, y + xy * cosine + yy * sine
        tx, ty = xy * cosine - xx * sine, yy * cosine - xy * sine
        second = tx * tx + ty * ty - px * (px - x) - py * (py - y)
        if second < 0.0:
            step = -(px * tx + py * ty) / second
            angle += min(max(step, -NEWTON_STEP_RAD), NEWTON_STEP_RAD)
    highest = _half_square(rim, math.cos(angle), math.sin(angle))
    return math.sqrt(2.0 * max(highest, sampled))


@njit(**_OPTIONS)
def _half_square(rim, cosine, sine):
    px = rim[0] + rim[2] * cosine + rim[3] * sine
    py = rim[1] + rim[3] * cosine + rim[4] * sine
    return 0.5 * (px * px + py * py)
