"""Predictions of the periphery of people who were left out of the population."""

from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from estimator.field.field_table import field_table
from estimator.optics.prescription import power_vectors_dpt
from estimator.optics.zernike import N_TERMS, nm_from_index, rescale_pupil
from estimator.periphery.population import (
    CIRCLE_MM,
    TERMS,
    MeasuredEyes,
    Population,
)
from estimator.profiles.parse import parse_profile

FILE = Path(__file__).parents[1] / "data" / "peripheral_wavefronts.npz"
ANGLES_DEG = (-40.0, -30.0, -20.0, -10.0, 10.0, 20.0, 30.0, 40.0)
"""On the retina of a right eye, positive temporal: h = -angle."""

GIVEN_DEG = (-20.0, 20.0)
SEED = 0
RIDGES = {"M": 1.0, "all central terms": 100.0, "axis and +-20 deg": 10.0}
"""Of standardized inputs; each is the best of 1, 3, 10, 30, 100."""

WAVELENGTH_NM = 555.0


def profile_of(zernike_um: NDArray, others: dict[float, NDArray] | None = None, **more):
    """Return a profile with the axis (12,), and other azimuths' (12,), if any."""

    def entry(terms_um: NDArray, h_deg: float) -> dict:
        return {
            "kind": "zernike",
            "pupil_diameter_mm": 2.0 * CIRCLE_MM,
            "wavelength_nm": WAVELENGTH_NM,
            "h_deg": h_deg,
            "zernike_um": {
                "{},{}".format(*nm_from_index(j)): float(um)
                for j, um in zip(TERMS, terms_um, strict=True)
            },
        }

    all_um = {0.0: zernike_um, **(others or {})}
    entries = [entry(terms_um, h_deg) for h_deg, terms_um in all_um.items()]
    return parse_profile({"kind": "zernike_set", "measurements": entries, **more})


def told_change_um(profile, h_deg, v_deg=0.0) -> NDArray[np.float64]:
    """Change (n, 12) from the axis that `field_table` tells, on the people's circle."""
    h_deg, v_deg = np.broadcast_arrays(h_deg, v_deg)
    table = field_table(
        profile,
        h_deg=np.append(0.0, h_deg),
        v_deg=np.append(0.0, v_deg),
        pupil_diameter_mm=2.0 * CIRCLE_MM,
        wavelength_nm=WAVELENGTH_NM,
    )
    zernike_um = rescale_pupil(
        table.zernike_um, radius_ratio=CIRCLE_MM / table.zernike_radius_mm
    )[:, list(TERMS)]
    return zernike_um[1:] - zernike_um[0]


def folds(
    people: MeasuredEyes, count: int, seed: int = SEED
) -> Iterator[NDArray[np.bool_]]:
    """Yield who is left out (n,), a share of the persons each time."""
    persons = np.random.default_rng(seed).permutation(np.unique(people.person))
    for k in range(count):
        yield np.isin(people.person, persons[k::count])


def fitted_ridge(inputs: NDArray, targets: NDArray, strength: float) -> Callable:
    """Fit targets (n, k), nan where unknown, linearly to inputs (n, m)."""
    mean, deviation = inputs.mean(axis=0), inputs.std(axis=0)

    def rows(values):
        return np.c_[np.ones(len(values)), (values - mean) / deviation]

    weights = np.zeros((inputs.shape[1] + 1, targets.shape[1]))
    penalty = strength * np.diag([0.0, *np.ones(inputs.shape[1])])
    for k, column in enumerate(targets.T):
        known = np.isfinite(column)
        used = rows(inputs[known])
        weights[:, k] = np.linalg.solve(used.T @ used + penalty, used.T @ column[known])
    return lambda values: rows(values) @ weights


class Meridian:
    """What every method is judged by: changes of people at the angles."""

    def __init__(self, people: MeasuredEyes):
        known = np.isfinite(people.axis_um).all(axis=-1)
        self.people = people.select(known)
        place = {float(h): k for k, h in enumerate(self.people.h_deg)}
        at = [place[-angle] for angle in ANGLES_DEG]
        self.change_um = self.people.change_um[:, at]
        given = [place[-angle] for angle in GIVEN_DEG]
        self.given_um = self.people.zernike_um[:, given]
        self.has_given = np.isfinite(self.given_um).all(axis=(1, 2))

    def linear(self, name: str, out: NDArray) -> NDArray[np.float64]:
        """Predict the eyes left out from those that are not."""
        inputs = self.people.axis_um
        if name == "M":
            inputs = inputs[:, [TERMS.index(4)]]
        elif name != "all central terms":
            inputs = np.c_[inputs, self.given_um.reshape(len(inputs), -1)]
        targets = self.change_um.reshape(len(inputs), -1)
        usable = np.isfinite(inputs).all(axis=1)
        predict = fitted_ridge(
            inputs[~out & usable], targets[~out & usable], RIDGES[name]
        )
        return predict(inputs[out]).reshape(-1, *self.change_um.shape[1:])

    def ours(self, out: NDArray, *, given: bool, **more) -> NDArray[np.float64]:
        """Predict the eyes left out by the public function."""
        found = np.full((int(out.sum()), *self.change_um.shape[1:]), np.nan)
        for row, eye in enumerate(np.flatnonzero(out)):
            others = None
            if given:
                if not self.has_given[eye]:
                    continue
                others = {
                    -angle: self.given_um[eye, k] for k, angle in enumerate(GIVEN_DEG)
                }
            profile = profile_of(self.people.axis_um[eye], others, **more)
            found[row] = told_change_um(profile, [-angle for angle in ANGLES_DEG])
        return found


def median_errors(predicted_um, measured_um) -> tuple[NDArray, NDArray]:
    """Medians over eyes (k,) of the error in (M, J0, J45), dpt, and of the RMS, um."""
    error_um = np.full((*predicted_um.shape[:-1], N_TERMS), 0.0)
    error_um[..., list(TERMS)] = predicted_um - measured_um
    lengths_dpt = np.linalg.norm(power_vectors_dpt(error_um, CIRCLE_MM), axis=-1)
    return (
        np.nanmedian(lengths_dpt, axis=0),
        np.nanmedian(np.linalg.norm(error_um, axis=-1), axis=0),
    )


def population_of(people: MeasuredEyes):
    """Return a context in which these people are the population."""
    population = Population.fit(people)
    return patch("estimator.periphery.change.measured_population", lambda: population)
