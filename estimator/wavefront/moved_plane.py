"""Transfer of wavefronts to another plane along the chief ray, from coefficients alone.

Instruments and networks give them at the cornea; images are computed in the entrance
pupil.  Light that leaves the eye obeys the eikonal equation; for slopes of a few
mrad/mm dW/ddepth = -|grad W|² / 2, an equation that is closed in the terms up to the
sixth order where the chief ray has no slope.
"""

from collections import Counter
from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from estimator.optics.units import UM_PER_MM
from estimator.optics.zernike import EXPONENTS, N_TERMS

_ANGLES = 2.0 * np.pi * np.arange(16) / 16
_RIM = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)


@cache
def _slope_products() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return terms (n, 3) and factors (n,): i and j of W add to k of |grad W|²."""
    place = {tuple(e): k for k, e in enumerate(EXPONENTS.tolist())}
    found: Counter[tuple[int, int, int]] = Counter()
    for i, (a, b) in enumerate(EXPONENTS.tolist()):
        for j, (c, d) in enumerate(EXPONENTS.tolist()):
            for factor, term in (
                (a * c, (a + c - 2, b + d)),
                (b * d, (a + c, b + d - 2)),
            ):
                if factor and term in place:
                    found[min(i, j), max(i, j), place[term]] += factor
    return np.array(list(found)), np.array(list(found.values()), np.float64)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _add_products(
    polynomial_um: NDArray[np.float64],
    terms: NDArray[np.int64],
    factors: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    for n in range(polynomial_um.shape[0]):
        for m in range(terms.shape[0]):
            i, j, k = terms[m]
            out[n, k] += factors[m] * polynomial_um[n, i] * polynomial_um[n, j]


def _squared_slopes(polynomial_um: NDArray[Any]) -> NDArray[np.float64]:
    found = np.zeros_like(polynomial_um)
    flat = np.ascontiguousarray(polynomial_um).reshape(-1, N_TERMS)
    _add_products(flat, *_slope_products(), found.reshape(-1, N_TERMS))
    return found


def moved_polynomial(
    polynomial_um: NDArray[np.float64], *, depth_mm: ArrayLike
) -> NDArray[np.float64]:
    """Return wavefronts (..., 28) in planes (...) mm deeper, toward the eye.

    Monomials in mm, as in `field_wavefronts.polynomial_in_mm`.  One Runge-Kutta step
    of fourth order: moving 30 dpt by 3 mm errs by 1e-5 dpt.
    """
    step = np.asarray(depth_mm, dtype=np.float64)[..., None] / (-2.0 * UM_PER_MM)
    start = polynomial_um.copy()
    start[..., 1:3] = 0.0  # an artifact of the fit: the chief ray has no slope
    k1 = _squared_slopes(start)
    k2 = _squared_slopes(start + step / 2.0 * k1)
    k3 = _squared_slopes(start + step / 2.0 * k2)
    k4 = _squared_slopes(start + step * k3)
    return polynomial_um + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def moved_rim(
    rim_mm: NDArray[np.float64],
    polynomial_um: NDArray[np.float64],
    *,
    depth_mm: ArrayLike,
) -> NDArray[np.float64]:
    """Return rims (..., 5), center and matrix, where their rays meet deeper planes.

    Parameters
    ----------
    polynomial_um : (..., 28)
        Wavefronts before the move.
    """
    x, y, xx, xy, yy = np.moveaxis(rim_mm, -1, 0)[..., None]
    cosine, sine = _RIM.T
    px, py = x + xx * cosine + xy * sine, y + xy * cosine + yy * sine
    slopes = np.zeros((2, *px.shape))
    for k in range(3, N_TERMS):
        (a, b), factor = EXPONENTS[k], polynomial_um[..., k, None]
        if a:
            slopes[0] += factor * a * px ** (a - 1) * py**b
        if b:
            slopes[1] += factor * b * px**a * py ** (b - 1)
    moved = np.stack([px, py], axis=-1) + np.asarray(depth_mm)[..., None, None] * (
        np.moveaxis(slopes, 0, -1) / UM_PER_MM
    )
    center = moved.mean(axis=-2)
    matrix = 2.0 * np.swapaxes(moved, -1, -2) @ _RIM / len(_RIM)
    square = matrix @ np.swapaxes(matrix, -1, -2)
    root = np.sqrt(np.linalg.det(square))
    trace = square[..., 0, 0] + square[..., 1, 1]
    scale = 1.0 / np.sqrt(trace + 2.0 * root)
    return np.stack(
        [
            center[..., 0],
            center[..., 1],
            scale * (square[..., 0, 0] + root),
            scale * square[..., 0, 1],
            scale * (square[..., 1, 1] + root),
        ],
        axis=-1,
    )
