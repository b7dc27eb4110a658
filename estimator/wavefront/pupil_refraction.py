"""Least-squares refraction over the light that passes the pupil.

On a round pupil that is -4 sqrt(3) C(2,0) / r².  Where the projected iris is elliptical
or decentered from the chief ray, it is the least squares over that shape: with the
wavefront of a cataract the two differ by 0.1 dpt at 7 mm.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import EXPONENTS

N_RINGS, N_AZIMUTHS = 5, 14
"""Exact for products of the sixth order and the second."""


@cache
def _disc() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (n, 2) of the unit disc and their shares (n,) of its area."""
    unit, weights = np.polynomial.legendre.leggauss(N_RINGS)
    radius = np.sqrt(0.5 + 0.5 * unit)
    angle = 2.0 * np.pi * np.arange(N_AZIMUTHS) / N_AZIMUTHS
    points = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    shares = np.repeat(0.5 * weights / N_AZIMUTHS, N_AZIMUTHS)
    return points.reshape(-1, 2), shares


def pupil_refraction_dpt(
    polynomial_um: NDArray[np.float64], rim_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return M (...), dpt, of wavefronts (..., 28) over pupils (..., 5).

    Parameters
    ----------
    polynomial_um : monomials in mm, see `field_wavefronts.polynomial_in_mm`
    rim_mm : center and matrix, see `field_wavefronts.rim_from_ellipse`
    """
    points, shares = _disc()
    cosine, sine = points.T
    x, y, xx, xy, yy = np.moveaxis(rim_mm, -1, 0)[..., None]
    px, py = x + xx * cosine + xy * sine, y + xy * cosine + yy * sine
    wave_um = sum(
        polynomial_um[..., k, None] * px**a * py**b
        for k, (a, b) in enumerate(EXPONENTS.tolist())
    )
    # 1, x and y are orthogonal over the unit disc: project out piston and tilt.
    plane = np.stack([np.ones_like(cosine), 2.0 * cosine, 2.0 * sine])
    bowl = px**2 + py**2
    bowl = bowl - (bowl * shares) @ plane.T @ plane
    flat = 2.0 * (wave_um * shares * bowl).sum(axis=-1)
    found_dpt: NDArray[np.float64] = -flat / (bowl**2 * shares).sum(axis=-1)
    return found_dpt
