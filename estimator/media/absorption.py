"""Spectral absorption of the ocular media: the lens yellows with age.

The model is that of van de Kraats & van Norren, J. Opt. Soc. Am. A 24, 1842 (2007),
adopted by CIE 203:2012: optical density of all media for large fields, 0 to 90 years.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

REFERENCE_AGE_YEARS = 32.0
"""Age of the CIE standard observer, for which images are encoded."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Relative luminance of the sRGB primaries."""

YELLOWINGS = ("seen", "adapted")


def media_density(
    wavelength_nm: ArrayLike, *, age_years: ArrayLike
) -> NDArray[np.float64]:
    """Return the optical density (...), log10, of the ocular media.

    Parameters
    ----------
    wavelength_nm, age_years : (...)

    References
    ----------
    Van de Kraats & van Norren 2007, equation 8: Rayleigh scattering, tryptophan, the
    young lens, and the aged lens in the ultraviolet and in the visible.
    """
    nm = np.asarray(wavelength_nm, dtype=np.float64)
    square = np.square(np.asarray(age_years, dtype=np.float64))
    scattered = (0.446 + 0.000031 * square) * (400.0 / nm) ** 4
    tryptophan = 14.19 * 10.68 * _absorption_band(nm, 273.0, 0.057)
    young = (0.998 - 0.000063 * square) * 2.13 * _absorption_band(nm, 370.0, 0.029)
    aged_ultraviolet = (
        (0.059 + 0.000186 * square) * 11.95 * _absorption_band(nm, 325.0, 0.021)
    )
    aged = (0.016 + 0.000132 * square) * 1.43 * _absorption_band(nm, 325.0, 0.008)
    return scattered + tryptophan + young + aged_ultraviolet + aged + 0.111


def _absorption_band(
    nm: NDArray[Any], center_nm: float, slope: float
) -> NDArray[np.float64]:
    return np.exp(-np.square(slope * (nm - center_nm)))


def channel_gains(
    wavelengths_nm: ArrayLike, *, age_years: float, yellowing: str
) -> NDArray[np.float64]:
    """Return the gains (3,) of red, green and blue relative to an age of 32 years.

    Parameters
    ----------
    wavelengths_nm : (3,)
        Wavelengths of red, green and blue.
    age_years : float
    yellowing : {"seen", "adapted"}
        Whether the gains are the transmission of the media, or are normalized so that
        white keeps its luminance, to which the eye adapts.

    Raises
    ------
    ValueError
        The value of ``yellowing`` is unknown.
    """
    if yellowing not in YELLOWINGS:
        allowed = ", ".join(YELLOWINGS)
        raise ValueError(f"yellowing '{yellowing}': allowed are {allowed}")
    added = media_density(wavelengths_nm, age_years=age_years) - media_density(
        wavelengths_nm, age_years=REFERENCE_AGE_YEARS
    )
    gains = 10.0**-added
    if yellowing == "adapted":
        gains = gains / (gains @ np.array(LUMINANCE))
    return gains
