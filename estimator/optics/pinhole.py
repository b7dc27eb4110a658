"""Pinhole camera at the entrance pupil: directions, and local scale of the image.

PSFs are functions of visual angle, which a pinhole image magnifies by sec² radially and
by sec tangentially.  The PSF engines transform a PSF with the matrix that
`pixel_from_mrad` returns before they integrate it over pixels.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def _tangents(tangents: ArrayLike) -> tuple[float, float, float, float]:
    left, right, up, down = (float(t) for t in np.asarray(tangents, np.float64))
    if not (left < right and down < up):
        raise ValueError(
            f"tangents {(left, right, up, down)}: must be (left, right, up, down) with "
            "left < right and down < up"
        )
    return left, right, up, down


def tangents_at(
    x_px: ArrayLike, y_px: ArrayLike, *, tangents: ArrayLike, size_px: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the tangents (...), right and up, of the direction of an image point.

    Parameters
    ----------
    x_px, y_px : (...)
        Image position, y downward; the center of the top-left pixel is (0.5, 0.5).
    tangents : (left, right, up, down)
        Tangents of the angles to the image edges.
    size_px : (width, height)
    """
    left, right, up, down = _tangents(tangents)
    width, height = size_px
    x, y = np.asarray(x_px, np.float64), np.asarray(y_px, np.float64)
    return left + (right - left) * x / width, up + (down - up) * y / height


def direction_deg(
    tangent_x: ArrayLike, tangent_y: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return azimuth h and elevation v (...) of the direction (t_x, t_y, -1)."""
    x, y = np.asarray(tangent_x, np.float64), np.asarray(tangent_y, np.float64)
    h_deg = np.degrees(np.arctan(x))
    return h_deg, np.degrees(np.arctan2(y, np.hypot(1.0, x)))


def pixel_from_mrad(
    h_deg: ArrayLike, v_deg: ArrayLike, *, tangents: ArrayLike, size_px: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the Jacobian of a pinhole image with respect to visual angle.

    Parameters
    ----------
    h_deg, v_deg : (...)
        Direction to the source; within 90 degrees of the camera's axis.
    tangents : (left, right, up, down)
        Tangents of the angles to the image edges.
    size_px : (width, height)

    Returns
    -------
    jacobian : (..., 2, 2)
        Pixels (x right, y up) per mrad (along ex, ey): with u the unit vector to the
        source, ex = u x y normalized and ey = ex x u.

    Raises
    ------
    ValueError
        A direction is 90 degrees or more from the camera's axis.
    """
    left, right, up, down = _tangents(tangents)
    h, v = np.radians(np.asarray(h_deg, float)), np.radians(np.asarray(v_deg, float))
    if not np.all(np.cos(h) * np.cos(v) > 1e-3):
        raise ValueError("directions must lie within 90 degrees of the camera's axis")
    width, height = size_px
    cos_h, cos_v = np.cos(h), np.cos(v)
    jacobian = np.zeros((*np.broadcast(h, v).shape, 2, 2))
    # ex and ey are the directions of growing h and v: a step of d_ex turns h by
    # d_ex / cos v, a step of d_ey turns v by d_ey; t_x = tan h, t_y = tan v / cos h.
    jacobian[..., 0, 0] = 1.0 / (cos_v * cos_h**2)
    jacobian[..., 1, 0] = np.tan(v) * np.sin(h) / (cos_v * cos_h**2)
    jacobian[..., 1, 1] = 1.0 / (cos_v**2 * cos_h)
    per_tangent: NDArray[np.float64] = np.array(
        [width / (right - left), height / (up - down)]
    )
    return jacobian * per_tangent[:, None] / 1000.0
