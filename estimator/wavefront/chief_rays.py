"""Lateral color: shift of the apparent direction of chief rays with wavelength.

The chief ray of a wavelength from direction u meets the retina at a point.  The
apparent direction is the one whose 555 nm chief ray meets the same point; it is found
by tracing from that point back through the center of the stop.  The shift is the angle
from u to the apparent direction.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.surfaces import EyeSurfaces, media_indices
from estimator.optics.units import MRAD_PER_RAD, REFERENCE_WAVELENGTH_NM
from estimator.wavefront import compiled


def chief_shift_mrad(
    eye: EyeSurfaces, *, fields_deg: ArrayLike, wavelengths_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return the lateral color of an eye relative to 555 nm.

    Parameters
    ----------
    eye : EyeSurfaces
    fields_deg : (n_fields, 2)
        Azimuth h and elevation v of the source.
    wavelengths_nm : (n_wavelengths,)

    Returns
    -------
    shift_mrad : (n_fields, n_wavelengths, 2)
        Direction cosines of the apparent direction along ex and ey of the field, times
        1000; nan if a chief ray fails.

    Raises
    ------
    ValueError
        The eye cannot be traced, or a wavelength is out of range.
    """
    shift_mrad: NDArray[np.float64] = chief_shifts_mrad(
        [eye], fields_deg=fields_deg, wavelengths_nm=wavelengths_nm
    )[0]
    return shift_mrad


def chief_shifts_mrad(
    eyes: Sequence[EyeSurfaces], *, fields_deg: ArrayLike, wavelengths_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return `chief_shift_mrad` (n_eyes, ...) of eyes with the same parts.

    Raises
    ------
    ValueError
        As `chief_shift_mrad`, or the eyes have different numbers of surfaces.
    """
    packed = compiled.packed_eyes(eyes)
    directions_rad = np.radians(np.atleast_2d(np.asarray(fields_deg, np.float64)))
    indices = np.stack([media_indices(e, np.atleast_1d(wavelengths_nm)) for e in eyes])
    reference = np.stack([media_indices(e, REFERENCE_WAVELENGTH_NM) for e in eyes])
    fields = compiled.Fields.of_grid(packed, indices, directions_rad)
    both = replace(fields, indices=np.concatenate([fields.indices, reference]))
    shifts = compiled.chief_shifts(both, len(fields.indices) + fields.eyes)
    shape = (len(eyes), len(directions_rad), indices.shape[1], 2)
    return MRAD_PER_RAD * shifts.reshape(shape)
