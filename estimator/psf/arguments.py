"""Argument checks of the PSF engines; each returns the argument in canonical form.

They raise ValueError with the name of the argument, its value and the allowed range.
"""

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.zernike import DEFAULT_ORDER, HIGHEST_ORDER
from estimator.psf.pupil import ELLIPSE_COLUMNS

TERM_COUNTS = tuple(
    (order + 1) * (order + 2) // 2 for order in range(DEFAULT_ORDER, HIGHEST_ORDER + 1)
)


def broadcast_copy(values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return values broadcast to ``shape`` as a writable array in C order.

    `numpy.broadcast_to` returns a view that is read-only and may repeat its elements.

    Raises
    ------
    ValueError
        The values do not broadcast to the shape.
    """
    return np.array(np.broadcast_to(values, shape), dtype=np.float64, order="C")


def checked_zernike_um(zernike_um: ArrayLike) -> NDArray[np.float64]:
    """Return finite coefficients (P, n_terms), of a radial order from 6 to 10."""
    array = np.asarray(zernike_um, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in TERM_COUNTS:
        raise ValueError(
            f"zernike_um has shape {array.shape}: must be (P, n), n one of "
            f"{', '.join(map(str, TERM_COUNTS))}"
        )
    if not np.all(np.isfinite(array)):
        raise ValueError("zernike_um: must be finite, got NaN or infinite coefficients")
    return array


def checked_positive(name: str, values: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return positive numbers, scalar or (P,), as (P,)."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim > 1 or (array.ndim == 1 and array.size not in (1, count)):
        raise ValueError(
            f"{name} has shape {array.shape}: must be scalar or ({count},)"
        )
    if not (np.all(np.isfinite(array)) and np.all(array > 0)):
        raise ValueError(f"{name} {values!s}: must be positive and finite")
    return broadcast_copy(array, (count,))


def checked_choice(name: str, value: str, allowed: Collection[str]) -> None:
    """Raise unless the value is one of the allowed ones."""
    if value not in allowed:
        raise ValueError(f"{name} {value!r}: must be one of {', '.join(allowed)}")


def checked_scale(
    pixel_pitch_mrad: ArrayLike | None, pixel_from_mrad: ArrayLike | None, count: int
) -> NDArray[np.float64]:
    """Return Jacobians (P, 2, 2) from either a pixel pitch or Jacobians."""
    if (pixel_pitch_mrad is None) == (pixel_from_mrad is None):
        raise ValueError("expected either pixel_pitch_mrad or pixel_from_mrad")
    if pixel_from_mrad is None:
        try:
            pitch = np.broadcast_to(np.asarray(pixel_pitch_mrad, np.float64), (2,))
        except ValueError:
            raise ValueError(
                f"pixel_pitch_mrad {pixel_pitch_mrad!s}: must be scalar or (x, y)"
            ) from None
        if not (np.all(np.isfinite(pitch)) and np.all(pitch > 0)):
            raise ValueError(f"pixel_pitch_mrad {pixel_pitch_mrad!s}: must be positive")
        return broadcast_copy(np.diag(1.0 / pitch), (count, 2, 2))
    array = np.asarray(pixel_from_mrad, dtype=np.float64)
    if array.shape not in ((2, 2), (count, 2, 2)):
        raise ValueError(
            f"pixel_from_mrad has shape {array.shape}: must be (2, 2) "
            f"or ({count}, 2, 2)"
        )
    determinant = np.linalg.det(array)
    if not np.all(np.isfinite(array)) or not np.all(determinant > 0.0):
        raise ValueError(
            "pixel_from_mrad must be finite with a positive determinant (x right, y "
            f"up on both sides); the least is {np.min(determinant):.3g}"
        )
    return broadcast_copy(array, (count, 2, 2))


def checked_ellipse(
    pupil_ellipse: ArrayLike | None, circle_radius_mm: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return ellipses (P, 5), or None.

    They may extend beyond their circles by 2 % of the radius, because an ellipse fitted
    to a rim does so slightly.
    """
    if pupil_ellipse is None:
        return None
    count = circle_radius_mm.size
    array = np.asarray(pupil_ellipse, dtype=np.float64)
    if array.shape not in ((ELLIPSE_COLUMNS,), (count, ELLIPSE_COLUMNS)):
        raise ValueError(
            f"pupil_ellipse has shape {array.shape}: must be ({count}, 5), center x, "
            "center y, semi-major, semi-minor in mm and the angle in rad"
        )
    array = broadcast_copy(array, (count, ELLIPSE_COLUMNS))
    if not np.all(np.isfinite(array)) or not np.all(array[:, 2:4] > 0.0):
        raise ValueError("pupil_ellipse: semi-axes must be positive, all finite")
    angle = 2.0 * math.pi * np.arange(64) / 64
    cosine, sine = np.cos(array[:, 4:]), np.sin(array[:, 4:])
    major, minor = array[:, 2:3] * np.cos(angle), array[:, 3:4] * np.sin(angle)
    x = array[:, 0:1] + cosine * major - sine * minor
    y = array[:, 1:2] + sine * major + cosine * minor
    reach = np.hypot(x, y).max(axis=1) / circle_radius_mm
    if reach.size and reach.max() > 1.02:
        raise ValueError(
            f"pupil_ellipse {int(reach.argmax())} reaches {reach.max():.3f} radii of "
            "its circle: must lie within 1.02, wavefronts are not known beyond"
        )
    return array
