"""Compiled inner loops of wave optics: pupil function and pixel integration.

They release the GIL and are single-threaded, so callers may run them in any number of
threads, with any numba threading layer.
"""

import math

import numpy as np
from numba import njit

from estimator.psf.kernel_types import finish_kernel
from estimator.psf.tail import add_tail


def _even_polynomial(function) -> tuple[np.float32, ...]:
    """Return the polynomial in z = t², t in [-1/2, 1/2], through 7 Chebyshev nodes."""
    nodes = (1.0 + np.cos(np.pi * (np.arange(7) + 0.5) / 7.0)) / 8.0
    coefficients = np.polynomial.polynomial.polyfit(nodes, function(np.sqrt(nodes)), 6)
    return tuple(np.float32(c) for c in coefficients)


# cos(2 pi t) and sin(2 pi t) / t, t in turns, to 3e-7.  Range reduction is one floor,
# so the loop vectorizes; with libm's sincos it would not and take 10 times as long.
COSINE_OF_TURNS = _even_polynomial(lambda t: np.cos(2.0 * np.pi * t))
SINE_OF_TURNS = _even_polynomial(lambda t: np.sin(2.0 * np.pi * t) / t)
_HALF = np.float32(0.5)

EDGE_HALF_WIDTH = 8
"""Number of samples by which the smoothed pupil extends beyond its edge."""

EDGE_STEPS = 256
"""Entries per sample of the tabulated step response."""


# The loops below run over whole slices from 0: numba omits the wraparound test for an
# index that it can prove to be positive, and without this test they vectorize.


@njit(cache=True, nogil=True, fastmath=True)
def _fill_row(row, x, mask, cosine, sine, out_re_im):
    """Write mask * exp(2 pi i W) along a row; ``row`` is the polynomial in x, (7,)."""
    c0, c1, c2, c3, c4, c5, c6 = row[0], row[1], row[2], row[3], row[4], row[5], row[6]
    a0, a1, a2, a3, a4, a5, a6 = COSINE_OF_TURNS
    b0, b1, b2, b3, b4, b5, b6 = SINE_OF_TURNS
    for i in range(x.shape[0]):
        u = x[i]
        t = c0 + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * (c5 + u * c6)))))
        t = t - np.floor(t + _HALF)
        z = t * t
        even = a0 + z * (a1 + z * (a2 + z * (a3 + z * (a4 + z * (a5 + z * a6)))))
        odd = b0 + z * (b1 + z * (b2 + z * (b3 + z * (b4 + z * (b5 + z * b6)))))
        cosine[i] = mask[i] * even
        sine[i] = mask[i] * t * odd
    for i in range(x.shape[0]):
        out_re_im[2 * i] = cosine[i]
        out_re_im[2 * i + 1] = sine[i]


@njit(cache=True, nogil=True)
def _chord(y, r, shear, samples_x, middle):
    """Return the first and last column, as floats, of an ellipse scaled by r at y."""
    square = (r * r - y * y) * (1.0 - shear * shear)
    if r <= 0.0 or square <= 0.0:
        return 0.0, -1.0
    half, center = 0.5 * samples_x * math.sqrt(square), 0.5 * samples_x * shear * y
    return middle + center - half, middle + center + half


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _edge_places(x, y, shear, half, places):
    """Compute positions in the edge table for consecutive samples of a row.

    The distance to the edge, in samples, is computed from the gradient of
    q = (x² - 2 r x y + y²) / (1 - r²).  It is exact for a circle and of first order for
    an ellipse.
    """
    one, steps = np.float32(1.0), np.float32(EDGE_STEPS)
    least, most = np.float32(0.0), np.float32(2 * EDGE_HALF_WIDTH * EDGE_STEPS)
    inverse = np.float32(1.0 / (1.0 - shear * shear))
    per_x, per_y = np.float32(1.0 / half[0]), np.float32(1.0 / half[1])
    r, v = np.float32(shear), np.float32(y)
    for i in range(places.shape[0]):
        u = x[i]
        across, along = (u - r * v) * inverse, (v - r * u) * inverse
        radius = np.sqrt(u * across + v * along)
        slope_x, slope_y = across * per_x, along * per_y
        steep = np.sqrt(slope_x * slope_x + slope_y * slope_y)
        depth = (one - radius) * radius / (steep + np.float32(1e-12))
        place = (depth + np.float32(EDGE_HALF_WIDTH)) * steps
        places[i] = min(max(place, least), most)


@njit(cache=True, nogil=True)
def _edge_row(first, end, x, y, shear, half, edge, places, row):
    """Write the smoothed pupil near its edge, for samples ``first`` to ``end - 1``."""
    if end <= first:
        return
    _edge_places(x[first:end], y, shear, half, places[: end - first])
    for i in range(first, end):
        place = places[i - first]
        k = min(int(place), edge.size - 2)
        row[i] = edge[k] + (place - np.float32(k)) * (edge[k + 1] - edge[k])


@njit(cache=True, nogil=True)
def fill_mask(samples, shear, log_amplitude, edge, mask, spans):
    """Write the smoothed elliptical pupil, and the spans of its rows.

    Parameters
    ----------
    samples : (2,)
        Samples across the bounding box, in general not integers.
    shear : float
    log_amplitude : (6,)
    edge : (2 EDGE_HALF_WIDTH EDGE_STEPS + 1,) float32
        Step response of the low-pass filter.
    mask : (My, Mx) float32 out
    spans : (My, 2) int64 out
        First column inside the pupil, and the one after the last, in each row.
    """
    my, mx = mask.shape
    ax, ay = 0.5 * samples[0], 0.5 * samples[1]
    axes, places = (ax, ay), np.empty(mx, np.float32)
    x = ((np.arange(mx) - (mx - 1) / 2.0) / ax).astype(np.float32)
    mean, half = 0.5 * (ax * ax + ay * ay), 0.5 * (ax * ax - ay * ay)
    least = math.sqrt(mean - math.hypot(half, shear * ax * ay))
    border = (EDGE_HALF_WIDTH + 0.5) / least
    middle = (mx - 1) / 2.0
    is_apodized = False
    for c in log_amplitude:
        is_apodized = is_apodized or c != 0.0
    for j in range(my):
        y = (j - (my - 1) / 2.0) / ay
        row = mask[j]
        outer = _chord(y, 1.0 + border, shear, samples[0], middle)
        inner = _chord(y, 1.0 - border, shear, samples[0], middle)
        first, end = max(0, math.floor(outer[0])), min(mx, math.ceil(outer[1]) + 1)
        if outer[1] < outer[0]:
            first, end = 0, 0
        in_first, in_end = math.ceil(inner[0]), math.floor(inner[1]) + 1
        if in_end <= in_first:
            in_first, in_end = end, end
        spans[j, 0], spans[j, 1] = first, max(first, end)
        _edge_row(first, in_first, x, y, shear, axes, edge, places, row)
        row[in_first:in_end] = edge[-1]
        _edge_row(in_end, end, x, y, shear, axes, edge, places, row)
        if is_apodized:
            c0, c1, c2, c3, c4, c5 = log_amplitude
            for i in range(first, end):
                exponent = c0 + x[i] * (c1 + c3 * x[i] + c4 * y) + y * (c2 + c5 * y)
                row[i] *= np.float32(math.exp(exponent))


@njit(cache=True, nogil=True)
def fill_pupil(turns, mask, spans, samples_x, samples_y, field):
    """Write mask * exp(2 pi i W) to the corner of a field.

    Parameters
    ----------
    turns : (7, 7) float64
        Phase in turns; ``[i, j]`` is the coefficient of y^i x^j.
    mask : (My, Mx) float32
    spans : (My, 2) int64
    samples_x, samples_y : float
    field : (>= My, N) complex64, zero on entry
    """
    my, mx = mask.shape
    row = np.empty(7, np.float32)
    cosine, sine = np.empty(mx, np.float32), np.empty(mx, np.float32)
    x = np.empty(mx, np.float32)
    for i in range(mx):
        x[i] = (i - (mx - 1) / 2.0) * 2.0 / samples_x
    for j in range(my):
        first, end = spans[j, 0], spans[j, 1]
        if first >= end:
            continue
        y = (j - (my - 1) / 2.0) * 2.0 / samples_y
        for a in range(7):
            value = 0.0
            for power in range(6 - a, -1, -1):
                value = value * y + turns[power, a]
            # Whole turns are removed before the cast to float32: the error is 1e-6.
            row[a] = value - math.floor(value) if a == 0 else value
        _fill_row(
            row,
            x[first:end],
            mask[j, first:end],
            cosine,
            sine,
            field[j, first:end].view(np.float32),
        )


@njit(cache=True, nogil=True)
def fill_pupils(frames, power_x, power_y, grid, center_px, edge, field):
    """Write the pupil functions of a batch, with windows centered on ``center_px``.

    Parameters
    ----------
    frames : (polynomial (B, 28) um, half (B, 2), shear (B,), log_amplitude (B, 6),
        wavelength_um (B,))
    power_x, power_y : (28,) int64
    grid : (samples (B, 2), size (B, 2) int64)
        Samples across the bounding box, and numbers of columns and rows of the mask.
    center_px : (B, 2)
    edge : (2 EDGE_HALF_WIDTH EDGE_STEPS + 1,) float32
        Step response of the low-pass filter.
    field : (B, My, N) complex64, zero on entry
    """
    polynomial, half, shear, log_amplitude, wavelength_um = frames
    samples, size = grid
    turns = np.zeros((7, 7))
    mask = np.empty((size[:, 1].max(), size[:, 0].max()), np.float32)
    spans = np.empty((mask.shape[0], 2), np.int64)
    for b in range(polynomial.shape[0]):
        columns, rows = size[b]
        is_new = b == 0 or shear[b] != shear[b - 1]
        is_new = is_new or samples[b, 0] != samples[b - 1, 0]
        is_new = is_new or samples[b, 1] != samples[b - 1, 1]
        for i in range(6):
            is_new = is_new or log_amplitude[b, i] != log_amplitude[b - 1, i]
        part = mask[:rows, :columns]
        if is_new:
            fill_mask(samples[b], shear[b], log_amplitude[b], edge, part, spans[:rows])
        per_um = 1.0 / wavelength_um[b]
        for j in range(polynomial.shape[1]):
            turns[power_y[j], power_x[j]] = polynomial[b, j] * per_um
        turns[0, 1] -= half[b, 0] * center_px[b, 0] * per_um
        turns[1, 0] -= half[b, 1] * center_px[b, 1] * per_um
        fill_pupil(turns, part, spans[:rows], samples[b, 0], samples[b, 1], field[b])


@njit(cache=True, nogil=True, fastmath=True)
def _intensity(re_im, out):
    for i in range(out.shape[0]):
        re, im = re_im[2 * i], re_im[2 * i + 1]
        out[i] = re * re + im * im


@njit(cache=True, nogil=True, fastmath=True)
def _dot(a, b):
    total = np.float32(0.0)
    for i in range(b.shape[0]):
        total += a[i] * b[i]
    return total


@njit(cache=True, nogil=True, fastmath=True)
def _accumulate(weight, source, out):
    for i in range(out.shape[0]):
        out[i] += weight * source[i]


@njit(cache=True, nogil=True)
def integrate_pixels(field, center, window, k, filter_x, filter_y, scale, kernel):
    """Integrate |field|² over the pixels of a window and write them to the kernel.

    Parameters
    ----------
    field : (Ny, Nx) complex64
        Spectrum of the pupil, not shifted: sample j is at center + j in the first half
        and at center + j - N in the second.
    center : (2,) int64
        Center (x, y) of the window, in angular samples.
    window : (4,) int64
        Pixel offsets x0, x1, y0, y1 (y upward, ends included) to write.
    k : (2,) int64
        Samples per pixel.
    filter_x, filter_y : (2*reach+1,) float32
    scale : float
        Share of the light per unit of summed intensity.
    kernel : (2R+1, 2R+1) float32
        Image orientation; only the window is written.
    """
    kx, ky = k
    n_rows, n_columns = field.shape
    half_x, half_y = n_columns // 2, n_rows // 2
    radius = kernel.shape[0] // 2
    reach_x, reach_y = filter_x.shape[0] // 2, filter_y.shape[0] // 2
    x0, x1, y0, y1 = window
    n_x, n_y = x1 - x0 + 1, y1 - y0 + 1
    if n_x <= 0 or n_y <= 0:
        return
    pad = reach_x + kx
    line = np.empty(n_columns, np.float32)
    sums = np.zeros((n_y, n_columns + 2 * pad), np.float32)
    first_row = max(0, y0 * ky - center[1] + half_y - reach_y)
    last_row = min(n_rows - 1, y1 * ky - center[1] + half_y + reach_y)
    # Rows first: each contributes to about two pixels, and sums of rows vectorize.
    for j in range(first_row, last_row + 1):
        parts = field[(j + half_y) % n_rows].view(np.float32)
        _intensity(parts[:n_columns], line[half_x:])
        _intensity(parts[n_columns:], line[:half_x])
        position = j - half_y + center[1]
        q_low = max(y0, -((reach_y - position) // ky))
        q_high = min(y1, (position + reach_y) // ky)
        for q in range(q_low, q_high + 1):
            weight = filter_y[position - q * ky + reach_y]
            _accumulate(weight, line, sums[q - y0, pad : pad + n_columns])
    start = x0 * kx - center[0] + half_x - reach_x + pad
    for q in range(n_y):
        for i in range(n_x):
            first = start + i * kx
            value = _dot(sums[q, first : first + filter_x.shape[0]], filter_x)
            kernel[radius - (y0 + q), radius + x0 + i] = scale * value


@njit(cache=True, nogil=True)
def integrate_batch(field, grid, filters, tails, output):
    """Convert a batch of spectra to kernels in the output buffer.

    Parameters
    ----------
    field : (B, Ny, Nx) complex64
    grid : (center (B, 2) int64, k (B, 2) int64, scale (B,))
    filters : (table (n, longest) float32, length (n,) int64, which (B, 2) int64)
    tails : (edge_slope_px (B, n, 2), half (B, 2), shear (B,), edge_um (B,))
    output : (flat float32, offset (B,), radius_px (B,), share (B,), total (B,))
        Kernels are scaled to a sum of ``share`` and added; ``total`` is written.
    """
    center, k, scale = grid
    table, length, which = filters
    edge, half, shear, edge_um = tails
    flat, offset, radius_px, share, total = output
    window = np.empty(4, np.int64)
    for b in range(field.shape[0]):
        radius = radius_px[b]
        side = 2 * radius + 1
        kernel = np.zeros((side, side), np.float32)
        for axis in range(2):
            inside = field.shape[2 - axis] / 2.0 - 1.0
            low = math.ceil((center[b, axis] - inside) / k[b, axis] + 0.5)
            high = math.floor((center[b, axis] + inside) / k[b, axis] - 0.5)
            window[2 * axis] = max(low, -radius)
            window[2 * axis + 1] = min(high, radius)
        integrate_pixels(
            field[b],
            center[b],
            window,
            k[b],
            table[which[b, 0], : length[which[b, 0]]],
            table[which[b, 1], : length[which[b, 1]]],
            scale[b],
            kernel,
        )
        add_tail(kernel, window, 0.0, edge[b], half[b], shear[b], edge_um[b])
        total[b] = finish_kernel(
            kernel, share[b], flat[offset[b] : offset[b] + side * side]
        )
