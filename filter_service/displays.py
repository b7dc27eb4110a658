"""Wavelengths and spectra of a display's red, green and blue.

Frames have one or two wavelengths for each primary.

The eye blurs each wavelength differently.  A primary's PSF is computed for the
single wavelength that best represents its spectrum, weighted by the color-matching
functions.  Accuracy for a white point through 5 mm on six measured displays, against 31
wavelengths with the color-matching functions of CIE 1931: with "common" 51 to 58 dB in
linear light and 47.6 to 49.8 dB encoded, with a display's own wavelengths 54 to 58 and
48.3 to 49.8 dB, with the paper's 41 to 54 and 43 to 48 dB.  Two wavelengths per
primary, one standard deviation of its light to both sides, reach 50.1 to 52.1 dB
encoded with "common" and 51.2 to 53.4 with a display's own
(tests/reference/display_pictures.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from filter_service.errors import BadMessage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

DISPLAYS = {
    "common": (618.0, 536.0, 453.0),  # as in estimator.optics.units
    "lcd": (613.0, 536.0, 452.0),
    "oled": (617.0, 533.0, 455.0),
    "crt": (620.0, 537.0, 452.0),
    "paper": (612.0, 549.0, 464.0),
}
"""Wavelengths of red, green and blue, nm: the best single choice for common displays;
an LCD with white LEDs; an OLED; CRT phosphors; Csoba & Kunkli 2023."""

WIDTHS_NM = {
    "common": (13.0, 19.0, 13.0),
    "lcd": (15.0, 18.0, 12.0),
    "oled": (16.0, 18.5, 14.5),
    "crt": (6.5, 20.5, 15.5),
    "paper": (13.0, 19.0, 13.0),
}
"""Standard deviations of the spectra of red, green and blue, nm."""

MEASURED = {
    "common": "LCD, white LEDs (Apple)",
    "lcd": "LCD, white LEDs (Apple)",
    "oled": "OLED (Sony)",
    "crt": "CRT (Dell)",
}
"""Displays of `display_spectra.json` whose spectra stand for these names."""

LIMITS_NM = (380.0, 780.0)
MAX_WIDTH_NM = 40.0
ALLOWED = (
    f"{', '.join(DISPLAYS)}, or wavelengths of red, green and blue in nm as "
    f"620,530,455 or, with standard deviations, 620:13,530:19,455:13; each from "
    f"{LIMITS_NM[0]:g} to {LIMITS_NM[1]:g}, deviations from 0 to {MAX_WIDTH_NM:g}"
)

Triple = tuple[float, float, float]


class DisplaySpectra(NamedTuple):
    """Spectra of a display's primaries.

    Attributes
    ----------
    wavelengths_nm : (n,)
        Ascending.
    spectra : (n, 3)
        Power of red, green and blue at each wavelength.
    """

    wavelengths_nm: NDArray[np.float64]
    spectra: NDArray[np.float64]

    @property
    def scaled_to_white(self) -> DisplaySpectra:
        """The same display, scaled so that Y of its white is 1 (CIE 1931)."""
        from estimator.color import xyz_weights

        y = self.spectra.sum(axis=1) @ xyz_weights(self.wavelengths_nm)[:, 1]
        return self._replace(spectra=self.spectra / y)


def display_spectra(display: str = "common") -> DisplaySpectra:
    """Return the measured spectra of a display, every 10 nm from 400 to 700 nm.

    They convert linear RGB to cone signals or CIE XYZ: ``rgb @ (spectra.T @
    lms_weights(wavelengths_nm))``.

    Parameters
    ----------
    display : "common", "lcd", "oled" or "crt"
        The first two are an LCD with white LEDs.

    Returns
    -------
    DisplaySpectra
        Scaled so that Y of white is 1 (CIE 1931).

    Raises
    ------
    BadMessage
        If there are no spectra of this name.

    References
    ----------
    Displays of Apple, Sony and Dell as measured for isetbio.
    """
    import json

    import numpy as np

    if display not in MEASURED:
        raise BadMessage(
            f"no spectra of {display!r:.60} are known",
            field="display",
            allowed=", ".join(MEASURED),
        )
    path = Path(__file__).with_name("display_spectra.json")
    content = json.loads(path.read_text(encoding="utf-8"))
    at_nm = np.array(content["wavelengths_nm"], dtype=np.float64)
    power = np.array(content["displays"][MEASURED[display]])
    return DisplaySpectra(at_nm, power).scaled_to_white


def display_wavelengths_nm(display: str) -> Triple:
    """Return the wavelengths of red, green and blue of a display.

    Parameters
    ----------
    display : str
        Name, or wavelengths as in the setting.

    Raises
    ------
    BadMessage
        If the name is unknown, or wavelengths are out of range.
    """
    return (
        DISPLAYS[display] if display in DISPLAYS else _parse_wavelengths_nm(display)[0]
    )


def display_widths_nm(display: str) -> Triple:
    """Return the standard deviations of red, green and blue; by default of "common".

    Raises
    ------
    BadMessage
        If the name is unknown, or wavelengths are out of range.
    """
    return (
        WIDTHS_NM[display] if display in DISPLAYS else _parse_wavelengths_nm(display)[1]
    )


def _parse_wavelengths_nm(display: str) -> tuple[Triple, Triple]:
    """Return wavelengths and standard deviations given as numbers."""
    try:
        parts = [[float(n) for n in part.split(":")] for part in display.split(",")]
    except ValueError:
        raise _invalid_display(display) from None
    if len(parts) != 3 or any(len(part) > 2 for part in parts):
        raise _invalid_display(display)
    usual_nm = WIDTHS_NM["common"]
    red, green, blue = (
        (part[0], part[1] if len(part) == 2 else width_nm)
        for part, width_nm in zip(parts, usual_nm, strict=True)
    )
    low_nm, high_nm = LIMITS_NM
    for at_nm, width_nm in (red, green, blue):
        if not (low_nm <= at_nm <= high_nm and 0.0 <= width_nm <= MAX_WIDTH_NM):
            raise _invalid_display(display)
    return (red[0], green[0], blue[0]), (red[1], green[1], blue[1])


def _invalid_display(display: str) -> BadMessage:
    return BadMessage(f"it is {display!r:.60}", field="display", allowed=ALLOWED)


def primaries_of_spectra(
    wavelengths_nm: ArrayLike, spectra: ArrayLike
) -> tuple[Triple, Triple]:
    """Return the wavelengths and widths that best represent measured primaries.

    They are the centroid and standard deviation of each primary's spectrum, weighted at
    each wavelength by the amount of that primary in a color match with the display.

    Parameters
    ----------
    wavelengths_nm : (n,)
        Evenly spaced wavelengths.
    spectra : (n, 3)
        Power of red, green and blue, in any unit.

    Returns
    -------
    wavelengths_nm, widths_nm : (red, green, blue)

    Raises
    ------
    ValueError
        If shapes do not match, or the spectra are not three independent colors.
    """
    import numpy as np  # here, because the service's supervisor does without it

    at_nm = np.asarray(wavelengths_nm, dtype=np.float64)
    power = np.asarray(spectra, dtype=np.float64)
    if at_nm.ndim != 1 or power.shape != (at_nm.size, 3):
        raise ValueError(
            f"spectra have shape {power.shape}; expected ({at_nm.size}, 3)"
        )
    try:
        shares = primary_shares(at_nm, power)
    except np.linalg.LinAlgError:
        raise ValueError(
            "spectra of red, green and blue are not three independent colors"
        ) from None
    own = np.stack([shares[k, k] / shares[k, k].sum() for k in range(3)])
    found_nm = own @ at_nm
    variance = np.sum(own * (at_nm - found_nm[:, None]) ** 2, axis=1)
    widths_nm = np.sqrt(np.clip(variance, 0.0, MAX_WIDTH_NM**2))
    if not np.isfinite(found_nm).all():
        raise ValueError(
            "spectra of red, green and blue are not three independent colors"
        )
    red, green, blue = zip(found_nm.tolist(), widths_nm.tolist(), strict=True)
    return (red[0], green[0], blue[0]), (red[1], green[1], blue[1])


def primary_shares(
    wavelengths_nm: NDArray[np.float64], spectra: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the share (3, 3, n) of light of primary k that is seen as primary j.

    The sum over wavelengths is the identity.
    """
    import numpy as np

    matching = matching_functions(wavelengths_nm)
    from_xyz = np.linalg.inv(matching.T @ spectra)
    seen_as = from_xyz @ matching.T
    return seen_as[:, None] * spectra.T[None]


def matching_functions(wavelengths_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return CIE 1931 x, y and z (n, 3).

    References
    ----------
    Fit of Wyman, Sloan & Shirley 2013, JCGT 2(2).
    """
    import numpy as np

    def lobe(center_nm: float, below_nm: float, above_nm: float) -> NDArray[Any]:
        width_nm = np.where(wavelengths_nm < center_nm, below_nm, above_nm)
        return np.exp(-0.5 * ((wavelengths_nm - center_nm) / width_nm) ** 2)

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
