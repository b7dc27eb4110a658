"""Shares of pixels inside shapes, by many samples, and exact means of stripes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.stimuli.display import Display

Array = NDArray[np.float64]
Inside = Callable[[Array, Array], NDArray[np.bool_]]
"""Function from x, y in px from the middle (y up) to what is inside a shape."""

SAMPLES_ACROSS = 1024
"""Samples across a shape, at least: its edges are then right within 0.05 % of it."""

SAMPLE_LIMITS = (4, 256)
"""Smallest and largest number of samples across a pixel."""

BLOCK_SAMPLES = 1 << 22
"""Samples at a time, to limit memory."""


def covered(
    display: Display,
    inside: Inside,
    *,
    size_px: float,
    width_px: float | None = None,
    height_px: float | None = None,
) -> Array:
    """Return the share (height, width) of each pixel inside a shape.

    Parameters
    ----------
    display : Display
        Pixels.
    inside : callable
        The shape, about the middle of the picture.
    size_px : float
        Size of its parts, which determines the number of samples.
    width_px, height_px : float, optional
        Size of the box that contains the shape; ``size_px`` by default.
    """
    low, high = SAMPLE_LIMITS
    n = int(np.clip(math.ceil(SAMPLES_ACROSS / size_px), low, high))
    found = np.zeros((display.height_px, display.width_px))
    columns = _within(display.width_px, width_px or size_px)
    rows = _within(display.height_px, height_px or size_px)
    if not (columns.size and rows.size):
        return found
    steps = (np.arange(n) + 0.5) / n
    x_px = (columns[:, None] + steps).ravel() - 0.5 * display.width_px
    n_rows = max(1, BLOCK_SAMPLES // (n * x_px.size))
    for start in range(0, rows.size, n_rows):
        some = rows[start : start + n_rows]
        y_px = 0.5 * display.height_px - (some[:, None] + steps).ravel()
        mask = inside(x_px[None, :], y_px[:, None])
        shares = mask.reshape(some.size, n, columns.size, n).mean(axis=(1, 3))
        found[np.ix_(some, columns)] = shares
    return found


def _within(side_px: int, extent_px: float) -> NDArray[np.int64]:
    """Return the pixels of a side that a centered extent may reach."""
    half = 0.5 * extent_px + 1.0
    first, last = math.floor(0.5 * side_px - half), math.ceil(0.5 * side_px + half)
    return np.arange(max(first, 0), min(last, side_px))


def pixel_mean(
    first: Callable[[Array], Array],
    second: Callable[[Array], Array],
    at: Array,
    across: float,
    along: float,
) -> Array:
    """Return the exact mean over pixels of a function of one coordinate.

    Parameters
    ----------
    first, second : callable
        First and second antiderivative of the function.
    at : array
        Coordinate of the pixels' centers.
    across, along : float
        Change of the coordinate from side to side of a pixel, and from top to bottom.
        The mean is over the sum of two independent uniform distributions.
    """
    wide, narrow = max(abs(across), abs(along)), min(abs(across), abs(along))
    if narrow < 1e-6 * wide:
        found: Any = first(at + 0.5 * wide) - first(at - 0.5 * wide)
        return found / wide
    outer, inner = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    found = second(at + outer) - second(at + inner)
    found = found - second(at - inner) + second(at - outer)
    return found / (wide * narrow)
