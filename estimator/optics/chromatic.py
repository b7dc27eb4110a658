"""Chromatic difference of refraction of the average eye."""

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
    """Return the refraction of the Indiana chromatic eye, dpt, zero at 589.98 nm.

    A fit to measured eyes (Thibos, Ye, Zhang & Bradley 1992), used for profiles that
    consist of a wavefront without an eye.  Only differences between wavelengths are
    used.  Shorter wavelengths are more myopic (negative).
    """
    return INDIANA_OFFSET_DPT - INDIANA_SLOPE_DPT_NM / (wavelength_nm - INDIANA_POLE_NM)
