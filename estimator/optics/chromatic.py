"""Chromatic difference of refraction of the mean eye."""

from typing import overload

import numpy as np
from numpy.typing import NDArray

INDIANA_OFFSET_DPT = 1.68524
INDIANA_SLOPE_DPT_NM = 633.46
INDIANA_POLE_NM = 214.102


@overload
def chromatic_refraction_dpt(wavelength_nm: float) -> float: ...
@overload
def chromatic_refraction_dpt(
    wavelength_nm: NDArray[np.float64],
) -> NDArray[np.float64]: ...
def chromatic_refraction_dpt(
    wavelength_nm: float | NDArray[np.float64],
) -> float | NDArray[np.float64]:
    """Return the refraction (...), dpt, of the Indiana chromatic eye.

    It is zero at 589.98 nm and negative (myopic) at shorter wavelengths.  Only
    differences between wavelengths have a meaning.

    References
    ----------
    Thibos, Ye, Zhang & Bradley, Appl. Opt. 31, 1992: a fit to measured eyes.
    """
    return INDIANA_OFFSET_DPT - INDIANA_SLOPE_DPT_NM / (wavelength_nm - INDIANA_POLE_NM)
