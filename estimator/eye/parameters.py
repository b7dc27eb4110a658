"""The 45 parameters of the eye: names, order, ranges and population statistics.

Order and ranges match the paper's networks (Csoba & Kunkli 2023, Table 2); every
array of 45 parameters in this project has this order.  Axes are the project's: x to the
person's right, y up, z into the eye; the paper's y and z are our x and y.
"""

from dataclasses import dataclass, fields
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.zernike import N_TERMS, nm_from_index

N_PARAMETERS = 45

OFFSET_RADIUS_MM = 6.2
"""Radius of the disk on which the corneal offset terms are defined."""


class Parameter(NamedTuple):
    """One row of the table; every number has the unit that ends ``name``."""

    name: str
    sampled: tuple[float, float]
    """Range from which random eyes are drawn (the paper's Table 2)."""
    allowed: tuple[float, float]
    """Allowed range of profiles and of the estimation."""
    mean: float
    """Population mean, after Csoba & Kunkli 2023."""
    deviation: float
    """Standard deviation of the prior: the earlier work's dead zone, or the spread of
    eyes where that is wider.  It is small for the corneal rotations, which the offsets
    can replace, so that no eye is rotated far without need."""
    means: str


_OFFSETS_BY_ORDER = {
    # order: (sampled, allowed, deviation), mm.  Deviations are a third of the range.
    # Measured high orders come from the middle 3 to 5 mm of the cornea, so on the wide
    # disk of the offsets they need a larger range than the published sampling.
    1: (0.10, 0.12, 0.033),
    2: (0.10, 0.12, 0.033),
    3: (0.06, 0.10, 0.020),
    4: (0.06, 0.10, 0.020),
    5: (0.03, 0.08, 0.010),
    6: (0.03, 0.08, 0.010),
}


def offset_name(index: int) -> str:
    """Return the name of the corneal offset with OSA index ``index`` (1 to 27)."""
    return f"cornea_offset_j{index}_mm"


def _offset_row(index: int) -> Parameter:
    n, m = nm_from_index(index)
    sampled, allowed, deviation = _OFFSETS_BY_ORDER[n]
    return Parameter(
        offset_name(index),
        (-sampled, sampled),
        (-allowed, allowed),
        0.0,
        deviation,
        f"anterior offset, un-normalized Zernike ({n},{m}), toward the retina",
    )


# fmt: off
PARAMETERS: tuple[Parameter, ...] = (
    Parameter("eye_length_mm", (22.5, 25.5), (20.0, 30.0), 23.82, 0.81,
              "corneal apex to retina, axial"),
    Parameter("cornea_thickness_mm", (0.5, 0.6), (0.4, 0.7), 0.55, 0.03,
              "at the axis"),
    Parameter("cornea_anterior_radius_mm", (7.0, 8.6), (6.2, 9.4), 7.81, 0.25,
              "of the anterior conic; its astigmatism is in the offsets"),
    Parameter("cornea_posterior_astigmatism_ratio", (0.9, 1.1), (0.8, 1.2), 1.0, 0.02,
              "posterior radius along y over that along x"),
    Parameter("cornea_posterior_radius_ratio", (0.80, 0.85), (0.74, 0.92), 0.825, 0.02,
              "posterior radius along x over the anterior radius"),
    Parameter("cornea_anterior_conic_constant", (-1.5, -0.01), (-1.8, 0.2), -0.29, 0.15,
              "0 is a sphere, -1 a paraboloid"),
    Parameter("cornea_posterior_conic_constant", (-1.5, -0.01), (-1.8, 0.1),
              -0.34, 0.24, "0 is a sphere, -1 a paraboloid"),
    Parameter("cornea_anterior_rotation_deg", (-45.0, 45.0), (-45.0, 45.0), 0.0, 5.0,
              "about z, from x toward y"),
    Parameter("cornea_posterior_rotation_deg", (-45.0, 45.0), (-45.0, 45.0), 0.0, 5.0,
              "about z, from x toward y"),
    *(_offset_row(index) for index in range(1, N_TERMS)),
    Parameter("aqueous_thickness_mm", (1.5, 4.5), (1.5, 4.5), 2.90, 0.39,
              "posterior cornea to the anterior pole of the lens, which is the stop"),
    Parameter("lens_diameter_mm", (9.25, 9.75), (8.4, 10.2), 9.5, 0.15,
              "at the equator, relaxed"),
    Parameter("lens_volume_mm3", (150.0, 165.0), (140.0, 180.0), 160.1, 4.0,
              "kept in accommodation"),
    Parameter("lens_anterior_conic_constant", (-10.0, -1.0), (-12.0, 0.0), -4.4, 1.6,
              "0 is a sphere, -1 a paraboloid"),
    Parameter("lens_posterior_conic_constant", (-6.0, -1.0), (-8.0, 0.0), -4.0, 2.0,
              "0 is a sphere, -1 a paraboloid"),
    Parameter("lens_decentration_x_mm", (-0.2, 0.2), (-0.5, 0.5), 0.0, 0.1,
              "of the anterior pole"),
    Parameter("lens_decentration_y_mm", (-0.2, 0.2), (-0.5, 0.5), 0.0, 0.1,
              "of the anterior pole"),
    Parameter("lens_tilt_about_y_deg", (-3.0, 3.0), (-7.0, 7.0), 0.0, 1.5,
              "about the anterior pole; positive leans the axis to the person's right"),
    Parameter("lens_tilt_about_x_deg", (-3.0, 3.0), (-7.0, 7.0), 0.0, 1.5,
              "about the anterior pole; positive leans the axis down"),
)
"""The table, in vector order."""
# fmt: on

PARAMETER_NAMES = tuple(row.name for row in PARAMETERS)
OFFSET_SLICE = slice(9, 36)
"""Slice of the 27 offsets in the vector."""


@cache
def _columns() -> dict[str, int]:
    return {name: column for column, name in enumerate(PARAMETER_NAMES)}


def column(name: str) -> int:
    """Return the position of a parameter in the vector."""
    if name not in _columns():
        raise ValueError(f"eye parameter '{name}': allowed are {PARAMETER_NAMES}")
    return _columns()[name]


def sampled_ranges() -> NDArray[np.float64]:
    """Return the ranges of the paper's Table 2, (45, 2)."""
    return np.array([row.sampled for row in PARAMETERS])


def allowed_ranges() -> NDArray[np.float64]:
    """Return the allowed ranges of profiles and estimation, (45, 2)."""
    return np.array([row.allowed for row in PARAMETERS])


def mean_vector() -> NDArray[np.float64]:
    """Return the vector of the mean eye, (45,)."""
    return np.array([row.mean for row in PARAMETERS])


@dataclass(frozen=True, eq=False)
class EyeParameters:
    """Parameters of one relaxed eye, described in `PARAMETERS`.

    ``cornea_offset_mm`` (28,) holds the offset of OSA index j at j; its element 0, the
    corneal apex itself, is zero.
    """

    eye_length_mm: float
    cornea_thickness_mm: float
    cornea_anterior_radius_mm: float
    cornea_posterior_astigmatism_ratio: float
    cornea_posterior_radius_ratio: float
    cornea_anterior_conic_constant: float
    cornea_posterior_conic_constant: float
    cornea_anterior_rotation_deg: float
    cornea_posterior_rotation_deg: float
    cornea_offset_mm: NDArray[np.float64]
    aqueous_thickness_mm: float
    lens_diameter_mm: float
    lens_volume_mm3: float
    lens_anterior_conic_constant: float
    lens_posterior_conic_constant: float
    lens_decentration_x_mm: float
    lens_decentration_y_mm: float
    lens_tilt_about_y_deg: float
    lens_tilt_about_x_deg: float

    @classmethod
    def from_vector(cls, vector: ArrayLike) -> "EyeParameters":
        """Build from the 45 numbers in table order.

        Raises
        ------
        ValueError
            The vector is not 45 finite numbers.
        """
        vector = np.asarray(vector, dtype=np.float64)
        if vector.shape != (N_PARAMETERS,) or not np.all(np.isfinite(vector)):
            raise ValueError(
                f"eye vector of shape {vector.shape}: needs {N_PARAMETERS} finite"
            )
        values = dict(zip(PARAMETER_NAMES, vector.tolist(), strict=True))
        offset_mm = np.concatenate([[0.0], vector[OFFSET_SLICE]])
        scalars = {f.name: values[f.name] for f in fields(cls) if f.name in values}
        return cls(cornea_offset_mm=offset_mm, **scalars)

    @classmethod
    def mean_eye(cls) -> "EyeParameters":
        """Return the population's mean eye, without any offset."""
        return cls.from_vector(mean_vector())

    def to_vector(self) -> NDArray[np.float64]:
        """Return the 45 numbers in table order."""
        values = []
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "cornea_offset_mm":
                values.extend(np.asarray(value, dtype=np.float64)[1:].tolist())
            else:
                values.append(float(value))
        return np.array(values)

    def to_mapping(self) -> dict[str, float]:
        """Return the parameters by name, as in a profile of kind ``eye``."""
        return dict(zip(PARAMETER_NAMES, self.to_vector().tolist(), strict=True))


def random_vectors(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw vectors (count, 45) uniformly and independently from Table 2."""
    low, high = sampled_ranges().T
    return rng.uniform(low, high, size=(count, N_PARAMETERS))


@dataclass(frozen=True)
class RetinaShape:
    """Conicoid that replaces the sphere of radius eye length / 2, pole on the axis.

    ``radius_mm`` is the (positive) vertex radius; an ellipsoid with semi-axes a along
    the axis and b across has radius b²/a and conic constant b²/a² - 1, negative where
    it is prolate.
    """

    radius_mm: float
    conic_constant: float = 0.0
