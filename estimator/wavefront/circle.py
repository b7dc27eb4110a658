"""Compiled: wavefront on a given circle outside the eye, for many eyes at once.

Measurements, with which the estimation compares eyes, are given on a circle about the
chief ray.  Rays are therefore aimed at fixed points of this circle instead of the stop,
and the fit is a product with a constant matrix.  Aiming errors are corrected to first
order: the slope at the ray extrapolates W to the point.
"""

import math

import numpy as np
from numba import njit

from estimator.optics.surface_kernels import (
    NOT_CONVERGED,
    RAY_SIZE,
    TRACED,
    copy_values,
)
from estimator.optics.zernike import N_TERMS
from estimator.wavefront.bundle import extrapolate, prepare_chief
from estimator.wavefront.fit import fit_zernike
from estimator.wavefront.kernels import (
    N_SAMPLE,
    SLOPE_X,
    SLOPE_Y,
    W,
    X,
    Y,
    back_to_stop,
    distance_along,
    leave_eye,
    move_plane_inward,
    update_inverse,
)

_TOLERANCE_MM = 2e-5
"""Aiming error that the slope corrects: with W'' = 20 um/mm², to 4e-9 um."""

_STEPS = 20
_SMALLEST_SHARE = 1e-2
_DIFFERENCE_COSINE = 1e-6
_FEWEST_RAYS = 2 * N_TERMS
_BY_VALUES = np.bool_(False)
"""A plain False has a different type and would compile the fit twice."""


@njit(cache=True, nogil=True, error_model="numpy")
def _through(light, a, b, ray, sample, sag):
    packed, indices, chief, frame, axes, path = light
    status = back_to_stop(packed, indices, chief, frame, a, b, ray, sag)
    if status != TRACED:
        return status
    return leave_eye(packed, indices, chief, axes, path, ray, sample, sag)


@njit(cache=True, nogil=True, error_model="numpy")
def _circle_response(light, inverse, ray, sample, sag):
    """Write the inverse Jacobian (2, 2) of position on the circle by ray direction."""
    h = _DIFFERENCE_COSINE
    status = _through(light, h, 0.0, ray, sample, sag)
    if status != TRACED:
        return status
    xa, ya = sample[X] / h, sample[Y] / h
    status = _through(light, 0.0, h, ray, sample, sag)
    xb, yb = sample[X] / h, sample[Y] / h
    determinant = xa * yb - xb * ya
    inverse[0, 0], inverse[0, 1] = yb / determinant, -xb / determinant
    inverse[1, 0], inverse[1, 1] = -ya / determinant, xa / determinant
    return status


@njit(cache=True, nogil=True, error_model="numpy")
def _aim_outside(light, x, y, guess, inverse, ray, sample, sag):
    """Aim a ray at (x, y) of the circle by Broyden's method; extrapolate W to it."""
    a, b = guess[0], guess[1]
    status = _through(light, a, b, ray, sample, sag)
    if status != TRACED:
        return status
    mx, my = sample[X] - x, sample[Y] - y
    for _ in range(_STEPS):
        if mx * mx + my * my < _TOLERANCE_MM * _TOLERANCE_MM:
            guess[0], guess[1] = a, b
            sample[W] -= mx * sample[SLOPE_X] + my * sample[SLOPE_Y]
            sample[X], sample[Y] = x, y
            return TRACED
        da = -(inverse[0, 0] * mx + inverse[0, 1] * my)
        db = -(inverse[1, 0] * mx + inverse[1, 1] * my)
        status = _through(light, a + da, b + db, ray, sample, sag)
        share = 1.0
        while status != TRACED and share > _SMALLEST_SHARE:
            share *= 0.5
            status = _through(light, a + share * da, b + share * db, ray, sample, sag)
        if status != TRACED:
            return status
        da, db = share * da, share * db
        nx, ny = sample[X] - x, sample[Y] - y
        update_inverse(inverse, da, db, nx - mx, ny - my)
        a, b, mx, my = a + da, b + db, nx, ny
    return NOT_CONVERGED


@njit(cache=True, nogil=True, error_model="numpy")
def _circle_samples(light, radius_mm, rings, azimuths, samples, weights, sag):
    """Fill ``samples`` (n_azimuths, n_rings, N_SAMPLE); return the worst status."""
    n_rings = rings.shape[0]
    ray, sample, guess = np.empty(RAY_SIZE), np.empty(N_SAMPLE), np.empty(2)
    response, worst = np.empty((2, 2)), TRACED
    status = _circle_response(light, response, ray, sample, sag)
    if status != TRACED:
        return status
    radii, solution = np.zeros(n_rings + 1), np.zeros((n_rings + 1, 2))
    for ring in range(n_rings):
        radii[ring + 1] = radius_mm * rings[ring]
    for k in range(azimuths.shape[0]):
        inverse = response.copy()
        for ring in range(1, n_rings + 1):
            x, y = radii[ring] * azimuths[k, 0], radii[ring] * azimuths[k, 1]
            if ring == 1:
                guess[0] = inverse[0, 0] * x + inverse[0, 1] * y
                guess[1] = inverse[1, 0] * x + inverse[1, 1] * y
            else:
                extrapolate(radii, solution, ring, guess)
            status = _aim_outside(light, x, y, guess, inverse, ray, sample, sag)
            if status != TRACED:
                worst = max(worst, status)
                samples[k, ring - 1 :] = 0.0
                weights[k, ring - 1 :] = 0.0
                break
            copy_values(guess, solution[ring])
            copy_values(sample, samples[k, ring - 1])
    return worst


@njit(cache=True, nogil=True, error_model="numpy")
def _count_used(weights):
    count = 0
    for weight in weights.flat:
        count += weight > 0.0
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def circle_zernike(
    packed, indices, field_rad, radii_mm, pupil_z_mm, nodes, zernike_um, status
):
    """Compute the coefficients of many eyes, each on its own circle, at one field.

    Parameters
    ----------
    packed : (n_eyes, n_surfaces + 1, N_COLUMNS)
    indices : (n_eyes, n_surfaces + 1)
    field_rad : (h, v)
    radii_mm : (n_eyes,)
    pupil_z_mm : (n_eyes,)
        z of the point of the chief ray in the plane of the circle; nan: the cornea.
    nodes : (rings (n_rings,), weights (n_rings,), azimuths (n_azimuths, 2),
        projection (28, n_azimuths * n_rings))
    zernike_um : (n_eyes, 28) out
        nan if the chief ray or most of the other rays fail.
    status : (n_eyes,) out
        Worst ray status; failed rays are excluded from the fit.
    """
    rings, ring_weights, azimuths, projection = nodes
    n_azimuths, n_rings = azimuths.shape[0], rings.shape[0]
    chief, frame, axes = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    response, sag = np.empty((2, 2)), np.empty(3)
    samples = np.empty((n_azimuths, n_rings, N_SAMPLE))
    weights = np.empty((n_azimuths, n_rings))
    flat = samples.reshape(n_azimuths * n_rings, N_SAMPLE)
    for e in range(packed.shape[0]):
        zernike_um[e] = math.nan
        code, path = prepare_chief(
            packed[e],
            indices[e],
            field_rad[0],
            field_rad[1],
            chief,
            frame,
            axes,
            response,
            sag,
        )
        status[e] = code
        if code != TRACED:
            continue
        if not math.isnan(pupil_z_mm[e]):
            along = distance_along(chief, axes, pupil_z_mm[e])
            move_plane_inward(chief, axes, along)
            path -= along * indices[e, 0]
        for k in range(n_azimuths):
            for ring in range(n_rings):
                weights[k, ring] = ring_weights[ring] / n_azimuths
        light = (packed[e], indices[e], chief, frame, axes, path)
        code = _circle_samples(
            light, radii_mm[e], rings, azimuths, samples, weights, sag
        )
        status[e] = code
        if code == TRACED:
            for j in range(1, N_TERMS):
                total = 0.0
                for r in range(flat.shape[0]):
                    total += projection[j, r] * flat[r, W]
                zernike_um[e, j] = total
            zernike_um[e, 0] = 0.0
        elif _count_used(weights) >= _FEWEST_RAYS:
            fit_zernike(flat, weights.ravel(), radii_mm[e], _BY_VALUES, zernike_um[e])
