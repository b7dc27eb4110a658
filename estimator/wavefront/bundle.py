"""Compiled: ray bundle that fills the stop for one field, and the fit of its wavefront.

Rays are aimed at the nodes of a quadrature over the stop: Gauss-Radau rings in the
squared radius, the last one on the rim, at equally spaced azimuths.  The quadrature is
exact for polynomials of degree 4 n_rings - 4 (if below n_azimuths), so the fit
converges exponentially.
"""

import math

import numpy as np
from numba import njit

from estimator.optics.surface_kernels import RAY_SIZE, TRACED, copy_values
from estimator.optics.zernike import N_TERMS
from estimator.wavefront.fit import N_ELLIPSE, fit_ellipse, fit_zernike, rim_radius
from estimator.wavefront.kernels import (
    N_SAMPLE,
    SLOPE_X,
    SLOPE_Y,
    UM_PER_MM,
    W,
    X,
    Y,
    aim,
    back_to_stop,
    chief_ray,
    distance_along,
    leave_eye,
    move_plane_inward,
    stop_response,
    transverse_axes,
)

_AIM_TOLERANCE_MM = 1e-7  # an error only moves the sample
_RIM_TOLERANCE_MM = 1e-9  # an error changes the radius of the circle
_EDGE_HALVINGS = 40
_EDGE_MARGIN = 1e-6  # times the stop's radius: exceeds the aiming tolerance
_FEWEST_SPOKES = 6

# --- columns of a result row ---
ZERNIKE = 0
RADIUS = N_TERMS
ELLIPSE = RADIUS + 1
RMS = ELLIPSE + N_ELLIPSE
OPEN_SHARE = RMS + 1  # unvignetted fraction of the stop's area
CHIEF_STATUS = OPEN_SHARE + 1
WORST_STATUS = CHIEF_STATUS + 1
RETINA_POINT = WORST_STATUS + 1
PLANE_POINT = RETINA_POINT + 3
N_RESULT = PLANE_POINT + 3


# The tuple ``light`` describes the source of the rays and the plane of the wavefront:
# (packed, indices, chief (2, 3): retinal point and point in the plane, frame (3, 3):
# axes inside the eye, the third along the chief ray, axes (3, 3) outside, path of the
# chief ray in mm).


@njit(cache=True, nogil=True, error_model="numpy")
def prepare_chief(packed, indices, h_rad, v_rad, chief, frame, axes, response, sag):
    """Trace the chief ray of a field in and out; return (status, path in mm)."""
    ray, start = np.empty(RAY_SIZE), np.empty(2)
    status = chief_ray(packed, indices, h_rad, v_rad, axes, start, ray, sag)
    if status != TRACED:
        return status, math.nan
    copy_values(ray, chief[0])
    copy_values(ray, chief[1])
    for i in range(3):
        frame[2, i] = -ray[3 + i]
    transverse_axes(frame[2], frame)
    status = back_to_stop(packed, indices, chief, frame, 0.0, 0.0, ray, sag)
    if status != TRACED:
        return status, math.nan
    sample = np.empty(N_SAMPLE)
    status = leave_eye(packed, indices, chief, axes, 0.0, ray, sample, sag)
    if status != TRACED:
        return status, math.nan
    copy_values(ray, chief[1])
    path_mm = ray[6]
    status = stop_response(packed, indices, chief, frame, ray, response, sag)
    return status, path_mm


@njit(cache=True, nogil=True, error_model="numpy")
def extrapolate(radii, solution, ring, out):
    """Extrapolate ray directions at the retina from inner rings to ring ``ring``."""
    first = max(0, ring - 3)
    out[:] = 0.0
    for i in range(first, ring):
        share = 1.0
        for k in range(first, ring):
            if k != i:
                share *= (radii[ring] - radii[k]) / (radii[i] - radii[k])
        out[0] += share * solution[i, 0]
        out[1] += share * solution[i, 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_aimed(light, x, y, tolerance, guess, inverse, ray, sample, sag):
    """Trace a ray aimed at (x, y) of the stop out of the eye; return its status."""
    packed, indices, chief, frame, axes, path = light
    status = aim(
        packed, indices, chief, frame, x, y, tolerance, guess, inverse, ray, sag
    )
    if status != TRACED:
        return status
    return leave_eye(packed, indices, chief, axes, path, ray, sample, sag)


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_spoke(light, radii, azimuth, response, solution, out, sag):
    """Trace the rings of one azimuth; return their number and the last ray's status.

    ``radii`` (n_rings + 1,) start with 0, the chief ray; ``out`` is (n_rings,
    N_SAMPLE).
    """
    inverse, guess, ray = response.copy(), np.empty(2), np.empty(RAY_SIZE)
    solution[0] = 0.0
    for ring in range(1, radii.shape[0]):
        x, y = radii[ring] * azimuth[0], radii[ring] * azimuth[1]
        if ring == 1:
            guess[0] = inverse[0, 0] * x + inverse[0, 1] * y
            guess[1] = inverse[1, 0] * x + inverse[1, 1] * y
        else:
            extrapolate(radii, solution, ring, guess)
        is_rim = ring == radii.shape[0] - 1
        tolerance = _RIM_TOLERANCE_MM if is_rim else _AIM_TOLERANCE_MM
        status = _trace_aimed(
            light, x, y, tolerance, guess, inverse, ray, out[ring - 1], sag
        )
        if status != TRACED:
            return ring - 1, status
        copy_values(guess, solution[ring])
    return radii.shape[0] - 1, TRACED


@njit(cache=True, nogil=True, error_model="numpy")
def _open_radius(light, low, high, azimuth, inner, response, sag):
    """Return the largest radius of the stop on an azimuth without vignetting.

    It is found by bisection; ``inner`` (2,) is the direction of the ray through
    ``low``.
    """
    ray, sample, guess = np.empty(RAY_SIZE), np.empty(N_SAMPLE), np.empty(2)
    inverse, known = np.empty((2, 2)), inner.copy()
    for _ in range(_EDGE_HALVINGS):
        radius = 0.5 * (low + high)
        share = radius / low if low > 0.0 else 1.0
        for i in range(2):
            copy_values(response[i], inverse[i])
            guess[i] = share * known[i]
        x, y = radius * azimuth[0], radius * azimuth[1]
        status = _trace_aimed(
            light, x, y, _AIM_TOLERANCE_MM, guess, inverse, ray, sample, sag
        )
        if status == TRACED:
            low = radius
            copy_values(guess, known)
        else:
            high = radius
    return low


@njit(cache=True, nogil=True, error_model="numpy")
def sample_pupil(light, response, stop_radius, rings, azimuths, samples, edge, sag):
    """Sample the wavefront of a field; return the worst status of its rays.

    ``samples`` is (n_azimuths, n_rings, N_SAMPLE).  On vignetted azimuths, the rings
    are compressed to the open part, whose fraction of the radius is written to ``edge``
    (n_azimuths,).
    """
    n_rings, worst = rings.shape[0], TRACED
    radii, solution = np.zeros(n_rings + 1), np.zeros((n_rings + 1, 2))
    for k in range(azimuths.shape[0]):
        edge[k] = 1.0
        for attempt in range(2):
            for ring in range(n_rings):
                radii[ring + 1] = stop_radius * edge[k] * rings[ring]
            done, status = _trace_spoke(
                light, radii, azimuths[k], response, solution, samples[k], sag
            )
            if status == TRACED:
                break
            worst = max(worst, status)
            if attempt == 1:
                edge[k] = 0.0
                break
            low = _open_radius(
                light,
                radii[done],
                radii[done + 1],
                azimuths[k],
                solution[done],
                response,
                sag,
            )
            edge[k] = low / stop_radius * (1.0 - _EDGE_MARGIN)
    return worst


@njit(cache=True, nogil=True, error_model="numpy")
def _subtract_object_wave(samples, distance_mm):
    """Subtract the spherical wave of a source ``distance_mm`` in front of the plane."""
    for i in range(samples.shape[0]):
        squared = samples[i, X] ** 2 + samples[i, Y] ** 2
        root = math.sqrt(1.0 + squared / (distance_mm * distance_mm))
        samples[i, W] -= UM_PER_MM * squared / (distance_mm * (1.0 + root))
        slope = UM_PER_MM / (distance_mm * root)
        samples[i, SLOPE_X] -= slope * samples[i, X]
        samples[i, SLOPE_Y] -= slope * samples[i, Y]


@njit(cache=True, nogil=True, error_model="numpy")
def _analyze_pupil(samples, edge, ring_weights, distance_mm, use_slopes, result):
    """Compute coefficients, radius, ellipse and residual from the samples of a stop."""
    n_azimuths, n_rings = samples.shape[0], samples.shape[1]
    weights = np.zeros((n_azimuths, n_rings))
    rim = np.empty((2, n_azimuths))
    n_rim, share = 0, 0.0
    for k in range(n_azimuths):
        area = edge[k] * edge[k] / n_azimuths
        share += area
        if edge[k] > 0.0:
            for ring in range(n_rings):
                weights[k, ring] = area * ring_weights[ring]
            rim[0, n_rim], rim[1, n_rim] = samples[k, -1, X], samples[k, -1, Y]
            n_rim += 1
        else:
            samples[k] = 0.0
    result[OPEN_SHARE] = share
    if n_rim < _FEWEST_SPOKES:
        return
    rim = rim[:, :n_rim]
    radius = rim_radius(rim[0], rim[1], edge.min() == 1.0)
    result[RADIUS] = radius
    fit_ellipse(rim[0], rim[1], radius, result[ELLIPSE : ELLIPSE + N_ELLIPSE])
    flat = samples.reshape(n_azimuths * n_rings, N_SAMPLE)
    if distance_mm < math.inf:
        _subtract_object_wave(flat, distance_mm)
    result[RMS] = fit_zernike(
        flat, weights.ravel(), radius, use_slopes, result[ZERNIKE : ZERNIKE + N_TERMS]
    )


@njit(cache=True, nogil=True, error_model="numpy")
def analyze_field(packed, indices, field_rad, stop_radii, view, nodes, results):
    """Compute the results of one field and wavelength, one row per stop.

    Parameters
    ----------
    packed : (n_surfaces + 1, N_COLUMNS)
    indices : (n_surfaces + 1,)
    field_rad : (h, v)
    stop_radii : (n_stops,) mm
    view : (object_dpt, entrance pupil z in mm, at_pupil, use_slopes)
    nodes : (rings (n_rings,), their weights, azimuths (n_azimuths, 2))
    results : (n_stops, N_RESULT) out
    """
    object_dpt, pupil_z, at_pupil, use_slopes = view
    rings, ring_weights, azimuths = nodes
    chief, frame, axes = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    response, sag = np.empty((2, 2)), np.empty(3)
    results[:] = math.nan
    results[:, OPEN_SHARE] = 0.0
    status, path = prepare_chief(
        packed, indices, field_rad[0], field_rad[1], chief, frame, axes, response, sag
    )
    results[:, CHIEF_STATUS] = status
    results[:, WORST_STATUS] = status
    if status != TRACED:
        return
    along, distance_mm = distance_along(chief, axes, pupil_z), math.inf
    if at_pupil:
        move_plane_inward(chief, axes, along)
        path -= along * indices[0]
        along = 0.0
    if object_dpt != 0.0:
        distance_mm = UM_PER_MM / object_dpt - along
    samples = np.empty((azimuths.shape[0], rings.shape[0], N_SAMPLE))
    edge = np.empty(azimuths.shape[0])
    light = (packed, indices, chief, frame, axes, path)
    for s in range(stop_radii.shape[0]):
        result = results[s]
        result[WORST_STATUS] = sample_pupil(
            light, response, stop_radii[s], rings, azimuths, samples, edge, sag
        )
        copy_values(chief[0], result[RETINA_POINT : RETINA_POINT + 3])
        copy_values(chief[1], result[PLANE_POINT : PLANE_POINT + 3])
        _analyze_pupil(samples, edge, ring_weights, distance_mm, use_slopes, result)


@njit(cache=True, nogil=True, error_model="numpy")
def analyze_fields(packed, indices, fields_rad, stop_radii, view, nodes, results):
    """Run `analyze_field` over fields (F, 2) and wavelengths (L, n_surfaces + 1).

    ``results`` is (F, L, n_stops, N_RESULT).
    """
    for f in range(fields_rad.shape[0]):
        field_rad = (fields_rad[f, 0], fields_rad[f, 1])
        for w in range(indices.shape[0]):
            analyze_field(
                packed, indices[w], field_rad, stop_radii, view, nodes, results[f, w]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def analyze_eyes(
    packed, indices, fields_rad, stop_radii, pupil_z_mm, use_slopes, nodes, results
):
    """Run `analyze_field` over eyes, each with its own field and stop.

    Parameters
    ----------
    packed : (E, n_surfaces + 1, N_COLUMNS)
    indices : (E, n_surfaces + 1)
    fields_rad : (E, 2)
    stop_radii, pupil_z_mm : (E,)
        In mm; a ``pupil_z_mm`` of nan selects the plane at the cornea.
    results : (E, N_RESULT) out
    """
    for e in range(packed.shape[0]):
        field_rad = (fields_rad[e, 0], fields_rad[e, 1])
        stop, result = stop_radii[e : e + 1], results[e : e + 1]
        view = (0.0, pupil_z_mm[e], not math.isnan(pupil_z_mm[e]), use_slopes)
        analyze_field(packed[e], indices[e], field_rad, stop, view, nodes, result)
