"""Refraction and aberrations over the field of persons drawn from the population."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.field.field_table import FieldTable, field_table
from estimator.profiles.drawn_people import drawn_profiles
from estimator.profiles.parse import EyeProfile

PERCENTILES = (5, 50, 95)


@dataclass(frozen=True)
class DrawnFields:
    """Quantities of a `FieldTable` of each of N persons, in the same n directions.

    Attributes
    ----------
    power_dpt : (N, n, 3)
        M, J0 and J45.
    coma_um, higher_order_rms_um : (N, n)
    zernike_radius_mm : (N, n)
    """

    power_dpt: NDArray[np.float64]
    coma_um: NDArray[np.float64]
    higher_order_rms_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]

    def percentiles(self) -> list[dict[str, dict[str, float]]]:
        """Return the percentiles of each quantity in each direction, for JSON."""
        quantities = {
            "M_dpt": self.power_dpt[..., 0],
            "J0_dpt": self.power_dpt[..., 1],
            "J45_dpt": self.power_dpt[..., 2],
            "coma_um": self.coma_um,
            "higher_order_rms_um": self.higher_order_rms_um,
        }
        found = {name: percentiles_of(values) for name, values in quantities.items()}
        return [
            {name: numbers[k] for name, numbers in found.items()}
            for k in range(self.coma_um.shape[1])
        ]


def percentiles_of(values: NDArray[np.float64]) -> list[dict[str, float]]:
    """Return `PERCENTILES` of each of n values (N, n) of N persons, by name."""
    names = [str(percentile) for percentile in PERCENTILES]
    return [
        dict(zip(names, numbers, strict=True))
        for numbers in np.percentile(values, PERCENTILES, axis=0).T.tolist()
    ]


def drawn_fields(
    profile: EyeProfile,
    count: int,
    *,
    progress: Callable[[], None] | None = None,
    **states: Any,
) -> DrawnFields:
    """Return the fields of persons drawn from the population.

    A person takes 0.05 to 0.1 s on two cores.

    Parameters
    ----------
    profile : EyeProfile
    count : int
        Number of persons; see `drawn_profiles`.
    progress : callable, optional
        Called after each person.
    **states
        Directions, pupil, wavelength and focus; see `field_table`.

    Raises
    ------
    ValueError
        Persons with this profile do not differ, or the eye of one cannot be traced.
    """
    tables = []
    for person in drawn_profiles(profile, count):
        tables.append(_without_coefficients(field_table(person, **states)))
        if progress is not None:
            progress()
    return DrawnFields(*map(np.stack, zip(*tables, strict=True)))


def _without_coefficients(table: FieldTable) -> tuple[NDArray[np.float64], ...]:
    """Return the attributes of `DrawnFields`, a fifth of the memory of a table."""
    return (
        table.power_dpt,
        table.coma_um,
        table.higher_order_rms_um,
        table.zernike_radius_mm,
    )
