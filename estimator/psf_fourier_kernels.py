"""Inner loops of the wave method, compiled: pupil phase and pixel integration.

Free of the Python lock and single-threaded, so that callers may run them from any
number of threads whatever thread layer numba finds.
"""

import math

import numpy as np
from numba import njit


def _even_polynomial(function) -> tuple[np.float32, ...]:
    """Polynomial in z = t², t in [-1/2, 1/2], through 7 Chebyshev nodes."""
    nodes = (1.0 + np.cos(np.pi * (np.arange(7) + 0.5) / 7.0)) / 8.0
    coefficients = np.polynomial.polynomial.polyfit(nodes, function(np.sqrt(nodes)), 6)
    return tuple(np.float32(c) for c in coefficients)


# cos(2 pi t) and sin(2 pi t) / t to 3e-7: reduction in turns is one floor, and the
# loop vectorises, which libm's sincos does not (about 10 times slower).
_C = _even_polynomial(lambda t: np.cos(2.0 * np.pi * t))
_S = _even_polynomial(lambda t: np.sin(2.0 * np.pi * t) / t)
_HALF = np.float32(0.5)


# The loops below run over whole slices from 0: an index that numba can prove positive
# needs no wrap-around test, and without that test they vectorise.


@njit(cache=True, nogil=True, fastmath=True)
def _fill_row(row, x, mask, cosine, sine, out_re_im):
    """Mask * exp(2 pi i W) along one row; ``row`` are the 7 coefficients in x."""
    c0, c1, c2, c3, c4, c5, c6 = row[0], row[1], row[2], row[3], row[4], row[5], row[6]
    a0, a1, a2, a3, a4, a5, a6 = _C
    b0, b1, b2, b3, b4, b5, b6 = _S
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
def fill_pupils(turns, mask, x, y, field):
    """Write mask * exp(2 pi i W) of every wavefront into the corner of its field.

    Parameters
    ----------
    turns : (B, 7, 7) float64
        Phase polynomial in turns, ``[b, i, j]`` multiplies y^i x^j.
    mask : (My, Mx) float32
    x, y : (Mx,), (My,) float64, unit pupil
    field : (B, My, N) complex64, zero on entry
    """
    x32 = x.astype(np.float32)
    row = np.empty(7, np.float32)
    cosine, sine = np.empty(x.size, np.float32), np.empty(x.size, np.float32)
    for iy in range(mask.shape[0]):
        first = 0
        last = mask.shape[1]
        while first < last and mask[iy, first] == 0.0:
            first += 1
        while last > first and mask[iy, last - 1] == 0.0:
            last -= 1
        if first == last:
            continue
        for b in range(turns.shape[0]):
            for a in range(7):
                value = 0.0
                for power in range(6 - a, -1, -1):
                    value = value * y[iy] + turns[b, power, a]
                # Whole turns go before the cast: float32 keeps 1e-6 of the rest.
                row[a] = value - math.floor(value) if a == 0 else value
            _fill_row(
                row,
                x32[first:last],
                mask[iy, first:last],
                cosine,
                sine,
                field[b, iy, first:last].view(np.float32),
            )


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


@njit(cache=True, nogil=True, fastmath=True)
def integrate_pixels(field, center, window, kx, ky, filter_x, filter_y, scale, kernel):
    """Integrate |field|² over the pixels of a window and write them to the kernel.

    Parameters
    ----------
    field : (N, N) complex64
        Spectrum of the pupil, not shifted: sample j stands for center + j, or
        center + j - N beyond the middle.
    center : (2,) int64
        Window centre (x, y) in angular samples.
    window : (4,) int64
        Pixel offsets x0, x1, y0, y1 (y upward, ends included) to fill.
    kx, ky : int
        Samples per pixel.
    filter_x, filter_y : (2*reach+1,) float32
    scale : float
        Share of the light per unit of summed intensity.
    kernel : (2R+1, 2R+1) float32
        Image orientation; only the window is written.
    """
    n = field.shape[0]
    half = n // 2
    radius = kernel.shape[0] // 2
    reach_x, reach_y = filter_x.shape[0] // 2, filter_y.shape[0] // 2
    x0, x1, y0, y1 = window[0], window[1], window[2], window[3]
    n_x, n_y = x1 - x0 + 1, y1 - y0 + 1
    if n_x <= 0 or n_y <= 0:
        return
    pad = reach_x + kx
    line = np.zeros(n + 2 * pad, np.float32)
    start = x0 * kx - center[0] + half - reach_x + pad
    sums = np.zeros((n_y, n_x), np.float32)
    row = np.empty(n_x, np.float32)
    first_row = max(0, y0 * ky - center[1] + half - reach_y)
    last_row = min(n - 1, y1 * ky - center[1] + half + reach_y)
    for j in range(first_row, last_row + 1):
        parts = field[(j + half) % n].view(np.float32)
        _intensity(parts[:n], line[pad + half : pad + n])
        _intensity(parts[n:], line[pad : pad + half])
        for q in range(n_x):
            first = start + q * kx
            row[q] = _dot(line[first : first + filter_x.shape[0]], filter_x)
        # Row j meets the pixels whose filter covers it.
        position = j - half + center[1]
        q_low = max(y0, -((reach_y - position) // ky))
        q_high = min(y1, (position + reach_y) // ky)
        for q in range(q_low, q_high + 1):
            weight = filter_y[position - q * ky + reach_y]
            _accumulate(weight, row, sums[q - y0])
    for q in range(n_y):
        for i in range(n_x):
            kernel[radius - (y0 + q), radius + x0 + i] = scale * sums[q, i]
