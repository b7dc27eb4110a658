"""Compiled: rays through the surfaces, media and stop of a packed eye.

`surface_kernels` describes a ray and `packed` the arrays.
"""

import math

import numpy as np
from numba import njit

from estimator.optics.gradient_kernels import index_at, travel
from estimator.optics.packed import GRADIENT, N_BEFORE_STOP, NEAR_GRADIENT, STOP_Z
from estimator.optics.surface_kernels import (
    RAY_SIZE,
    TRACED,
    copy_values,
    cross_surface,
)


@njit(cache=True, nogil=True, error_model="numpy")
def cross_gradient_surface(packed, media, i, ray, before, behind, sag):
    """Trace a ray to surface ``i``, with a gradient on either side, and refract it.

    ``before`` and ``behind`` identify the media that the ray leaves and enters, by the
    surface in front of them; -1 is air.
    """
    if before >= 0 and packed[before, GRADIENT] != 0.0:
        status = travel(packed, media, before, i, ray, sag)
    else:
        n_before = media[before + 1]
        status = cross_surface(packed, i, ray, n_before, n_before, sag)
    if status != TRACED:
        return status
    n_before = index_at(packed, media, before, ray)
    n_behind = index_at(packed, media, behind, ray)
    return cross_surface(packed, i, ray, n_before, n_behind, sag)


# The loops below choose between `cross_surface` and `cross_gradient_surface` inline: as
# a function, the choice would make a ray take 1.6 times as long.


@njit(cache=True, nogil=True, error_model="numpy")
def to_stop(packed, ray, n):
    """Trace a ray to the stop plane, backward if the lens extends through it."""
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
        if packed[i, NEAR_GRADIENT] == 0.0:
            status = cross_surface(packed, i, ray, indices[i], indices[i + 1], sag)
        else:
            status = cross_gradient_surface(packed, indices, i, ray, i - 1, i, sag)
        if status != TRACED:
            return status
    return TRACED


@njit(cache=True, nogil=True, error_model="numpy")
def outward(packed, indices, ray, first, last, sag):
    """Trace a ray in reverse through surfaces last - 1 to first; return its status."""
    for i in range(last - 1, first - 1, -1):
        if packed[i, NEAR_GRADIENT] == 0.0:
            status = cross_surface(packed, i, ray, indices[i + 1], indices[i], sag)
        else:
            status = cross_gradient_surface(packed, indices, i, ray, i, i - 1, sag)
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
        copy_values(rays[r], ray[:6])
        ray[6:] = 0.0
        status[r] = TRACED
        for step in range(n_surfaces + 2):
            # Elements in the order of propagation.
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
                if packed[i, NEAR_GRADIENT] != 0.0:
                    before = i if reverse else i - 1
                    behind = i - 1 if reverse else i
                    code = cross_gradient_surface(
                        packed, indices, i, ray, before, behind, sag
                    )
                elif reverse:
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
            copy_values(ray, points[r, e])
            copy_values(ray[3:], directions[r, e])
            paths[r, e] = ray[6]
