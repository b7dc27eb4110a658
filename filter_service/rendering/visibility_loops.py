"""Compiled loops that find which points of the pupil see a source."""

import math

import numpy as np
from numba import njit

MAX_STEPS = 256
"""Largest number of steps along a ray, about a pixel each."""

SAMPLES = 3
"""Points along each side of a source whose rays to an edge element are averaged."""

SQUARE_PX = 16
"""Edge of the squares that bound the distances along a ray."""


@njit(cache=True, nogil=True, error_model="numpy")
def least_in_squares(start, end, depth_bits, least_bits):
    """Write the least positive depth in squares (rows, columns).

    Depth is compared as integers, as positive floats are ordered as their bits.
    """
    height, width = depth_bits.shape
    infinity = np.int32(0x7F800000)
    least = np.empty(width, np.int32)
    for row in range(start, end):
        least[:] = infinity
        for y in range(row * SQUARE_PX, min((row + 1) * SQUARE_PX, height)):
            for x in range(width):
                bits = depth_bits[y, x]
                least[x] = min(least[x], bits if bits > 0 else infinity)
        for column in range(least_bits.shape[1]):
            first = column * SQUARE_PX
            least_bits[row, column] = least[first : first + SQUARE_PX].min()


@njit(cache=True, nogil=True, error_model="numpy")
def visible_edges(start, end, places, shift_px, front, nearest_dpt, seen):
    """Write which elements (n_edge,) of the pupil's edge see each source.

    On its way to a point of the pupil, a ray has the position of its source plus a
    displacement in proportion to its vergence relative to the source.  A surface blocks
    it where both have the same vergence.

    Parameters
    ----------
    places : x_px, y_px, object_dpt, kind, is_hidden, each (n,)
    shift_px : (n_kinds, n_edge, 2)
        Displacement per diopter of rays to the elements.
    front : depth_m (h, w), tangents (4,)
        Visible surface; tangents of the image's edges if depth is along z, else NaN.
    nearest_dpt : (rows, columns)
        Upper bounds on the distance of surfaces in squares of `SQUARE_PX`.
    seen : (n, n_edge), float32
    """
    x_px, y_px, object_dpt, kinds, is_hidden = places
    n_edge = shift_px.shape[1]
    for k in range(start, end):
        own, shift = object_dpt[k], shift_px[kinds[k]]
        longest_px = 0.0
        for m in range(n_edge):
            longest_px = max(longest_px, math.hypot(shift[m, 0], shift[m, 1]))
        seen[k] = 1.0
        nearest = _nearest_dpt(x_px[k], y_px[k], own, longest_px, nearest_dpt)
        moved_px = longest_px * (nearest - own)
        if nearest <= own or (moved_px < 0.5 and not is_hidden[k]):
            continue
        steps = min(math.ceil(moved_px), MAX_STEPS)
        ray = own, (nearest - own) / steps, steps, is_hidden[k]
        for m in range(n_edge):
            seen[k, m] = not _is_blocked(x_px[k], y_px[k], shift[m], ray, front)
        previous = seen[k].copy()
        for m in range(n_edge):
            before, after = previous[m - 1], previous[(m + 1) % n_edge]
            if before == previous[m] == after:
                continue
            total = 0.0  # over the area of the source
            for i in range(SAMPLES * SAMPLES):
                x = x_px[k] + (i % SAMPLES + 0.5) / SAMPLES - 0.5
                y = y_px[k] + (i // SAMPLES + 0.5) / SAMPLES - 0.5
                total += not _is_blocked(x, y, shift[m], ray, front)
            seen[k, m] = total / (SAMPLES * SAMPLES)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_blocked(x_px, y_px, per_dpt_px, ray, front):
    """Return whether the visible surface blocks a ray."""
    own, step, steps, is_hidden = ray
    depth_m, tangents = front
    height, width = depth_m.shape
    # The source itself must not block its rays where its surface is slanted.
    least = own if is_hidden else own + 0.3 * step + 0.01 * own
    for i in range(steps + 1):
        low, high = max(least, own + (i - 0.5) * step), own + (i + 1) * step
        surface = own + min(i + 0.5, steps) * step
        for _ in range(2):  # within the step, and where it meets the surface found
            at = surface - own
            x = math.floor(x_px + per_dpt_px[0] * at + 0.5)
            y = math.floor(y_px + per_dpt_px[1] * at + 0.5)
            x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
            surface = _pixel_dpt(x, y, depth_m, tangents)
            if not low < surface <= high:
                break
        else:
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel_dpt(x, y, depth_m, tangents):
    """Return the object distance of a pixel; 0 where depth is missing."""
    depth = depth_m[y, x]
    if not depth > 0.0:
        return 0.0
    if math.isnan(tangents[0]):
        return 1.0 / depth
    left, right, up, down = tangents
    a = left + (right - left) * (x + 0.5) / depth_m.shape[1]
    b = up + (down - up) * (y + 0.5) / depth_m.shape[0]
    return 1.0 / (depth * math.sqrt(1.0 + a * a + b * b))


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_dpt(x_px, y_px, own_dpt, per_dpt_px, nearest_dpt):
    """Return an upper bound on the distance, dpt, of surfaces that rays may meet."""
    rows, columns = nearest_dpt.shape
    row, column = int(y_px) // SQUARE_PX, int(x_px) // SQUARE_PX
    around = min(MAX_STEPS, int(per_dpt_px * (nearest_dpt.max() - own_dpt)) + 1)
    around = around // SQUARE_PX + 1
    found = own_dpt
    for i in range(max(row - around, 0), min(row + around, rows - 1) + 1):
        for j in range(max(column - around, 0), min(column + around, columns - 1) + 1):
            away_px = SQUARE_PX * (max(abs(i - row), abs(j - column)) - 1)
            if away_px <= per_dpt_px * (nearest_dpt[i, j] - own_dpt):
                found = max(found, nearest_dpt[i, j])
    return found
