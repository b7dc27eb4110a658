"""Sampling density of the retina, which limits acuity in the periphery.

The retina does not resolve detail finer than the spacing of midget ganglion cells of
one type (ON or OFF).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

PEAK_PER_DEG2 = 33163.2
"""Density of ganglion cell receptive fields at the fovea: two midget cells per cone."""

FOVEAL_MIDGET_RATIO = 1.0 / 1.12
MIDGET_SCALE_DEG = 41.03

MERIDIANS = {
    # Visual-field meridian: weight of the first term, and scales of both terms, deg
    "temporal": (0.9851, 1.058, 22.14),
    "superior": (0.9935, 1.035, 16.35),
    "nasal": (0.9729, 1.084, 7.633),
    "inferior": (0.9960, 0.9932, 12.13),
}

ARCMIN_PER_DEG = 60.0


def midget_density_per_deg2(
    eccentricity_deg: ArrayLike, meridian: str
) -> NDArray[np.float64]:
    """Return the density of ON and OFF midget receptive fields combined.

    Parameters
    ----------
    eccentricity_deg : (...)
    meridian : {"temporal", "superior", "nasal", "inferior"}
        Meridian of the visual field.

    Returns
    -------
    (...)
        Receptive fields per square degree.

    References
    ----------
    Watson, J. Vision 14(7):15, 2014, equations 4, 7 and 8, table 1.
    """
    weight, square_deg, exponential_deg = MERIDIANS[meridian]
    r = np.asarray(eccentricity_deg, dtype=np.float64)
    all_cells = PEAK_PER_DEG2 * (
        weight * (1.0 + r / square_deg) ** -2
        + (1.0 - weight) * np.exp(-r / exponential_deg)
    )
    return all_cells * FOVEAL_MIDGET_RATIO / (1.0 + r / MIDGET_SCALE_DEG)


def retina_nyquist_cpd(
    h_deg: ArrayLike, v_deg: ArrayLike, *, eye_side: str
) -> NDArray[np.float64]:
    """Return the Nyquist frequency of midget cells of one type.

    Parameters
    ----------
    h_deg, v_deg : (...)
        Directions in the visual field, to the person's right and up.
    eye_side : "OD" or "OS"

    Returns
    -------
    (...)
        Cycles per degree.

    Notes
    -----
    Between the meridians the spacing follows an ellipse (Watson 2014, equation 10).
    The blind spot is not modeled.
    """
    h, v = np.broadcast_arrays(
        np.asarray(h_deg, dtype=np.float64), np.asarray(v_deg, dtype=np.float64)
    )
    temporal = h if eye_side == "OD" else -h
    radius_deg = np.hypot(h, v)
    across_deg, up_deg = (
        np.where(
            positive >= 0.0,
            _spacing_deg(radius_deg, first),
            _spacing_deg(radius_deg, second),
        )
        for positive, first, second in (
            (temporal, "temporal", "nasal"),
            (v, "superior", "inferior"),
        )
    )
    between = np.hypot(h * across_deg, v * up_deg) / np.maximum(radius_deg, 1e-9)
    spacing_deg = np.where(radius_deg < 1e-9, _spacing_deg(0.0, "temporal"), between)
    nyquist_cpd: NDArray[np.float64] = 1.0 / (np.sqrt(3.0) * spacing_deg)
    return nyquist_cpd


def retina_log_mar(
    h_deg: ArrayLike, v_deg: ArrayLike, *, eye_side: str
) -> NDArray[np.float64]:
    """Return the acuity with perfect optics.

    The Landolt C gap (critical detail) is taken as half a cycle at the Nyquist
    frequency.  The arguments are those of `retina_nyquist_cpd`.

    Returns
    -------
    (...)
        logMAR.
    """
    nyquist_cpd = retina_nyquist_cpd(h_deg, v_deg, eye_side=eye_side)
    return np.log10(ARCMIN_PER_DEG / 2.0 / nyquist_cpd)


def _spacing_deg(eccentricity_deg: ArrayLike, meridian: str) -> NDArray[np.float64]:
    """Return the spacing of cells of one type in a hexagonal lattice.

    Returns
    -------
    (...)
        Distance between the centers of neighboring cells, deg.
    """
    one_type = midget_density_per_deg2(eccentricity_deg, meridian) / 2.0
    spacing_deg: NDArray[np.float64] = np.sqrt(2.0 / (np.sqrt(3.0) * one_type))
    return spacing_deg
