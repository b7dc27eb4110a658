"""Wavefronts of measured eyes, all as right eyes in the project's frame.

The data are those of Jaeken & Artal, IOVS 53(7), 2012, as distributed with ISETBio (MIT
license): both eyes of 65 people along the horizontal meridian, 4 mm.  Angles in the
file are positive in the temporal retina of a right eye, whose visual field is to the
left: h = -angle.  Coefficients are in the project's frame, as the sign of coma shows.
Left eyes are mirrored.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import N_TERMS, flip_horizontal
from estimator.periphery.meridian import KNOTS_DEG, TERMS

SMOOTHING_RATIO = 0.15
"""Standard deviation of the Gaussian weights, over the angle of a knot, of the fit of a
parabola about it.  The change is small near the axis, and no window extends past it."""

LEAST_POINTS = 2


class MeasuredEyes(NamedTuple):
    """Wavefronts of measured eyes along the horizontal meridian.

    Attributes
    ----------
    person : (n,)
        Index of the person.
    h_deg : (n_directions,)
        Azimuths, ascending.
    zernike_um : (n, n_directions, 12)
        Coefficients of `TERMS`; NaN where an eye was not measured.
    """

    person: NDArray[np.int64]
    h_deg: NDArray[np.float64]
    zernike_um: NDArray[np.float64]

    @property
    def axis_um(self) -> NDArray[np.float64]:
        """Coefficients on the axis, (n, 12)."""
        return self.zernike_um[:, np.flatnonzero(self.h_deg == 0.0)[0]]

    @property
    def change_um(self) -> NDArray[np.float64]:
        """Coefficients minus those on the axis, (n, n_directions, 12)."""
        return self.zernike_um - self.axis_um[:, None]

    def select(self, is_selected: NDArray[np.bool_]) -> "MeasuredEyes":
        """Return the eyes for which a mask (n,) is True."""
        return MeasuredEyes(
            self.person[is_selected], self.h_deg, self.zernike_um[is_selected]
        )


def load_measured_eyes(file: Path) -> MeasuredEyes:
    """Read the eyes of Jaeken & Artal from ``peripheral_wavefronts.npz``."""
    with np.load(file) as data:
        measured_um = data["jaeken_zernike_um"].astype(np.float64)
        angle_deg = data["jaeken_eccentricity_deg"].astype(np.float64)
        person = data["jaeken_subject"].astype(np.int64)
    zernike_um = np.zeros((*measured_um.shape[:3], N_TERMS))
    zernike_um[..., : measured_um.shape[3]] = measured_um
    right, left = zernike_um
    left = flip_horizontal(left)[:, ::-1]  # angles are symmetrical about 0
    eyes_um = np.concatenate([right, left])[:, ::-1, list(TERMS)]
    return MeasuredEyes(np.tile(person, 2), -angle_deg[::-1], eyes_um)


def knots_um(eyes: MeasuredEyes) -> NDArray[np.float64]:
    """Return smoothed changes (n, 12, 8) at the knots; NaN where not measured."""
    change_um, h_deg = eyes.change_um, eyes.h_deg
    found = np.full((len(change_um), len(TERMS), len(KNOTS_DEG)), np.nan)
    for eye, rows_um in enumerate(change_um):
        is_known = np.isfinite(rows_um).all(axis=1)
        for knot, at_deg in enumerate(KNOTS_DEG):
            away, width_deg = h_deg - at_deg, SMOOTHING_RATIO * abs(at_deg)
            if (is_known & (np.abs(away) <= width_deg)).sum() < LEAST_POINTS:
                continue
            near = is_known & (np.abs(away) <= 2.5 * width_deg)
            root = np.exp(-0.25 * np.square(away[near] / width_deg))[:, None]
            parabola = np.stack([away[near] ** k for k in range(3)], axis=-1)
            fitted = np.linalg.lstsq(root * parabola, root * rows_um[near], rcond=None)
            found[eye, :, knot] = fitted[0][0]
    return found
