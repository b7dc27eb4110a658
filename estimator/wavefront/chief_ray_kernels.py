"""Compiled: chief rays of several wavelengths and their apparent directions."""

import math

import numpy as np
from numba import njit

from estimator.optics.surface_kernels import RAY_SIZE, TRACED, copy_values
from estimator.wavefront.kernels import (
    N_SAMPLE,
    SLOPE_X,
    SLOPE_Y,
    UM_PER_MM,
    aim,
    chief_ray,
    leave_eye,
    stop_response,
    transverse_axes,
)

_TOLERANCE_MM = 1e-10
"""Tolerance of aiming at the center of the stop: 1e-8 mrad of the shift."""


@njit(cache=True, nogil=True, error_model="numpy")
def fill_chief_shifts(packed, indices, reference, fields_rad, shifts):
    """Write the shifts (F, L, 2) of chief rays, as direction cosines.

    ``indices`` (L, n_surfaces + 1) are refractive indices at the wavelengths,
    ``reference`` (n_surfaces + 1,) those at the reference wavelength.
    """
    chief, frame, axes = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3))
    ray, sample, start = np.empty(RAY_SIZE), np.empty(N_SAMPLE), np.empty(2)
    inverse, guess, sag = np.empty((2, 2)), np.empty(2), np.empty(3)
    shifts[:] = math.nan
    for f in range(fields_rad.shape[0]):
        h_rad, v_rad = fields_rad[f, 0], fields_rad[f, 1]
        for w in range(indices.shape[0]):
            status = chief_ray(packed, indices[w], h_rad, v_rad, axes, start, ray, sag)
            if status != TRACED:
                continue
            copy_values(ray, chief[0])
            chief[1] = 0.0  # any plane outside will do: only the slope is used
            for i in range(3):
                frame[2, i] = -ray[3 + i]
            transverse_axes(frame[2], frame)
            status = stop_response(packed, reference, chief, frame, ray, inverse, sag)
            if status != TRACED:
                continue
            guess[:] = 0.0
            status = aim(
                packed,
                reference,
                chief,
                frame,
                0.0,
                0.0,
                _TOLERANCE_MM,
                guess,
                inverse,
                ray,
                sag,
            )
            if status == TRACED:
                status = leave_eye(
                    packed, reference, chief, axes, 0.0, ray, sample, sag
                )
            if status == TRACED:
                # The slope of the wavefront is opposite to that of the outgoing ray.
                shifts[f, w, 0] = -sample[SLOPE_X] / UM_PER_MM
                shifts[f, w, 1] = -sample[SLOPE_Y] / UM_PER_MM
