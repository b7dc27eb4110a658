"""Point of a spectacle lens that the line of sight crosses, by gaze and by field."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.vergence import TYPICAL_ENTRANCE_PUPIL_MM

ROTATION_CENTER_MM = 13.5
"""Depth of the eye's center of rotation behind the cornea."""


def lens_point_mm(
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    *,
    vertex_mm: float,
    gaze_deg: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the points x and y (...), mm, where field directions cross a lens.

    The origin is in front of the pupil in primary gaze.  Gaze rotates about the eye's
    center of rotation, field directions about the entrance pupil.

    Parameters
    ----------
    h_deg, v_deg : (...)
        Field directions relative to the line of sight.
    vertex_mm : float
        Distance from lens to cornea.
    gaze_deg : (h, v)
        Gaze relative to the head.
    """
    by_gaze_mm = vertex_mm + ROTATION_CENTER_MM
    by_field_mm = vertex_mm + TYPICAL_ENTRANCE_PUPIL_MM
    x, y = (
        by_gaze_mm * np.tan(np.radians(gaze)) + by_field_mm * np.tan(direction)
        for gaze, direction in zip(
            gaze_deg, (np.radians(h_deg), np.radians(v_deg)), strict=True
        )
    )
    return x, y
