"""The accommodating lens: changes of diameter at constant volume.

The lens shrinks at constant volume, which steepens both surfaces (rule C).  Its
anterior pole, and the stop with it, moves forward by the growth of the thickness before
the equator, so the aqueous thins.  The eye length does not change.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.lens_shape import (
    ANTERIOR_THICKNESS_RATIO,
    CAP_VOLUME_RATIO,
    lens_shape,
)
from estimator.eye.parameters import EyeParameters, column

SMALLEST_DIAMETER_RATIO = 0.84
"""Ratio of the smallest lens diameter to the relaxed one.  The search of Csoba & Kunkli
2023 stopped at 0.91, where most of its published targets lie."""

SMALLEST_AQUEOUS_MM = 1.0
"""Depth of the anterior chamber below which the lens would press on the cornea."""

DIAMETER = column("lens_diameter_mm")
VOLUME = column("lens_volume_mm3")
AQUEOUS = column("aqueous_thickness_mm")


def accommodated_vectors(
    vector: NDArray[np.float64], *, lens_diameter_mm: ArrayLike
) -> NDArray[np.float64]:
    """Return vectors (P, 45) of one relaxed eye with lens diameters (P,)."""
    lens_diameter_mm = np.atleast_1d(np.asarray(lens_diameter_mm, dtype=np.float64))
    vectors = np.repeat(vector[None], lens_diameter_mm.size, axis=0)
    return accommodated_eyes(vectors, lens_diameter_mm)


def accommodated_eyes(
    vectors: NDArray[np.float64], lens_diameter_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return eyes (P, 45) with other lens diameters (P,) at constant volume."""
    volume_mm3 = vectors[:, VOLUME]
    relaxed = lens_shape(diameter_mm=vectors[:, DIAMETER], volume_mm3=volume_mm3)
    shape = lens_shape(diameter_mm=lens_diameter_mm, volume_mm3=volume_mm3)
    focused = vectors.copy()
    focused[:, DIAMETER] = lens_diameter_mm
    focused[:, AQUEOUS] -= shape.anterior_thickness_mm - relaxed.anterior_thickness_mm
    return focused


def accommodated(
    parameters: EyeParameters, *, lens_diameter_mm: float
) -> EyeParameters:
    """Return the same eye with another lens diameter at constant volume.

    Raises
    ------
    ValueError
        The diameter is not positive.
    """
    vectors = accommodated_vectors(
        parameters.to_vector(), lens_diameter_mm=lens_diameter_mm
    )
    return replace(
        parameters,
        lens_diameter_mm=float(vectors[0, DIAMETER]),
        aqueous_thickness_mm=float(vectors[0, AQUEOUS]),
    )


def smallest_diameter_mm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest lens diameters (...) of relaxed eyes (..., 45).

    The limit is `SMALLEST_DIAMETER_RATIO` of the relaxed diameter, or the diameter that
    leaves the chamber `SMALLEST_AQUEOUS_MM` deep: the lens thickens before its equator
    by c (1/D² - 1/D0²), c = 8 eta V tau / (pi (1 + tau)), see `lens_shape`.
    """
    relaxed_mm, volume_mm3 = vectors[..., DIAMETER], vectors[..., VOLUME]
    room_mm = np.maximum(vectors[..., AQUEOUS] - SMALLEST_AQUEOUS_MM, 0.0)
    c_mm3 = 8.0 / math.pi * CAP_VOLUME_RATIO * ANTERIOR_THICKNESS_RATIO * volume_mm3
    fitting_mm = (relaxed_mm**-2 + room_mm / c_mm3) ** -0.5
    return np.maximum(fitting_mm, SMALLEST_DIAMETER_RATIO * relaxed_mm)
