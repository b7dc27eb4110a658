"""Lateral color: shift of the apparent direction of chief rays with wavelength.

The chief ray of a wavelength from direction u meets the retina at a point.  The
apparent direction is the one whose 555 nm chief ray meets the same point; it is found
by tracing from that point back through the center of the stop.  The shift is the angle
from u to the apparent direction.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.surfaces import EyeSurfaces, check_eye, media_indices, pack_eye
from estimator.optics.units import MRAD_PER_RAD, REFERENCE_WAVELENGTH_NM
from estimator.wavefront.chief_ray_kernels import fill_chief_shifts


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
    check_eye(eye)
    fields_rad = np.radians(np.atleast_2d(np.asarray(fields_deg, dtype=np.float64)))
    indices = media_indices(eye, np.atleast_1d(wavelengths_nm))
    shifts = np.empty((len(fields_rad), len(indices), 2))
    reference = media_indices(eye, REFERENCE_WAVELENGTH_NM)
    fill_chief_shifts(pack_eye(eye), indices, reference, fields_rad, shifts)
    return MRAD_PER_RAD * shifts
