"""Refractive indices of the ocular media by Herzberger's formula, 365 to 1014 nm."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.units import NM_PER_UM

WAVELENGTH_LIMITS_NM = (365.0, 1014.0)

AIR = "air"

_KNOT_INDICES = {
    # n at 365.0, 486.1, 656.3 and 1014.0 nm (Navarro, Santamaria & Bescos 1985)
    "cornea": (1.3975, 1.3807, 1.37405, 1.3668),
    "aqueous": (1.3593, 1.3422, 1.3354, 1.3278),
    "lens": (1.4492, 1.42625, 1.4175, 1.4097),
    "vitreous": (1.3565, 1.3407, 1.3341, 1.3273),
}

_POLE_UM2 = 0.028

_WEIGHTS = np.array(
    # rows: a1 to a4; columns: 1, L², 1/(L² - 0.028), 1/(L² - 0.028)², L in um
    [
        [0.66147196, -0.40352796, -0.28046790, 0.03385979],
        [-4.20146383, 2.73508956, 1.50543784, -0.11593235],
        [6.29834237, -4.69409935, -1.57508650, 0.10293038],
        [-1.75835059, 2.36253794, 0.35011657, -0.02085782],
    ]
)

MEDIA = (AIR, *_KNOT_INDICES)


def refractive_index(
    medium: str,
    wavelength_nm: ArrayLike,
    *,
    indices: Mapping[str, float] | None = None,
) -> NDArray[np.float64]:
    """Return the refractive index of one medium.

    Parameters
    ----------
    medium : str
        ``cornea``, ``aqueous``, ``lens``, ``vitreous`` or ``air``, or any name in
        ``indices``.
    wavelength_nm : (...), nm
    indices : mapping, optional
        Constant indices by medium; they replace the dispersion formula.

    Returns
    -------
    index : (...)

    Raises
    ------
    ValueError
        An unknown medium, or a wavelength outside 365 to 1014 nm.

    Notes
    -----
    n(L) = a1 n(365.0) + a2 n(486.1) + a3 n(656.3) + a4 n(1014.0), each a a sum over
    1, L², 1/(L² - 0.028), 1/(L² - 0.028)² (Navarro et al. 1985, after Herzberger).
    Air is 1.
    """
    wavelength_nm = np.asarray(wavelength_nm, dtype=np.float64)
    if indices is not None and medium in indices:
        return np.full(wavelength_nm.shape, float(indices[medium]))
    if medium == AIR:
        return np.ones(wavelength_nm.shape)
    if medium not in _KNOT_INDICES:
        given = [] if indices is None else [m for m in indices if m not in MEDIA]
        names = ", ".join((*MEDIA, *given))
        raise ValueError(f"medium '{medium}' has no refractive index; known: {names}")
    low, high = WAVELENGTH_LIMITS_NM
    if not np.all((wavelength_nm >= low) & (wavelength_nm <= high)):
        raise ValueError(
            f"wavelength {wavelength_nm} nm: allowed is {low:g} to {high:g} nm"
        )
    squared = (wavelength_nm / NM_PER_UM) ** 2
    inverse = 1.0 / (squared - _POLE_UM2)
    terms = np.stack([np.ones_like(squared), squared, inverse, inverse**2], axis=-1)
    found: NDArray[np.float64] = terms @ (_WEIGHTS.T @ np.array(_KNOT_INDICES[medium]))
    return found
