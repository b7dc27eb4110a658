"""Check of wavelengths against the range of a medium."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def bounded_nm(
    wavelength_nm: ArrayLike, limits_nm: tuple[float, float]
) -> NDArray[np.float64]:
    """Return wavelengths as an array (...).

    Raises
    ------
    ValueError
        A wavelength is outside the limits or nan.
    """
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    low, high = limits_nm
    if not np.all((wavelength_nm >= low) & (wavelength_nm <= high)):
        raise ValueError(
            f"wavelength {wavelength_nm} nm: allowed is {low:g} to {high:g} nm"
        )
    return wavelength_nm
