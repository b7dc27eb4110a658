"""Measured people, all as right eyes in the project's frame.

Jaeken & Artal, IOVS 53(7), 2012: 65 people, both eyes, horizontal meridian, 4 mm, as
distributed with ISETBio (MIT license).  A right eye's temporal retina, positive in the
file, sees the person's left: h = -angle.  Coefficients are in our frame, as the sign of
coma shows.  Left eyes are mirrored.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import N_TERMS, flip_horizontal
from estimator.periphery.meridian import KNOTS_DEG, TERMS

SMOOTHING_RATIO = 0.15
"""Ratio to a knot's angle of the deviation of the Gaussian about it, with which a
parabola is fitted: changes are small near the axis, and no window extends past it."""

LEAST_POINTS = 2


class People(NamedTuple):
    """Eyes of people.

    Attributes
    ----------
    person : (n,)
        Index of the eye's owner.
    h_deg : (n_directions,)
        Ascending azimuths.
    zernike_um : (n, n_directions, 12)
        Coefficients of `TERMS`; NaN where an eye was not measured.
    """

    person: NDArray[np.int64]
    h_deg: NDArray[np.float64]
    zernike_um: NDArray[np.float64]

    @property
    def axis_um(self) -> NDArray[np.float64]:
        """Return terms on the axis (n, 12)."""
        return self.zernike_um[:, np.flatnonzero(self.h_deg == 0.0)[0]]

    @property
    def change_um(self) -> NDArray[np.float64]:
        """Return terms minus those on the axis, (n, n_directions, 12)."""
        return self.zernike_um - self.axis_um[:, None]

    def of(self, eyes: NDArray[np.bool_]) -> "People":
        """Return some of the eyes (n,)."""
        return People(self.person[eyes], self.h_deg, self.zernike_um[eyes])


def load_people(file: Path) -> People:
    """Read the horizontal meridians of ``peripheral_wavefronts.npz``."""
    with np.load(file) as data:
        measured_um = data["jaeken_zernike_um"].astype(np.float64)
        angle_deg = data["jaeken_eccentricity_deg"].astype(np.float64)
        person = data["jaeken_subject"].astype(np.int64)
    zernike_um = np.zeros((*measured_um.shape[:3], N_TERMS))
    zernike_um[..., : measured_um.shape[3]] = measured_um
    right, left = zernike_um
    left = flip_horizontal(left)[:, ::-1]  # angles are symmetrical about 0
    eyes_um = np.concatenate([right, left])[:, ::-1, list(TERMS)]
    return People(np.tile(person, 2), -angle_deg[::-1], eyes_um)


def load_over_field(file: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read the people measured over the whole field in the same file.

    Polans et al., Optica 2(2), 2015: right eyes, 4 mm, as distributed with ISETBio.

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


def knots_um(people: People) -> NDArray[np.float64]:
    """Return smoothed changes (n, 12, 8) at the knots; NaN where not measured."""
    change_um, h_deg = people.change_um, people.h_deg
    found = np.full((len(change_um), len(TERMS), len(KNOTS_DEG)), np.nan)
    for eye, rows_um in enumerate(change_um):
        is_known = np.isfinite(rows_um).all(axis=1)
        for knot, at_deg in enumerate(KNOTS_DEG):
            away, width_deg = h_deg - at_deg, SMOOTHING_RATIO * abs(at_deg)
            if (is_known & (np.abs(away) <= width_deg)).sum() < LEAST_POINTS:
                continue
            used = is_known & (np.abs(away) <= 2.5 * width_deg)
            root = np.exp(-0.25 * np.square(away[used] / width_deg))[:, None]
            parabola = np.stack([away[used] ** k for k in range(3)], axis=-1)
            fitted = np.linalg.lstsq(root * parabola, root * rows_um[used], rcond=None)
            found[eye, :, knot] = fitted[0][0]
    return found
