"""What light a display makes of red, green and blue: one wavelength for each.

The eye blurs every wavelength in its own way.  A primary's PSF is that of the one
wavelength which stands best for its spectrum, in the light that people see of it.  Of
six measured displays, a white point through 5 mm, against 31 wavelengths with the
colour-matching functions of CIE 1931: 51 to 58 dB in linear light and 47.6 to 49.8 dB
as encoded by "common", 54 to 58 and 48.3 to 49.8 dB by a display's own; 41 to 54 and
43 to 48 dB by the three that the paper takes (tests/benchmarks/bench_displays.py).
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from filter_service.errors import BadMessage

DISPLAYS = {
    "common": (618.0, 536.0, 453.0),  # as in estimator.optics.units
    "lcd": (613.0, 536.0, 452.0),
    "oled": (617.0, 533.0, 455.0),
    "crt": (620.0, 537.0, 452.0),
    "paper": (612.0, 549.0, 464.0),
}
"""Wavelengths of red, green and blue, nm: the best single choice for common displays;
an LCD with white LEDs; an OLED; phosphors; those of Csoba & Kunkli 2023."""

LIMITS_NM = (380.0, 780.0)
ALLOWED = (
    f"{', '.join(DISPLAYS)}, or wavelengths of red, green and blue in nm as "
    f"620,530,455, each from {LIMITS_NM[0]:g} to {LIMITS_NM[1]:g}"
)


def display_wavelengths_nm(display: str) -> tuple[float, float, float]:
    """Return the wavelengths of red, green and blue of a display by name, or as given.

    Raises
    ------
    BadMessage
        An unknown name, or wavelengths that nobody sees.
    """
    if display in DISPLAYS:
        return DISPLAYS[display]
    try:
        red_nm, green_nm, blue_nm = (float(part) for part in display.split(","))
    except ValueError:
        raise _refused(display) from None
    given_nm = (red_nm, green_nm, blue_nm)
    if not all(LIMITS_NM[0] <= nm <= LIMITS_NM[1] for nm in given_nm):
        raise _refused(display)
    return given_nm


def _refused(display: str) -> BadMessage:
    return BadMessage(f"it is {display!r:.60}", field="display", allowed=ALLOWED)


def wavelengths_of_spectra(
    wavelengths_nm: ArrayLike, spectra: ArrayLike
) -> tuple[float, float, float]:
    """Return the wavelengths that stand best for the measured primaries of a display.

    The centroid of each primary's spectrum, weighted by how much of each wavelength
    ends up in that primary again when the display's own primaries are matched to it.

    Parameters
    ----------
    wavelengths_nm : (n,)
        Evenly spaced.
    spectra : (n, 3)
        Power of red, green and blue, in any unit.

    Raises
    ------
    ValueError
        Shapes that do not fit, or spectra that are not three colours.
    """
    at_nm = np.asarray(wavelengths_nm, dtype=np.float64)
    power = np.asarray(spectra, dtype=np.float64)
    if at_nm.ndim != 1 or power.shape != (at_nm.size, 3):
        raise ValueError(f"spectra {power.shape}: must be ({at_nm.size}, 3)")
    try:
        shares = primary_shares(at_nm, power)
    except np.linalg.LinAlgError:
        raise ValueError("spectra: red, green and blue must be three colours") from None
    own = np.stack([shares[k, k] for k in range(3)])
    found = (own @ at_nm / own.sum(axis=1)).tolist()
    if not all(math.isfinite(nm) for nm in found):
        raise ValueError("spectra: red, green and blue must be three colours")
    return found[0], found[1], found[2]


def primary_shares(
    wavelengths_nm: NDArray[np.float64], spectra: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share (3, 3, n) of a wavelength of primary k that is seen as primary j.

    Summed over the wavelengths that is the identity.
    """
    matching = matching_functions(wavelengths_nm)
    from_xyz = np.linalg.inv(matching.T @ spectra)
    seen_as = from_xyz @ matching.T
    return seen_as[:, None] * spectra.T[None]


def matching_functions(wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIE 1931 x, y and z (n, 3): the fit of Wyman, Sloan & Shirley 2013, JCGT 2(2)."""

    def lobe(centre_nm: float, below_nm: float, above_nm: float) -> NDArray:
        width_nm = np.where(wavelengths_nm < centre_nm, below_nm, above_nm)
        return np.exp(-0.5 * ((wavelengths_nm - centre_nm) / width_nm) ** 2)

    return np.stack(
        [
            1.056 * lobe(599.8, 37.9, 31.0)
            + 0.362 * lobe(442.0, 16.0, 26.7)
            - 0.065 * lobe(501.1, 20.4, 26.2),
            0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1),
            1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8),
        ],
        axis=-1,
    )
