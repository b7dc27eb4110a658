"""Compiled loops of `bright_pixels.py`, see `haze.run_in_threads`."""

import math

import numpy as np
from numba import njit

from filter_service.constants import RGB

MAX_LIGHT = 1e30
"""Brightest light of a source, so that sums of sources remain finite in float32."""


@njit(cache=True, nogil=True, error_model="numpy")
def count_bright(start, end, bits, limit, counts):
    """Count the pixels (h,) of each row with a value above a limit.

    ``bits`` (h, 3 w) are floats as integers: positive floats are ordered as their bits,
    and integers are compared faster.
    """
    for y in range(start, end):
        largest = bits[y, 0]
        for i in range(bits.shape[1]):
            largest = max(largest, bits[y, i])
        counts[y] = 0
        if largest > limit:
            for i in range(0, bits.shape[1], RGB):
                counts[y] += _is_bright(bits, y, i, limit)


@njit(cache=True, nogil=True, error_model="numpy")
def list_bright(start, end, bits, limit, offsets, y_px, x_px):
    """Write y and x (n,) of these pixels, from an offset (h + 1,) for each row on."""
    for y in range(start, end):
        n = offsets[y]
        if offsets[y + 1] > n:
            for i in range(0, bits.shape[1], RGB):
                if _is_bright(bits, y, i, limit):
                    y_px[n], x_px[n] = y, i // RGB
                    n += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _is_bright(bits, y, i, limit):
    return max(bits[y, i], max(bits[y, i + 1], bits[y, i + 2])) > limit


@njit(cache=True, nogil=True, error_model="numpy")
def fade_light(color, white, fade, share, light):
    """Write the share (n,) of the light (n, 3) of pixels (n, 3) that is a source's.

    It fades in between two ratios to white.  Values that are not finite have none.
    """
    low, high = fade
    for k in range(share.size):
        brightest = 0.0
        for c in range(RGB):
            light[k, c] = 0.0
            if math.isfinite(color[k, c]):
                light[k, c] = min(max(color[k, c], 0.0), MAX_LIGHT)
                brightest = max(brightest, light[k, c])
        part = 1.0
        if brightest < high * white:
            part = max((brightest / white - low) / (high - low), 0.0)
            part = part * part * (3.0 - 2.0 * part)
        share[k] = part
        for c in range(RGB):
            light[k, c] *= part


@njit(cache=True, nogil=True, error_model="numpy")
def merge_pixels(y_px, x_px, surface, light, squares, source, sums, at):
    """Merge pixels (n,) of equal squares into sources; return their number.

    Parameters
    ----------
    squares : power, index (surfaces, rows, columns)
        The edge of the squares is 2**power; the index is scratch, -1.
    source : (n,)
        Output: source of each pixel.
    sums : (n, 6)
        Output: sums of light and, weighed with it, of x and y; largest light.
    at : (n,)
        Output: brightest pixel of each source.
    """
    power, index = squares
    count = 0
    for k in range(y_px.size):
        row, column = y_px[k] >> power, x_px[k] >> power
        own = index[surface[k], row, column]
        if own < 0:
            own = index[surface[k], row, column] = count
            sums[own] = 0.0
            count += 1
        total = light[k, 0] + light[k, 1] + light[k, 2]
        for c in range(RGB):
            sums[own, c] += light[k, c]
        sums[own, 3] += total * x_px[k]
        sums[own, 4] += total * y_px[k]
        if total > sums[own, 5]:
            sums[own, 5], at[own] = total, k
        source[k] = own
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def dim_pixels(y_px, x_px, source, share, kind, ratio, image):
    """Multiply pixels of an image (h, w, 3) by 1 - share ratio[kind], in place."""
    for k in range(y_px.size):
        for c in range(RGB):
            part = share[k] * ratio[kind[source[k]], c]
            image[y_px[k], x_px[k], c] *= np.float32(1.0 - part)
