"""Scattering and absorption in the ocular media.

Straylight is wide-angle scattering, which causes glare and lowers contrast.

The CIE total glare function is the point-spread function of an eye from 0 to 100 deg,
by age and pigmentation (Vos & van den Berg, CIE Research Note 135/1, 1999).  Its core
is due to aberrations and diffraction, which the PSFs of the individual eye contain;
this module models the light outside the core.  The clinical measure is the straylight
parameter s at 7 deg, in deg²/sr: angle² times the scattered light per steradian and
incident light.

In log s, the function is 0.06 below 2,422 European drivers at 20 years, and 0.12 at 70
(van den Berg et al., Am J Ophthalmol 144:358, 2007).  At 20 years, 32 % of its light at
7 deg is the wing of its core, which hardly changes with age.  The light at 7 deg is
that of the drivers; the difference is proportional to the inverse square of the angle,
as scatter by the lens is (van den Berg & Ijspeert, Vision Res 35:169, 1995).

The lens yellows with age.  The model of spectral absorption is from van de Kraats &
van Norren, J. Opt. Soc. Am. A 24, 1842 (2007), adopted by CIE 203:2012: optical density
of all media for large fields, 0 to 90 years.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

CORE_DEG = 0.5
"""Angle at which the core is cut off: 98 % of the glare function remain at 1 deg, which
aberrations and diffraction hardly reach."""

SMALLEST_DEG, LARGEST_DEG = 0.01, 90.0
STATED_AT_DEG = 7.0
"""Angle of the C-Quant instrument, at which log s is stated."""

YOUNG_DRIVERS_LOG_S, DRIVERS_AGE_YEARS = 0.87, 65.0
"""Straylight of drivers at 7 deg: log s = 0.87 + log10(1 + (age / 65)^4)."""

DEFAULT_AGE_YEARS = 25.0
BROWN = 0.5
"""Pigmentation factor: 0 for black, 0.5 for brown, 1 for light blue eyes."""

CATARACTS = {"nuclear": 1.22, "cortical": 1.26, "posterior_subcapsular": 1.48}
"""Mean log s of 592, 776 and 75 eyes before surgery (standard deviations 0.20, 0.23 and
0.34), from five studies: J. Ophthalmol. 2017, 5649532."""

LOG_S_RANGE = (0.5, 1.9)
"""Range of log s.  By the inverse square law, 1.9 scatters 86 to 95 % of the light, and
from 1.97 on, more than there is."""

N_ANGLES = 4000


def cie_glare_per_sr(
    angle_deg: ArrayLike, *, age_years: float, pigmentation: float = BROWN
) -> NDArray[np.float64]:
    """Return the CIE total glare function (...), per steradian and incident light.

    Parameters
    ----------
    angle_deg : (...)
    age_years : float
    pigmentation : float
        0 for black, 0.5 for brown, 1 for light blue eyes.

    Notes
    -----
    The function integrates to 1.03 at 25 years and to 1.07 at 70.  The published
    normalization is omitted, because veiling luminance is specified without it.

    References
    ----------
    Vos & van den Berg 1999, equation 8.
    """
    square = np.square(np.asarray(angle_deg, dtype=np.float64))
    age = (age_years / 70.0) ** 4
    core = 9.2e6 / (1.0 + square / 0.0046**2) ** 1.5
    core += 1.5e5 / (1.0 + square / 0.045**2) ** 1.5
    wide = 1.0 + square / 0.1**2
    lens = 400.0 / wide + 3e-8 * square
    wall = 1300.0 / wide**1.5 + 0.8 / wide**0.5
    return (
        (1.0 - 0.08 * age) * core
        + (1.0 + 1.6 * age) * (lens + pigmentation * wall)
        + 2.5e-3 * pigmentation
    )


@dataclass(frozen=True)
class Straylight:
    """Straylight of one eye.

    Attributes
    ----------
    age_years : float
    pigment_ratio : float
        Pigmentation; see `cie_glare_per_sr`.
    log_s : float or None
        Straylight parameter at 7 deg, measured or typical of a cataract; by default
        from the age.  The difference from the CIE function is proportional to the
        inverse square of the angle.
    """

    age_years: float = DEFAULT_AGE_YEARS
    pigment_ratio: float = BROWN
    log_s: float | None = None

    @property
    def age_log_s(self) -> float:
        """Straylight parameter log s at 7 deg of a healthy eye of this age.

        The drivers' pigmentation is not stated; theirs is taken as brown, and other
        eyes differ from brown ones as in the CIE function.
        """
        pigment = self._cie_s(self.pigment_ratio) - self._cie_s(BROWN)
        growth = 1.0 + (self.age_years / DRIVERS_AGE_YEARS) ** 4
        return math.log10(10.0**YOUNG_DRIVERS_LOG_S * growth + pigment)

    def _cie_s(self, pigmentation: float) -> float:
        """Return the straylight parameter s of the CIE function."""
        per_sr = cie_glare_per_sr(
            STATED_AT_DEG, age_years=self.age_years, pigmentation=pigmentation
        )
        return STATED_AT_DEG**2 * float(per_sr)

    def per_sr(self, angle_deg: ArrayLike) -> NDArray[np.float64]:
        """Return the scattered light (...), per steradian and incident light."""
        angle_deg = np.maximum(np.asarray(angle_deg, dtype=np.float64), SMALLEST_DEG)
        found = cie_glare_per_sr(
            angle_deg, age_years=self.age_years, pigmentation=self.pigment_ratio
        )
        log_s = self.age_log_s if self.log_s is None else self.log_s
        excess = 10.0**log_s - self._cie_s(self.pigment_ratio)
        found = np.maximum(found + excess / angle_deg**2, 0.0)
        return found * -np.expm1(-np.square(angle_deg / CORE_DEG))

    @property
    def fraction(self) -> float:
        """Scattered fraction of the incident light."""
        angles_deg = np.geomspace(SMALLEST_DEG, LARGEST_DEG, N_ANGLES)
        ring_sr = 2.0 * np.pi * np.sin(np.radians(angles_deg))
        return float(
            np.trapezoid(self.per_sr(angles_deg) * ring_sr, np.radians(angles_deg))
        )

    def transfer_ratio(self, frequency_cpd: ArrayLike) -> NDArray[np.float64]:
        """Return the optical transfer (...) of the scattered light alone.

        It is real, and equals `fraction` at frequency 0.  The transfer of the eye is
        ``1 - fraction`` times that of its wavefront plus this.

        Notes
        -----
        It is the integral of the light of a ring, 2 pi sin(angle), times the Bessel
        function J0(2 pi f angle).  Between angles, light per angle is linear, and the
        oscillating rest is integrated in closed form.
        """
        from scipy.special import itj0y0, j0, j1  # loads slowly

        angles_deg = np.geomspace(SMALLEST_DEG, LARGEST_DEG, N_ANGLES)
        sine = np.sin(np.radians(angles_deg)) * np.radians(1.0) / angles_deg
        light = 2.0 * np.pi * self.per_sr(angles_deg) * sine
        slope = np.diff(light) / np.diff(angles_deg)
        cpd = np.asarray(frequency_cpd, dtype=np.float64)
        found = np.full(cpd.shape, self.fraction)
        for index in np.argwhere(cpd != 0.0):
            k = 2.0 * np.pi * abs(float(cpd[tuple(index)]))
            x = k * angles_deg
            # antiderivatives of x J0(x) and x² J0(x), divided by powers of k
            first = x * j1(x) / k**2
            second = (x**2 * j1(x) + x * j0(x) - itj0y0(x)[0]) / k**3
            constant = light[:-1] - slope * angles_deg[:-1]
            found[tuple(index)] = float(
                (constant * np.diff(first) + slope * np.diff(second)).sum()
            )
        return found


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
