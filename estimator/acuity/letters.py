"""The ten Sloan letters as shapes, five units high and wide.

A shape is a function of positions x, y (arrays, 0 to 5 units, y up) that returns a mask
of the ink.  Straight strokes are one unit wide, as on charts; slanted strokes match
that to a tenth of a unit.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

UNITS = 5.0
"""Height and width of a letter, in stroke widths."""

Ink = NDArray[np.bool_]
Places = NDArray[np.float64]
Pair = tuple[float, float]


def _box(x: Places, y: Places, x_range: Pair, y_range: Pair) -> Ink:
    inside_x = (x >= x_range[0]) & (x <= x_range[1])
    return inside_x & (y >= y_range[0]) & (y <= y_range[1])


def _ring(x: Places, y: Places, center: Pair, outer: float) -> Ink:
    radius = np.hypot(x - center[0], y - center[1])
    return (radius <= outer) & (radius >= outer - 1.0)


def _polygon(x: Places, y: Places, corners: Sequence[tuple[float, float]]) -> Ink:
    """Return the inside of a convex polygon with counterclockwise corners."""
    inside = np.ones(np.broadcast_shapes(x.shape, y.shape), dtype=bool)
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0.0
    return inside


def _left_bar(x: Places, y: Places) -> Ink:
    return _box(x, y, (0, 1), (0, 5))


def _c(x: Places, y: Places) -> Ink:
    return _o(x, y) & ~_box(x, y, (2.5, 5), (2, 3))


def _d(x: Places, y: Places) -> Ink:
    flats = _box(x, y, (0, 2.5), (0, 1)) | _box(x, y, (0, 2.5), (4, 5))
    bow = _ring(x, y, (2.5, 2.5), 2.5) & (x >= 2.5)
    return _left_bar(x, y) | flats | bow


def _h(x: Places, y: Places) -> Ink:
    return _left_bar(x, y) | _box(x, y, (4, 5), (0, 5)) | _box(x, y, (0, 5), (2, 3))


def _k(x: Places, y: Places) -> Ink:
    arm = _polygon(x, y, [(1, 1.35), (5, 5), (3.6, 5), (1, 2.63)])
    leg = _polygon(x, y, [(3.7, 0), (5, 0), (2.69, 3.39), (1.94, 2.585)])
    return _left_bar(x, y) | arm | leg


def _n(x: Places, y: Places) -> Ink:
    slant = _polygon(x, y, [(3.75, 0), (5, 0), (1.25, 5), (0, 5)])
    return _left_bar(x, y) | _box(x, y, (4, 5), (0, 5)) | slant


def _o(x: Places, y: Places) -> Ink:
    return _ring(x, y, (2.5, 2.5), 2.5)


def _r(x: Places, y: Places) -> Ink:
    flats = _box(x, y, (0, 3.5), (4, 5)) | _box(x, y, (0, 3.5), (2, 3))
    bow = _ring(x, y, (3.5, 3.5), 1.5) & (x >= 3.5)
    leg = _polygon(x, y, [(3.75, 0), (5, 0), (3.35, 2.5), (2.1, 2.5)])
    return _left_bar(x, y) | flats | bow | leg


def _s(x: Places, y: Places) -> Ink:
    upper, lower = _ring(x, y, (1.5, 3.5), 1.5), _ring(x, y, (3.5, 1.5), 1.5)
    bows = (upper & (x <= 1.5)) | (lower & (x >= 3.5))
    top_end = _ring(x, y, (3.5, 3.5), 1.5) & (x >= 3.5) & (y >= 3.5)
    bottom_end = _ring(x, y, (1.5, 1.5), 1.5) & (x <= 1.5) & (y <= 1.5)
    flats = np.isin(np.floor(np.clip(y, 0, 4.999)), (0, 2, 4)) & (np.abs(x - 2.5) <= 1)
    return bows | top_end | bottom_end | flats


def _v(x: Places, y: Places) -> Ink:
    left = _polygon(x, y, [(1.9, 0), (3.1, 0), (1.15, 5), (0, 5)])
    right = _polygon(x, y, [(1.9, 0), (3.1, 0), (5, 5), (3.85, 5)])
    return left | right


def _z(x: Places, y: Places) -> Ink:
    flats = _box(x, y, (0, 5), (0, 1)) | _box(x, y, (0, 5), (4, 5))
    slant = _polygon(x, y, [(0, 1), (1.4, 1), (5, 4), (3.6, 4)])
    return flats | slant


SLOAN_LETTERS: dict[str, Callable[[Places, Places], Ink]] = {
    **{"C": _c, "D": _d, "H": _h, "K": _k, "N": _n},
    **{"O": _o, "R": _r, "S": _s, "V": _v, "Z": _z},
}
