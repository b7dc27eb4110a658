"""Refractive indices of the ocular media by Herzberger's formula, 365 to 1014 nm."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.dispersion import Dispersion
from estimator.optics.dispersion.formulas import OcularHerzberger

WAVELENGTH_LIMITS_NM = (365.0, 1014.0)

AIR = "air"

OCULAR_MEDIA = {
    # n at 365.0, 486.1, 656.3 and 1014.0 nm (Navarro, Santamaria & Bescos 1985)
    "cornea": OcularHerzberger((1.3975, 1.3807, 1.37405, 1.3668)),
    "aqueous": OcularHerzberger((1.3593, 1.3422, 1.3354, 1.3278)),
    "lens": OcularHerzberger((1.4492, 1.42625, 1.4175, 1.4097)),
    "vitreous": OcularHerzberger((1.3565, 1.3407, 1.3341, 1.3273)),
}

MEDIA = (AIR, *OCULAR_MEDIA)

N_CACHED = 256
"""Number of pairs of medium and wavelengths whose indices are kept: preparing an eye
asks for the same ones hundreds of times."""


@lru_cache(N_CACHED)
def _ocular_index(
    medium: str, wavelengths_nm: bytes, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    known_nm = np.frombuffer(wavelengths_nm).reshape(shape)
    return OCULAR_MEDIA[medium].refractive_index(known_nm)


def refractive_index(
    medium: str,
    wavelength_nm: ArrayLike,
    *,
    indices: Mapping[str, float] | None = None,
    media: Mapping[str, Any] | None = None,
) -> NDArray[np.float64]:
    """Return the refractive index of a homogeneous medium.

    Parameters
    ----------
    medium : str
        ``cornea``, ``aqueous``, ``lens``, ``vitreous``, ``air``, or a key of
        ``indices`` or ``media``.
    wavelength_nm : (...)
    indices : mapping, optional
        Constant indices by medium, which take precedence over dispersions.
    media : mapping, optional
        Dispersions by medium, which take precedence over the formula below.

    Returns
    -------
    index : (...)

    Raises
    ------
    ValueError
        The medium is unknown, or a wavelength is outside its range: 365 to 1014 nm for
        the formula below.

    Notes
    -----
    n(L) = a1 n(365.0) + a2 n(486.1) + a3 n(656.3) + a4 n(1014.0).  Each a is a linear
    combination of 1, L², 1/(L² - 0.028) and 1/(L² - 0.028)², with L in micrometers
    (Navarro et al. 1985, after Herzberger).  The index of air is 1.
    """
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    if indices is not None and medium in indices:
        return np.full(wavelength_nm.shape, float(indices[medium]))
    if medium == AIR:
        return np.ones(wavelength_nm.shape)
    dispersion: Dispersion | None = media.get(medium) if media else None
    if dispersion is not None or medium in OCULAR_MEDIA:
        try:
            if dispersion is not None:
                return dispersion.refractive_index(wavelength_nm)
            key = medium, wavelength_nm.tobytes(), wavelength_nm.shape
            return _ocular_index(*key).copy()
        except ValueError as error:
            raise ValueError(f"medium '{medium}': {error}") from None
    given = [m for m in (*(indices or {}), *(media or {})) if m not in MEDIA]
    names = ", ".join((*MEDIA, *given))
    raise ValueError(f"medium '{medium}' has no refractive index; known: {names}")
