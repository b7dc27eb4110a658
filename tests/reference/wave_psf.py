"""The wave-optical PSF of one pupil in double precision."""

import numpy as np

from estimator.optics.zernike import EXPONENTS
from estimator.psf.fourier import plan_grids
from estimator.psf.tables import (
    EDGE_HALF_WIDTH,
    EDGE_STEPS,
    edge_response,
    pixel_filter,
)


def smoothed_pupil(x, y, samples, shear):
    """The edge's step response at the distance to the edge, in samples."""
    inverse = 1.0 / (1.0 - shear**2)
    across, along = (x - shear * y) * inverse, (y - shear * x) * inverse
    radius = np.sqrt(x * across + y * along)
    steep = np.hypot(across * 2.0 / samples[0], along * 2.0 / samples[1])
    depth = (1.0 - radius) * radius / (steep + 1e-12)
    at = np.arange(-EDGE_HALF_WIDTH, EDGE_HALF_WIDTH + 0.5 / EDGE_STEPS, 1 / EDGE_STEPS)
    return np.interp(depth, at, edge_response())


def wave_kernel(survey, *, radius_px, accuracy):
    """Kernel (2R+1, 2R+1) of unit sum, of the only pupil of a survey."""
    frames = survey.frames
    half, shear = frames.half_width_um_per_px[0], frames.shear_ratio[0]
    wavelength_um = frames.wavelength_nm[0] / 1000.0
    grid = plan_grids(
        extent_px=survey.extent_px, unit_px=survey.unit_px, accuracy=accuracy
    )
    n, per_px, samples = (
        values[0]
        for values in (grid.length_count, grid.samples_per_px_count, grid.pupil_samples)
    )
    center = np.rint(
        0.5 * (survey.slope_low_px[0] + survey.slope_high_px[0]) * per_px
    ).astype(int)
    size = np.minimum(n, np.ceil(samples).astype(int) + 2 * EDGE_HALF_WIDTH)
    x, y = (
        (np.arange(size[axis]) - (size[axis] - 1) / 2.0) * 2.0 / samples[axis]
        for axis in (0, 1)
    )
    x, y = np.meshgrid(x, y)
    phase_um = sum(
        value * x**a * y**b
        for value, (a, b) in zip(frames.box_polynomial_um[0], EXPONENTS, strict=True)
    )
    shift_px = center / per_px
    phase_um = phase_um - shift_px[0] * half[0] * x - shift_px[1] * half[1] * y
    mask = smoothed_pupil(x, y, samples, shear)
    mask = mask * np.exp(
        sum(
            value * term
            for value, term in zip(
                frames.log_amplitude[0],
                (1.0, x, y, x * x, x * y, y * y),
                strict=True,
            )
        )
    )
    field = mask * np.exp(2j * np.pi * phase_um / wavelength_um)
    # exp(-i) transforms to positive angles
    light = np.abs(np.fft.fft2(field, (n[1], n[0]))) ** 2
    light = np.fft.fftshift(light)
    for axis, length in ((1, n[0]), (0, n[1])):
        k, own_center = per_px[1 - axis], center[1 - axis]
        weights = pixel_filter(int(k), accuracy.filter_half_width)
        reach = weights.size // 2
        positions = np.arange(length) - length // 2 + own_center
        pixels = np.arange(-radius_px, radius_px + 1)
        offset = positions[:, None] - pixels * k + reach
        is_near = (offset >= 0) & (offset < weights.size)
        table = np.where(is_near, weights[np.clip(offset, 0, weights.size - 1)], 0.0)
        light = np.moveaxis(np.tensordot(light, table, (axis, 0)), -1, axis)
    y_px, x_px = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
    light = light[::-1] * (x_px**2 + y_px**2 <= (radius_px + 0.5) ** 2)
    return light / light.sum()
