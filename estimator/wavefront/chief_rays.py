"""Lateral color: apparent direction of each wavelength's chief ray.

Light of one wavelength from a direction u goes through the center of the stop to a
point of the retina.  The eye attributes it to the direction whose light at 555 nm ends
at that point, that is the 555 nm ray from the point back through the center of the
stop and out.  The angle from u to that direction is the shift.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.surfaces import EyeSurfaces, check_eye, media_indices, pack_eye
from estimator.optics.units import MRAD_PER_RAD, REFERENCE_WAVELENGTH_NM
from estimator.wavefront.chief_ray_kernels import fill_chief_shifts


def chief_shift_mrad(
    eye: EyeSurfaces, *, fields_deg: ArrayLike, wavelengths_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return the shift of chief rays against 555 nm, along the pupil axes, mrad.

    Parameters
    ----------
    fields_deg : (n_fields, 2)
        Azimuth h and elevation v of the source.
    wavelengths_nm : (n_wavelengths,)

    Returns
    -------
    shift_mrad : (n_fields, n_wavelengths, 2)
        Direction cosines of the apparent direction along ex and ey of the field; nan
        where a chief ray fails.
    """
    check_eye(eye)
    fields_rad = np.radians(np.atleast_2d(np.asarray(fields_deg, dtype=np.float64)))
    indices = media_indices(eye, np.atleast_1d(wavelengths_nm))
    shifts = np.empty((len(fields_rad), len(indices), 2))
    reference = media_indices(eye, REFERENCE_WAVELENGTH_NM)
    fill_chief_shifts(pack_eye(eye), indices, reference, fields_rad, shifts)
    return MRAD_PER_RAD * shifts
