"""Spread, couplings and extremes of drawn persons, and of people left out.

The population is fitted to four fifths of the people, and persons are drawn who have
the axes of the eyes left out, or a prescription of -3 dpt.  M, J0 and J45 relative to
the axis, through 4 mm, are compared at `AT_DEG`, in eyes that were measured at all of
these.  Both sides have the same mean: mirrored left eyes have another J45, which does
not tell how people differ.  Those of one prescription are compared with people's
deviations from a regression on M.

Intervals are of 95 %, from bootstrap samples of persons, whose two eyes stay together.
A bootstrap sample contains no value beyond the largest one, so extremes are compared
otherwise: the largest deviation of the eyes left out with those of as many drawn ones,
and the higher orders of 1,000 drawn persons with those of 1,000 from log-normal
distributions fitted to the bootstrap samples, both over their mean.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from estimator.field.field_table import field_table
from estimator.optics.prescription import power_vectors_dpt
from estimator.optics.zernike import N_TERMS, rescale_pupil
from estimator.periphery.change import peripheral_change
from estimator.periphery.population import CIRCLE_MM, TERMS, MeasuredEyes, Population
from estimator.profiles.parse import EyeProfile, parse_profile
from estimator.profiles.typical_aberrations import (
    drawn_zernike_um,
    with_typical_aberrations,
)
from tests.benchmarks.people_findings import Finding

AT_DEG = (-30.0, -20.0, -10.0, 10.0, 20.0, 30.0)
"""Azimuths of a right eye; the nasal retina is at positive ones."""

POWERS = ("M", "J0", "J45")
COUPLINGS = (
    # two powers at two azimuths
    ("M", -30.0, "M", 30.0),
    ("M", -30.0, "J0", -30.0),
    ("M", 30.0, "J0", 30.0),
    ("J45", -30.0, "J45", 30.0),
    ("J0", -30.0, "J0", 30.0),
    ("M", -20.0, "M", 20.0),
)
EXTREMES = (("M", -30.0), ("M", 30.0))
INTERVAL = (2.5, 97.5)
RESAMPLES = 1000
DRAWS = 100
"""Persons drawn for each eye left out."""

PERSONS = 1000
PRESCRIBED = {"kind": "prescription", "sphere_dpt": -3.0, "age_years": 30}
RMS_PUPILS_MM = (4.0, 6.0)
TRACED = 20
"""Persons whose final eye is traced."""

SEED = 0
SOURCE = "Jaeken & Artal 2012"


class Left(NamedTuple):
    """Relative refractions of eyes left out, and of persons drawn with their axes.

    Attributes
    ----------
    person : (n,)
    own_dpt, line_dpt : (n, 6, 3)
        Measured, and from a regression on the axis of those that are not left out.
    drawn_dpt : (k, n, 6, 3)
        Of k persons drawn for each eye.
    """

    person: NDArray[np.int64]
    own_dpt: NDArray[np.float64]
    line_dpt: NDArray[np.float64]
    drawn_dpt: NDArray[np.float64]

    @classmethod
    def joined(cls, folds: Iterable["Left"]) -> "Left":
        """Return the eyes of all folds."""
        *parts, drawn_dpt = zip(*folds, strict=True)
        return cls(*map(np.concatenate, parts), np.concatenate(drawn_dpt, axis=1))


def power_dpt(terms_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return M, J0, J45 (..., 3) of coefficients (..., 12)."""
    zernike_um = np.zeros((*terms_um.shape[:-1], N_TERMS))
    zernike_um[..., list(TERMS)] = terms_um
    return power_vectors_dpt(zernike_um, CIRCLE_MM)


def complete_eyes(people: MeasuredEyes) -> MeasuredEyes:
    """Return the eyes that were measured on the axis and at all of `AT_DEG`."""
    known = np.isfinite(people.zernike_um[:, _at(people)]).all(axis=(1, 2))
    known &= np.isfinite(people.axis_um).all(axis=1)
    return people.select(known)


def _at(people: MeasuredEyes) -> list[int]:
    return [int(np.flatnonzero(people.h_deg == h)[0]) for h in AT_DEG]


def left_out(
    people: MeasuredEyes,
    out: NDArray[np.bool_],
    population: Population,
    profile_of: Callable[..., EyeProfile],
    *,
    draws: int = DRAWS,
) -> Left:
    """Draw persons with the axes of the complete eyes left out (n,)."""
    kept, left = (complete_eyes(people.select(which)) for which in (~out, out))
    kept_dpt, own_dpt = (
        power_dpt(eyes.change_um[:, _at(eyes)]) for eyes in (kept, left)
    )
    half_dpt = 0.5 * (
        kept_dpt[kept.is_left].mean(axis=0) - kept_dpt[~kept.is_left].mean(axis=0)
    )
    kept_dpt -= np.where(kept.is_left[:, None, None], half_dpt, -half_dpt)
    own_dpt -= np.where(left.is_left[:, None, None], half_dpt, -half_dpt)
    kept_axis, axis = (power_dpt(eyes.axis_um)[:, 0] for eyes in (kept, left))
    slope, offset = np.polyfit(kept_axis, kept_dpt.reshape(len(kept_dpt), -1), 1)
    # Draws with the same seed deviate equally in all eyes.
    first = int(np.flatnonzero(out)[0])
    drawn_um = [
        [
            _change_um(
                profile_of(axis_um, sample=(first + k) * len(out) + eye), population
            )
            for eye, axis_um in enumerate(left.axis_um)
        ]
        for k in range(draws)
    ]
    return Left(
        *(left.person, own_dpt),
        line_dpt=(np.outer(axis, slope) + offset).reshape(own_dpt.shape),
        drawn_dpt=power_dpt(np.array(drawn_um)),
    )


def _change_um(
    profile: EyeProfile, population: Population | None = None
) -> NDArray[np.float64]:
    change = peripheral_change(with_typical_aberrations(profile), population)
    return change.zernike_um(AT_DEG, 0.0)[:, list(TERMS)]


def prescribed_dpt(
    seeds: Iterable[int], population: Population | None = None
) -> NDArray[np.float64]:
    """Return relative M, J0, J45 (n, 6, 3) of persons with `PRESCRIBED`."""
    profiles = (parse_profile(PRESCRIBED | {"sample": seed}) for seed in seeds)
    return power_dpt(np.array([_change_um(p, population) for p in profiles]))


def traced_dpt(seeds: Iterable[int]) -> NDArray[np.float64]:
    """Return the same of their final eyes, traced on the measured circle."""
    found = []
    for seed in seeds:
        table = field_table(
            parse_profile(PRESCRIBED | {"sample": seed}),
            h_deg=[0.0, *AT_DEG],
            v_deg=0.0,
            pupil_diameter_mm=2.0 * CIRCLE_MM,
            wavelength_nm=555.0,
        )
        zernike_um = rescale_pupil(
            table.zernike_um, radius_ratio=CIRCLE_MM / table.zernike_radius_mm
        )
        powers_dpt = power_vectors_dpt(zernike_um, CIRCLE_MM)
        found.append(powers_dpt[1:] - powers_dpt[0])
    return np.array(found)


# ----- statistics; weights (b, n) count each eye in b samples


def spreads(
    values: NDArray[np.float64], weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return standard deviations (b, 6, 3) of values (n, 6, 3)."""
    flat = values.reshape(len(values), -1)
    found: NDArray[np.float64] = np.sqrt(_covariance(flat, flat, weights))
    return found.reshape(-1, *values.shape[1:])


def couplings(
    values: NDArray[np.float64], weights: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return correlations (b, 6) of values (n, 6, 3), in the order of `COUPLINGS`."""
    x, y = (
        np.stack(
            [values[:, AT_DEG.index(c[k + 1]), POWERS.index(c[k])] for c in COUPLINGS],
            axis=-1,
        )
        for k in (0, 2)
    )
    xx, xy, yy = (_covariance(*pair, weights) for pair in ((x, x), (x, y), (y, y)))
    found: NDArray[np.float64] = xy / np.sqrt(xx * yy)
    return found


def _covariance(
    x: NDArray[np.float64], y: NDArray[np.float64], weights: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return covariances (b, k) of pairs of columns (n, k)."""
    if weights is None:
        weights = np.ones((1, len(x)))
    weights = weights / weights.sum(axis=1, keepdims=True)
    found: NDArray[np.float64] = weights @ (x * y) - (weights @ x) * (weights @ y)
    return found


def bootstrap_weights(person: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how often each eye (n,) occurs in `RESAMPLES` samples of persons."""
    persons, index = np.unique(person, return_inverse=True)
    random = np.random.default_rng(SEED)
    even = np.full(len(persons), 1.0 / len(persons))
    counts = random.multinomial(len(persons), even, size=RESAMPLES)
    return counts[:, index].astype(np.float64)


def largest_deviations(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return largest deviations (..., 2) of values (..., n, 6, 3) from 0."""
    at = [(AT_DEG.index(h), POWERS.index(power)) for power, h in EXTREMES]
    return np.stack([np.abs(values[..., k, p]).max(axis=-1) for k, p in at], axis=-1)


def rms_extremes(
    zernike_um: NDArray[np.float64], radius_ratio: float
) -> tuple[float, float]:
    """Return 99th percentile and largest RMS of eyes (n, 28), over their mean."""
    rms_um = np.linalg.norm(
        rescale_pupil(zernike_um, radius_ratio=radius_ratio)[:, 6:], axis=1
    )
    return (
        float(np.percentile(rms_um, 99.0) / rms_um.mean()),
        float(rms_um.max() / rms_um.mean()),
    )


def measured_rms_extremes(people: MeasuredEyes) -> NDArray[np.float64]:
    """Return 99th percentile and largest of 1,000 (b, 2) of log-normal fits."""
    rms_um = np.linalg.norm(people.axis_um[:, 3:], axis=1)
    weights = bootstrap_weights(people.person)
    weights /= weights.sum(axis=1, keepdims=True)
    mean, square = weights @ np.log(rms_um), weights @ np.log(rms_um) ** 2
    deviation = np.sqrt(square - mean**2)[:, None]
    draws = np.random.default_rng(SEED).standard_normal((RESAMPLES, PERSONS))
    rms = np.exp(mean[:, None] + deviation * draws)
    highest = np.stack([np.percentile(rms, 99.0, axis=1), rms.max(axis=1)], axis=-1)
    return highest / (weights @ rms_um)[:, None]


# ----- findings


def interval_of(
    values: NDArray[np.float64], center: float | None = None
) -> tuple[float, float]:
    """Return the 95 % interval of values (b,).

    With the ``center`` of bootstrap samples it is bias-corrected (Efron, J Am Stat
    Assoc 82:171, 1987): the deviation of a sample of a sample is too small.
    """
    levels = np.array(INTERVAL)
    if center is not None:
        below = np.clip(np.mean(values < center), 0.5 / len(values), 1.0)
        levels = 100.0 * norm.cdf(2.0 * norm.ppf(below) + norm.ppf(levels / 100.0))
    low, high = np.percentile(values, levels).tolist()
    return low, high


def fold_findings(name: str, left: Left) -> Iterator[Finding]:
    """Compare drawn persons with the eyes left out that have the same axes."""
    drawn_dpt = left.drawn_dpt.reshape(-1, *left.own_dpt.shape[1:])
    yield from _spread_findings(name, drawn_dpt, left.person, left.own_dpt)
    own = largest_deviations(left.own_dpt - left.line_dpt)
    drawn = largest_deviations(left.drawn_dpt - left.line_dpt)
    for k, (power, at_deg) in enumerate(EXTREMES):
        median = float(np.median(drawn[:, k]))
        # as a factor of people's value, that by which drawn samples differ
        low, high = (own[k] * median / v for v in interval_of(drawn[:, k])[::-1])
        yield Finding(
            *("extremes of people", name),
            f"largest deviation of {power}, {at_deg:+.0f} deg",
            *(median, float(own[k]), "dpt", SOURCE, len(drawn_dpt)),
            interval=(float(low), float(high)),
        )


def _spread_findings(
    name: str,
    drawn_dpt: NDArray[np.float64],
    person: NDArray[np.int64],
    own_dpt: NDArray[np.float64],
) -> Iterator[Finding]:
    """Yield a deviation for each power and angle, then the couplings."""
    weights = bootstrap_weights(person)
    settings = {
        ("spread of people", "dpt", spreads): [
            f"SD of {power}, {at_deg:+.0f} deg" for at_deg in AT_DEG for power in POWERS
        ],
        ("couplings of people", "correlation", couplings): [
            f"{power} {at_deg:+.0f} with {other} {other_deg:+.0f} deg"
            for power, at_deg, other, other_deg in COUPLINGS
        ],
    }
    for (measure, unit, statistic), names in settings.items():
        ours, theirs = (statistic(v).ravel() for v in (drawn_dpt, own_dpt))
        samples = statistic(own_dpt, weights).reshape(RESAMPLES, -1)
        for k, setting in enumerate(names):
            yield Finding(
                *(measure, name, setting),
                *(float(ours[k]), float(theirs[k]), unit, SOURCE, len(drawn_dpt)),
                interval=interval_of(samples[:, k], float(theirs[k])),
            )


def traced_finding(persons: int) -> Finding:
    """Compare relative refractions of final eyes with the drawn changes."""
    start_s = time.perf_counter()
    traced = traced_dpt(range(persons))
    elapsed_ms = 1e3 * (time.perf_counter() - start_s) / persons
    error_dpt = np.abs(traced - prescribed_dpt(range(persons)))
    return Finding(
        *("spread of people", "-3 dpt", "traced less drawn, median"),
        *(float(np.median(error_dpt)), 0.0, "dpt", "drawn change", persons),
        time_ms=elapsed_ms,
    )


def rms_findings(
    outs: dict[str, MeasuredEyes], persons: int = PERSONS
) -> Iterator[Finding]:
    """Compare the largest higher-order RMS of drawn persons with that of people."""
    zernike_um = np.array(
        [drawn_zernike_um(k, None, eye_side="OD") for k in range(persons)]
    )
    for name, people in outs.items():
        of_people = measured_rms_extremes(people)
        for pupil_mm in RMS_PUPILS_MM:
            found = rms_extremes(zernike_um, pupil_mm / 6.0)
            for k, what in enumerate(("99th percentile", "largest of 1000")):
                yield Finding(
                    *("extremes of people", name),
                    f"higher-order RMS, {what}, {pupil_mm:g} mm",
                    *(found[k], float(np.median(of_people[:, k])), "of the mean"),
                    *(SOURCE, persons),
                    interval=interval_of(of_people[:, k]),
                )


def spread_findings(
    people: MeasuredEyes,
    outs: Iterable[NDArray[np.bool_]],
    profile_of: Callable[..., EyeProfile],
    *,
    draws: int = DRAWS,
    persons: int = PERSONS,
) -> Iterator[Finding]:
    """Compare drawn persons with people left out, by fold and all together."""
    folds = {f"fold {k + 1}": out for k, out in enumerate(outs)}
    lefts, prescribed = {}, []
    for k, (name, out) in enumerate(folds.items()):
        population = Population.fit(people.select(~out))
        lefts[name] = left_out(people, out, population, profile_of, draws=draws)
        seeds = range(k, persons, len(folds))
        prescribed.append(prescribed_dpt(seeds, population))
    whole = Left.joined(lefts.values())
    for name, left in (lefts | {"all left out": whole}).items():
        yield from fold_findings(name, left)
    yield from _spread_findings(
        "-3 dpt",
        np.concatenate(prescribed),
        whole.person,
        whole.own_dpt - whole.line_dpt,
    )
    yield traced_finding(min(persons, TRACED))
    yield from rms_findings(
        {name: people.select(out) for name, out in folds.items()}
        | {"all left out": people},
        persons,
    )
