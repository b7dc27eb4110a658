"""Transfer of wavefronts to another plane along the chief ray.

Instruments and networks give wavefronts at the cornea, but PSFs are computed in the
entrance pupil.  By the eikonal equation, dW/dz = -|grad W|² / 2 for slopes of a few
mrad/mm.  Its solution follows rays: each moves by its slope, and W grows by half the
squared slope.  A moved wavefront has terms of all orders, and the terms up to a radial
order are fitted to it.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.native import core, shared_threads
from estimator.optics.units import UM_PER_MM
from estimator.optics.zernike import (
    MAX_TERMS,
    exponents,
    monomial_degrees,
    monomial_matrix,
    radial_order,
)
from estimator.wavefront.field_wavefronts import zernike_from_polynomial
from estimator.wavefront.nodes import circle_nodes, circle_sampling

_ANGLES = 2.0 * np.pi * np.arange(16) / 16
_RIM = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)

TILT = [1, 2]


FIT_ERROR_UM = 0.003
"""RMS of the terms of a moved wavefront up to `HIGHEST_ORDER` that a fit may omit.

The preset `keratoconus` keeps 28 terms; 1.5 times its coefficients need more."""


@cache
def _rays(n_terms: int) -> NDArray[np.float64]:
    """Return x, y and weight (n, 3) of nodes over the unit circle.

    96 nodes determine sixth-order fits, and 260 nodes tenth-order fits.
    """
    rings, weights, azimuths, _ = circle_nodes(*circle_sampling(n_terms))
    points = (azimuths[:, None, :] * rings[:, None]).reshape(-1, 2)
    return np.column_stack([points, np.tile(weights, len(azimuths))])


def moved_polynomial(
    polynomial_um: NDArray[np.float64],
    *,
    depth_mm: ArrayLike,
    radius_mm: ArrayLike,
    n_terms: int | None = None,
) -> NDArray[np.float64]:
    """Return wavefronts (..., n_terms) in a plane deeper in the eye.

    The result is the least-squares fit to the rays through a circle.  Without the fit,
    in keratoconus over 5 mm, the error would be 0.042 um instead of 0.001 um.

    Parameters
    ----------
    polynomial_um : (..., n_given_terms), um/mm^degree
        Monomials; see `field_wavefronts.polynomial_in_mm`.
    depth_mm : (...)
        Distance between the planes; negative if the new plane is in front.
    radius_mm : (...)
        Radius of the circle about the chief ray, in the plane of the given wavefronts.
    n_terms : int, optional
        Number of terms of the result, at least the number given, which is the default.
    """
    shape, count = polynomial_um.shape[:-1], polynomial_um[..., 0].size
    given = polynomial_um.shape[-1]
    n_terms = n_terms or given
    order = radial_order(given)
    depth_mm, radius_mm = (
        np.broadcast_to(np.asarray(values, np.float64), shape).reshape(count, 1)
        for values in (depth_mm, radius_mm)
    )
    tables_um = np.zeros((count, order + 1, order + 1))
    start_um = polynomial_um.reshape(count, -1) * radius_mm ** monomial_degrees(given)
    # tilt is an artifact of the fit: the chief ray has no slope
    start_um[:, TILT] = 0.0
    tables_um[:, *exponents(given).T] = start_um
    reach = depth_mm[:, 0] / (UM_PER_MM * radius_mm[:, 0] ** 2)
    rays, matrix = _rays(n_terms), monomial_matrix(n_terms)
    moved_um = np.zeros((count, n_terms))
    sizes = (count, len(rays), order, n_terms)
    arrays = (tables_um, reach, rays, matrix)
    if core().call("moved_fits", shared_threads(), *arrays, *sizes, moved_um):
        raise MemoryError("no memory for moved wavefronts")
    moved_um /= radius_mm ** monomial_degrees(n_terms)
    moved_um = moved_um.reshape(*shape, -1)
    moved_um[..., 0] = polynomial_um[..., 0]
    moved_um[..., TILT] += polynomial_um[..., TILT]
    return moved_um


def moved_wavefront(
    polynomial_um: NDArray[np.float64], *, depth_mm: float, radius_mm: float
) -> NDArray[np.float64]:
    """Return a wavefront in a deeper plane, with as many terms as it needs there.

    The number of terms does not change unless the terms up to `HIGHEST_ORDER` that such
    a fit omits exceed `FIT_ERROR_UM`.

    Parameters
    ----------
    polynomial_um : (n_given_terms,), um/mm^degree
    depth_mm, radius_mm : float
        As in `moved_polynomial`.
    """
    place = {"depth_mm": depth_mm, "radius_mm": radius_mm}
    whole_um = moved_polynomial(polynomial_um, **place, n_terms=MAX_TERMS)
    zernike_um = zernike_from_polynomial(whole_um, radius_mm)
    order = radial_order(polynomial_um.size)
    while True:
        n_terms = (order + 1) * (order + 2) // 2
        if np.linalg.norm(zernike_um[n_terms:]) <= FIT_ERROR_UM:
            return moved_polynomial(polynomial_um, **place, n_terms=n_terms)
        order += 1


def moved_rim(
    rim_mm: NDArray[np.float64],
    polynomial_um: NDArray[np.float64],
    *,
    depth_mm: ArrayLike,
) -> NDArray[np.float64]:
    """Return rims (..., 5), center and matrix, where their rays meet deeper planes.

    Parameters
    ----------
    rim_mm : (..., 5)
    polynomial_um : (..., n_terms), um/mm^degree
        Wavefronts before the transfer.
    depth_mm : (...)
    """
    x, y, xx, xy, yy = np.moveaxis(rim_mm, -1, 0)[..., None]
    cosine, sine = _RIM.T
    px, py = x + xx * cosine + xy * sine, y + xy * cosine + yy * sine
    slopes = np.zeros((*px.shape, 2))
    powers = exponents(polynomial_um.shape[-1]).tolist()
    for k, (a, b) in enumerate(powers[3:], 3):
        factor = polynomial_um[..., k, None]
        if a:
            slopes[..., 0] += factor * a * px ** (a - 1) * py**b
        if b:
            slopes[..., 1] += factor * b * px**a * py ** (b - 1)
    step = np.asarray(depth_mm, dtype=np.float64)[..., None, None] / UM_PER_MM
    moved = np.stack([px, py], axis=-1) + step * slopes
    center = moved.mean(axis=-2)
    matrix = 2.0 * np.swapaxes(moved, -1, -2) @ _RIM / len(_RIM)
    # The symmetric root of the square has the same rim as the matrix.
    square = matrix @ np.swapaxes(matrix, -1, -2)
    root = np.sqrt(np.linalg.det(square))
    scale = 1.0 / np.sqrt(square[..., 0, 0] + square[..., 1, 1] + 2.0 * root)
    columns = [
        *(center[..., 0], center[..., 1]),
        scale * (square[..., 0, 0] + root),
        scale * square[..., 0, 1],
        scale * (square[..., 1, 1] + root),
    ]
    return np.stack(columns, axis=-1)
