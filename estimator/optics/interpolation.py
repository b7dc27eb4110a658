"""Splines and polynomials through given points.

SciPy has them, too, but `scipy.interpolate`, with the packages that it imports, takes
50 MB of each process of a service, and 0.3 s of its start.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


class CubicSpline:
    """Cubic spline whose first two and last two pieces are one polynomial each.

    Beyond the nodes, the first and the last piece continue.  With two or three nodes,
    the spline is a line or a parabola.

    Parameters
    ----------
    nodes : (n,)
        At least two, ascending.
    values : (n, ...)
        Values at the nodes.
    """

    def __init__(self, nodes: NDArray[np.float64], values: NDArray[np.float64]):
        self._nodes = nodes
        shape = (-1, *(1,) * (values.ndim - 1))
        steps = np.diff(nodes).reshape(shape)
        slopes = np.diff(values, axis=0) / steps
        found = _slopes_at_nodes(nodes, slopes.reshape(nodes.size - 1, -1))
        found = found.reshape(values.shape)
        bend = (found[:-1] + found[1:] - 2.0 * slopes) / steps
        # of the powers 0 to 3 of the distance from the node before, (4, n - 1, ...)
        self._powers = np.stack(
            [
                values[:-1],
                found[:-1],
                (slopes - found[:-1]) / steps - bend,
                bend / steps,
            ]
        )

    def __call__(self, at: ArrayLike) -> NDArray[np.float64]:
        """Return the values (*at, ...)."""
        piece, offset = self._pieces(at)
        constant, linear, square, cube = self._powers[:, piece]
        found: NDArray[np.float64] = (
            (cube * offset + square) * offset + linear
        ) * offset + constant
        return found

    def slopes(self, at: ArrayLike) -> NDArray[np.float64]:
        """Return the first derivatives (*at, ...)."""
        piece, offset = self._pieces(at)
        _, linear, square, cube = self._powers[:, piece]
        found: NDArray[np.float64] = (
            3.0 * cube * offset + 2.0 * square
        ) * offset + linear
        return found

    def _pieces(self, at: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the piece of each point, and the distance from its first node."""
        points = np.asarray(at, np.float64)
        piece = np.searchsorted(self._nodes, points, side="right") - 1
        piece = np.clip(piece, 0, self._nodes.size - 2)
        offset = points - self._nodes[piece]
        inner = (1,) * (self._powers.ndim - 2)
        return piece, np.reshape(offset, (*points.shape, *inner))


def _slopes_at_nodes(
    nodes: NDArray[np.float64], slopes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivatives (n, m) at nodes, from the slopes (n - 1, m) of chords."""
    count = nodes.size
    if count == 2:
        return np.repeat(slopes, 2, axis=0)
    steps = np.diff(nodes)
    before, after = steps[:-1], steps[1:]
    matrix = np.zeros((count, count))
    right = np.zeros((count, slopes.shape[1]))
    inner = np.arange(1, count - 1)
    matrix[inner, inner - 1] = after
    matrix[inner, inner] = 2.0 * (before + after)
    matrix[inner, inner + 1] = before
    right[1:-1] = 3.0 * (after[:, None] * slopes[:-1] + before[:, None] * slopes[1:])
    if count == 3:
        matrix[0, :2] = matrix[2, 1:] = 1.0
        right[[0, 2]] = 2.0 * slopes
    ends = () if count == 3 else ((0, slice(None)), (-1, slice(None, None, -1)))
    for row, order in ends:
        first, second = steps[order][:2]
        width = first + second
        matrix[row, order][:2] = second, width
        chord, following = slopes[order][:2]
        right[row] = (
            (first + 2.0 * width) * second * chord + first**2 * following
        ) / width
    return np.linalg.solve(matrix, right).astype(np.float64, copy=False)


def polynomial_through(
    x: NDArray[np.float64], y: NDArray[np.float64]
) -> Callable[[ArrayLike], NDArray[np.float64]]:
    """Return the polynomial through points (n,), by the barycentric formula.

    Its rounding is the same in every process.
    """
    gaps = x[:, None] - x + np.eye(x.size)
    weights = 1.0 / gaps.prod(axis=1)

    def polynomial(at: ArrayLike) -> NDArray[np.float64]:
        offsets = np.asarray(at, np.float64)[..., None] - x
        is_node = offsets == 0.0
        terms = weights / np.where(is_node, 1.0, offsets)
        between: NDArray[Any] = (terms * y).sum(axis=-1) / terms.sum(axis=-1)
        return np.where(is_node.any(axis=-1), y[is_node.argmax(axis=-1)], between)

    return polynomial
