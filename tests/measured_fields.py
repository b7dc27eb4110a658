"""Eyes measured over the whole visual field, as distributed with ISETBio."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.periphery.population import TERMS


def load_measured_fields(file: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read the right eyes of Polans et al., Optica 2(2), 2015, 4 mm.

    Returns
    -------
    directions_deg : (n_directions, 2)
        Azimuth and elevation.
    zernike_um : (n, n_directions, 12)
    """
    with np.load(file) as data:
        angles_deg = data["polans_eccentricity_deg"].astype(np.float64)
        zernike_um = data["polans_zernike_um"].astype(np.float64)
    return angles_deg * [-1.0, 1.0] + 0.0, zernike_um[..., : len(TERMS)]
