"""Sampling density of the retina by direction, which limits acuity off the axis.

Detail finer than the spacing of midget ganglion cells of one kind (on or off) is not
resolved, however sharp the optics.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

PEAK_PER_DEG2 = 33163.2
"""Receptive fields of all ganglion cells at the fovea: two midget cells per cone."""

FOVEAL_MIDGET_RATIO = 1.0 / 1.12
MIDGET_SCALE_DEG = 41.03

MERIDIANS = {
    # of the visual field: share, and scales of both decays, deg
    "temporal": (0.9851, 1.058, 22.14),
    "superior": (0.9935, 1.035, 16.35),
    "nasal": (0.9729, 1.084, 7.633),
    "inferior": (0.9960, 0.9932, 12.13),
}

ARCMIN_PER_DEG = 60.0


def midget_density_per_deg2(
    eccentricity_deg: ArrayLike, meridian: str
) -> NDArray[np.float64]:
    """Return the density (...) of midget receptive fields, on and off together.

    References
    ----------
    Watson, J. Vision 14(7):15, 2014, equations 4, 7 and 8, table 1; meridians are those
    of the visual field.
    """
    share, square_deg, exponential_deg = MERIDIANS[meridian]
    r = np.asarray(eccentricity_deg, dtype=np.float64)
    all_cells = PEAK_PER_DEG2 * (
        share * (1.0 + r / square_deg) ** -2
        + (1.0 - share) * np.exp(-r / exponential_deg)
    )
    return all_cells * FOVEAL_MIDGET_RATIO / (1.0 + r / MIDGET_SCALE_DEG)


def retina_nyquist_cpd(
    h_deg: ArrayLike, v_deg: ArrayLike, *, eye_side: str
) -> NDArray[np.float64]:
    """Return the highest frequency (...) that cells of one kind sample, cycles/degree.

    Parameters
    ----------
    h_deg, v_deg : (...)
        Directions in the visual field, to the person's right and up.
    eye_side : "OD" or "OS"

    Notes
    -----
    Between the meridians the spacing follows an ellipse (Watson 2014, equation 10);
    the blind spot is not excluded.
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
    away = np.maximum(radius_deg, 1e-9)
    along = np.hypot(h * across_deg, v * up_deg) / away
    spacing_deg = np.where(radius_deg < 1e-9, _spacing_deg(0.0, "temporal"), along)
    nyquist_cpd: NDArray[np.float64] = 1.0 / (np.sqrt(3.0) * spacing_deg)
    return nyquist_cpd


def retina_log_mar(
    h_deg: ArrayLike, v_deg: ArrayLike, *, eye_side: str
) -> NDArray[np.float64]:
    """Return the acuity (...) with perfect optics: a gap of half a cycle at Nyquist.

    The arguments are those of `retina_nyquist_cpd`.
    """
    nyquist_cpd = retina_nyquist_cpd(h_deg, v_deg, eye_side=eye_side)
    return np.log10(ARCMIN_PER_DEG / 2.0 / nyquist_cpd)


def _spacing_deg(eccentricity_deg: ArrayLike, meridian: str) -> NDArray[np.float64]:
    """Return the spacing of neighbors of one kind in a hexagonal lattice."""
    one_kind = midget_density_per_deg2(eccentricity_deg, meridian) / 2.0
    spacing_deg: NDArray[np.float64] = np.sqrt(2.0 / (np.sqrt(3.0) * one_kind))
    return spacing_deg
