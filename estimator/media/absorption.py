"""Absorption by the ocular media: the lens yellows with age, and blue is lost first.

Van de Kraats & van Norren, J. Opt. Soc. Am. A 24, 1842 (2007), as in CIE 203:2012:
density of all media for large fields, fitted to ages of 0 to 90 years.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

REFERENCE_AGE_YEARS = 32.0
"""Age of the CIE standard observer, for whom images are made."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Luminance of the sRGB primaries."""

YELLOWINGS = ("seen", "adapted")


def media_density(
    wavelength_nm: ArrayLike, *, age_years: ArrayLike
) -> NDArray[np.float64]:
    """Return optical densities (...), log10, of the media at an age.

    References
    ----------
    Van de Kraats & van Norren 2007, equation 8: Rayleigh loss, tryptophan, the young
    lens, and the old lens in the ultraviolet and the visible.
    """
    nm = np.asarray(wavelength_nm, dtype=np.float64)
    square = np.square(np.asarray(age_years, dtype=np.float64))
    scattered = (0.446 + 0.000031 * square) * (400.0 / nm) ** 4
    tryptophan = 14.19 * 10.68 * _bell(nm, 273.0, 0.057)
    young = (0.998 - 0.000063 * square) * 2.13 * _bell(nm, 370.0, 0.029)
    old_ultraviolet = (0.059 + 0.000186 * square) * 11.95 * _bell(nm, 325.0, 0.021)
    old = (0.016 + 0.000132 * square) * 1.43 * _bell(nm, 325.0, 0.008)
    return scattered + tryptophan + young + old_ultraviolet + old + 0.111


def _bell(nm: NDArray[Any], center_nm: float, slope: float) -> NDArray[np.float64]:
    return np.exp(-np.square(slope * (nm - center_nm)))


def channel_gains(
    wavelengths_nm: ArrayLike, *, age_years: float, yellowing: str
) -> NDArray[np.float64]:
    """Return gains (3,) of red, green and blue relative to eyes of 32 years.

    Parameters
    ----------
    wavelengths_nm : (3,)
    yellowing : {"seen", "adapted"}
        Gains of the light that arrives; or gains that keep the luminance of white, to
        which the eye adapts first.

    Raises
    ------
    ValueError
        The value of ``yellowing`` is unknown.
    """
    if yellowing not in YELLOWINGS:
        allowed = " and ".join(YELLOWINGS)
        raise ValueError(f"yellowing '{yellowing}': allowed are {allowed}")
    more = media_density(wavelengths_nm, age_years=age_years) - media_density(
        wavelengths_nm, age_years=REFERENCE_AGE_YEARS
    )
    gains = 10.0**-more
    if yellowing == "adapted":
        gains = gains / (gains @ np.array(LUMINANCE))
    return gains
