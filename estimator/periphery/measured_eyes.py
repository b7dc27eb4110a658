"""Wavefronts of measured eyes, all as right eyes in the project's frame.

The data are those of Jaeken & Artal, IOVS 53(7), 2012, as distributed with ISETBio (MIT
license): both eyes of 65 people along the horizontal meridian, 4 mm.  Angles in the
file are positive in the temporal retina of a right eye, whose visual field is to the
left: h = -angle.  Coefficients are in the project's frame, as the sign of coma shows.
Left eyes are mirrored.
"""

import io
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import InvalidFile, read_bytes, reason_of
from estimator.optics.zernike import N_TERMS, flip_horizontal
from estimator.periphery.meridian import KNOTS_DEG, TERMS

SMOOTHING_RATIO = 0.15
"""Standard deviation of the Gaussian weights, over the angle of a knot, of the fit of a
parabola about it.  The change is small near the axis, and no window extends past it."""

LEAST_POINTS = 2
MAX_FILE_BYTES = 10_000_000
"""Size limit of a file and of each of its arrays; that of 130 eyes has 0.4 MB."""

_DAMAGED = (
    *(ValueError, KeyError, TypeError, OSError, EOFError, OverflowError),
    *(NotImplementedError, RuntimeError, MemoryError, SyntaxError, zlib.error),
)
"""What NumPy and zipfile raise for damaged files."""


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
    """Read the eyes of Jaeken & Artal from ``peripheral_wavefronts.npz``.

    Raises
    ------
    InvalidFile
        The file is damaged, too large, or does not contain these arrays.
    """
    found = _arrays(file)
    measured_um, angle_deg = (
        found["jaeken_zernike_um"],
        found["jaeken_eccentricity_deg"],
    )
    person = found["jaeken_subject"].astype(np.int64)
    shape = (2, len(person), len(angle_deg))
    if measured_um.shape[:3] != shape or not 15 <= measured_um.shape[3] <= N_TERMS:
        problem = f"jaeken_zernike_um has the shape {measured_um.shape}"
        raise InvalidFile(file, problem, f"{shape} and 15 to {N_TERMS} terms")
    if not (np.all(np.diff(angle_deg) > 0.0) and np.all(angle_deg == -angle_deg[::-1])):
        problem = "jaeken_eccentricity_deg is not ascending and symmetrical"
        raise InvalidFile(file, problem, "angles from -h to h, 0 in the middle")
    zernike_um = np.zeros((*measured_um.shape[:3], N_TERMS))
    zernike_um[..., : measured_um.shape[3]] = measured_um
    right, left = zernike_um
    left = flip_horizontal(left)[:, ::-1]  # angles are symmetrical about 0
    eyes_um = np.concatenate([right, left])[:, ::-1, list(TERMS)]
    return MeasuredEyes(np.tile(person, 2), -angle_deg[::-1], eyes_um)


_DIMENSIONS = {
    "jaeken_zernike_um": 4,
    "jaeken_eccentricity_deg": 1,
    "jaeken_subject": 1,
}


def _arrays(file: Path) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of `_DIMENSIONS`; check sizes before unpacking."""
    content = read_bytes(file, max_bytes=MAX_FILE_BYTES)
    found = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            for name, n_dimensions in _DIMENSIONS.items():
                entry = packed.getinfo(f"{name}.npy")
                if entry.file_size > MAX_FILE_BYTES:
                    problem = f"{name} has {entry.file_size:,} bytes"
                    raise InvalidFile(file, problem, f"at most {MAX_FILE_BYTES:,}")
                array = np.load(io.BytesIO(packed.read(entry)), allow_pickle=False)
                if array.ndim != n_dimensions or array.dtype.kind not in "fiu":
                    problem = f"{name} is {array.dtype} of shape {array.shape}"
                    raise InvalidFile(file, problem, f"{n_dimensions} axes of numbers")
                found[name] = array.astype(np.float64)
    except InvalidFile:
        raise
    except (*_DAMAGED, zipfile.BadZipFile) as error:
        problem = f"cannot be read ({reason_of(error)})"
        raise InvalidFile(file, problem, "an .npz file of measured eyes") from None
    return found


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
