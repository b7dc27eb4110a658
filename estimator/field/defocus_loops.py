"""Total defocus of fixed fields, state after state: a compiled loop over them.

Only that number is asked for, once a frame whose pupil or focus has changed, so that
of the 28 monomials three sums by degree are carried along, and rims for the circle.
The same in numpy, of whole wavefronts, is `TracedFields.wavefronts`.
"""

import math

import numpy as np
from numba import njit

from estimator.optics.units import SPHERE_PER_C20
from estimator.wavefront.field_wavefronts import (
    N_NEWTON_STEPS,
    N_RIM,
    N_SAMPLED,
    NEWTON_STEP_RAD,
)

N_DEGREES = 3
"""Degrees 2, 4 and 6: no others have a C(2,0)."""

_ANGLES = 2.0 * np.pi * np.arange(N_SAMPLED) / N_SAMPLED
_COSINES, _SINES = np.cos(_ANGLES), np.sin(_ANGLES)

_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**_OPTIONS)
def weights_at(nodes, at):
    """Weights (n,) of the polynomial through nodes (n,), as `lagrange_weights` has."""
    weights = np.ones(nodes.size)
    for i in range(nodes.size):
        for j in range(nodes.size):
            if j != i:
                weights[i] *= (at - nodes[j]) / (nodes[i] - nodes[j])
    return weights


@njit(**_OPTIONS)
def all_weights(nodes, at):
    """Weights (n, n_nodes) at places (n,)."""
    weights = np.empty((at.size, nodes.size))
    for n in range(at.size):
        weights[n] = weights_at(nodes, at[n])
    return weights


@njit(**_OPTIONS)
def fill_defocus(pupil_mm, field, axis, state, added, found_dpt):
    """Total defocus (n,), dpt, of fields and wavelengths at one pupil and focus.

    Parameters
    ----------
    pupil_mm : float
    field, axis : (nodes_mm, powers, used, values)
        Of the field's grid and of the one that holds the axis: pupils (n_pupils,),
        powers (8,) that sums and rims go with, weights (n_accommodations,) of this
        focus, and values (n_fields, n_channels, n_pupils, n_accommodations, 8).
    state : (number, channel, open_mm)
        Per field asked for: its index, its wavelength's, and the pupil that light
        passes, mm.
    added : (always, fading, fading_mm, stretched, stretched_mm)
        Sums (n, 3) that are added: as they are; where pupils are smaller than one,
        less of it beyond; and as a phase that stops growing as a square beyond another.
    """
    number, channel, open_mm = state
    always, fading, fading_mm, stretched, stretched_mm = added
    values = np.empty(N_DEGREES + N_RIM)
    share, own_share = np.empty(values.size), np.empty(values.size)
    lower = _shares(pupil_mm, field, share)
    scale = _scales(pupil_mm, axis)
    for k in range(number.size):
        own_mm = min(pupil_mm, open_mm[k])
        if own_mm == pupil_mm:
            own_scale = scale[channel[k]]
            _between(number[k], channel[k], field, lower, share, values)
        else:
            own_scale = _scales(own_mm, axis)[channel[k]]
            own_lower = _shares(own_mm, field, own_share)
            _between(number[k], channel[k], field, own_lower, own_share, values)
        _scale_rim(values, own_mm, own_scale)
        radius_mm = _circumscribed_mm(values[N_DEGREES:])
        fade = min(2.0 * fading_mm / own_mm, 1.0)
        stop = min(2.0 * stretched_mm / own_mm, 1.0)
        total = 0.0
        for d in range(N_DEGREES):
            degree = 2 * d + 2
            part = values[d] + always[k, d] + fading[k, d] * fade**degree
            part += stretched[k, d] * stop ** (degree - 2)
            total += part * radius_mm ** (degree - 2)
        found_dpt[k] = -SPHERE_PER_C20 * total


@njit(**_OPTIONS)
def _scales(pupil_mm, axis):
    """Pupil over the traced one (n_channels,), on the axis."""
    values, share = np.empty(N_DEGREES + N_RIM), np.empty(N_DEGREES + N_RIM)
    scale = np.empty(axis[3].shape[1])
    lower = _shares(pupil_mm, axis, share)
    for channel in range(scale.size):
        _between(0, channel, axis, lower, share, values)
        _scale_rim(values, pupil_mm, 1.0)
        scale[channel] = 0.5 * pupil_mm / _circumscribed_mm(values[N_DEGREES:])
    return scale


@njit(**_OPTIONS)
def _shares(pupil_mm, grid, share):
    """Index of the lower pupil; fills in the shares (8,) of the one above it."""
    nodes_mm, powers = grid[0], grid[1]
    share[:] = 0.0
    if nodes_mm.size == 1:
        return 0
    lower = 0
    while lower < nodes_mm.size - 2 and nodes_mm[lower + 1] <= pupil_mm:
        lower += 1
    high_mm = nodes_mm[lower + 1]
    for k in range(share.size):
        least = (nodes_mm[lower] / high_mm) ** powers[k]
        share[k] = ((pupil_mm / high_mm) ** powers[k] - least) / (1.0 - least)
    return lower


@njit(**_OPTIONS)
def _between(number, channel, grid, lower, share, found):
    """Fill in sums and rim (8,) between pupils and accommodations."""
    used, values = grid[2], grid[3]
    upper = min(lower + 1, values.shape[2] - 1)
    for k in range(found.size):
        low, high = 0.0, 0.0
        for a in range(used.size):
            low += used[a] * values[number, channel, lower, a, k]
            high += used[a] * values[number, channel, upper, a, k]
        found[k] = low + share[k] * (high - low)


@njit(**_OPTIONS)
def _scale_rim(values, pupil_mm, scale):
    """Rims are stored over the pupil, their centre over its square."""
    for k in range(N_DEGREES, N_DEGREES + N_RIM):
        values[k] *= pupil_mm * scale
        if k < N_DEGREES + 2:
            values[k] *= pupil_mm


@njit(**_OPTIONS)
def _circumscribed_mm(rim):
    """Radius of the circle about the chief ray: as `circumscribed_radius_mm`."""
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
