"""Peripheral aberrations of people who were held out: prediction error.

    python -m tests.benchmarks.bench_people [--quick] [--json] [--plot] [--people N]

129 eyes of 65 people along the horizontal meridian (4 mm), in folds that keep a
person's eyes together.  Ours is `field_table` of a profile that has the axis alone, or
the axis and 20 deg to both sides, with the population fitted to the other folds; linear
predictors are fitted to the same folds.  Five people measured over 40 x 25 deg follow,
with the shipped population.  Error is the median over eyes of the length of the error
in (M, J0, J45), dpt, of the change from the axis; beside it stands that of the RMS of
all terms from the second to the fourth order, um.  Who falls into which fold moves an
angle's median by some per cent, so ours over the regression on M is drawn `DRAWS` times
and averaged, with its deviation between draws.

A second table compares the typical eye of a prescription of 0 dpt, and N persons drawn
with this prescription, with published measurements of people.  `people_optics` and
`people_vision` define the measures, `tests/human_data.py` contains the sources.  The
modulation of a group is the mean over its eyes, not that of the mean wavefront.  Then
`people_spread` compares spread, couplings and extremes of drawn persons with those of
people left out of the population.
Columns: value of the modeled eyes, published value, difference, change by residual
refraction, change by scattered light (double pass only), remaining difference, and the
range of 80 % of the modeled eyes.

Writes results/people.json and results/people_measures.png.
"""

import argparse
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from estimator.field.field_table import field_table
from estimator.optics.prescription import power_vectors_dpt
from estimator.optics.units import SPHERE_PER_C20
from estimator.optics.zernike import N_TERMS, nm_from_index, rescale_pupil
from estimator.periphery.change import peripheral_change
from estimator.periphery.population import (
    CIRCLE_MM,
    TERMS,
    MeasuredEyes,
    Population,
    load_measured_eyes,
    measured_population,
)
from estimator.profiles.parse import parse_profile, preset_names
from filter_service.progress import Progress
from tests.benchmarks.harness import OUT, RESULTS, Row, memory_mb, publish
from tests.benchmarks.people_findings import Finding, print_findings
from tests.benchmarks.people_measures_picture import plot_findings
from tests.benchmarks.people_modulation import REFRACTIONS
from tests.benchmarks.people_optics import (
    Curves,
    higher_order_findings,
    modulation_findings,
    near_findings,
    own_field_findings,
    refraction_findings,
)
from tests.benchmarks.people_picture import plot_fields, show_scene
from tests.benchmarks.people_spread import DRAWS as SPREAD_DRAWS
from tests.benchmarks.people_spread import PERSONS, spread_findings
from tests.benchmarks.people_vision import (
    PUPILS_MM,
    acuity_findings,
    straylight_findings,
)
from tests.measured_fields import load_measured_fields

FILE = Path(__file__).parents[1] / "data" / "peripheral_wavefronts.npz"
ANGLES_DEG = (-40.0, -30.0, -20.0, -10.0, 10.0, 20.0, 30.0, 40.0)
"""On the retina of a right eye, positive temporal: h = -angle."""

GIVEN_DEG = (-20.0, 20.0)
FOLDS, QUICK_FOLDS = 5, 2
SEED = 0
DRAWS, QUICK_DRAWS = 6, 1
"""Of persons into folds, for the ratio of ours to the regression on M."""

REPEATS = 5
RIDGES = {"M": 1.0, "all central terms": 100.0, "axis and +-20 deg": 10.0}
"""Of standardised inputs; each is the best of 1, 3, 10, 30, 100."""

WAVELENGTH_NM = 555.0

PEOPLE, QUICK_PEOPLE = 50, 4
"""Drawn persons."""

ACUITY_PEOPLE, QUICK_ACUITY_PEOPLE = 8, 0
"""Drawn persons whose acuity is predicted, which takes 0.5 s per value."""

QUICK_PUPILS_MM = (4.0,)

FIELDS, QUICK_FIELDS = 10, 2
"""Peripheries drawn for each measured axis."""

FIELD_ANGLES_DEG = (-20.0, -10.0, -5.0, 5.0, 10.0, 20.0)
QUICK_SPREAD_DRAWS, QUICK_PERSONS = 10, 100
QUICK_STEP = 6
"""With ``--quick``, every sixth measured eye is used."""


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


def meridian_predictions(
    judged: Meridian, fold_count: int, task: Callable[[float], None]
) -> dict[str, tuple[NDArray, float]]:
    """Predictions (n, 8, 12) of each method, and what one of ours takes, ms."""
    shape = judged.change_um.shape
    names = ("linear, M", "linear, all central terms", "linear, axis and +-20 deg")
    ours = ("people", "people, +-20 deg given", "eye model alone")
    found = {name: np.full(shape, np.nan) for name in (*names, *ours)}
    times_ms = dict.fromkeys(found, 0.0)
    for k, out in enumerate(folds(judged.people, fold_count)):
        for name in names:
            found[name][out] = judged.linear(name.removeprefix("linear, "), out)
        with _population_of(judged.people.select(~out)):
            for name, options in (
                ("people", {"given": False}),
                ("people, +-20 deg given", {"given": True}),
                ("eye model alone", {"given": False, "periphery": "model"}),
            ):
                start_s = time.perf_counter()
                found[name][out] = judged.ours(out, **options)
                elapsed_ms = 1e3 * (time.perf_counter() - start_s)
                times_ms[name] += elapsed_ms / shape[0]
        task((k + 1) / fold_count)
    mean = np.full(shape, np.nan)
    for out in folds(judged.people, fold_count):
        mean[out] = np.nanmean(judged.change_um[~out], axis=0)
    return {
        "the axis everywhere": (np.zeros(shape), 0.0),
        "mean change": (mean, 0.0),
        **{name: (values, times_ms[name]) for name, values in found.items()},
    }


def ratio_rows(judged: Meridian, fold_count: int, draws: int) -> Iterator[Row]:
    """Error of ours over that of the regression on M, mean and deviation of draws."""
    ratios = []
    for seed in range(SEED, SEED + draws):
        ours, linear = (np.full(judged.change_um.shape, np.nan) for _ in range(2))
        for out in folds(judged.people, fold_count, seed):
            linear[out] = judged.linear("M", out)
            with _population_of(judged.people.select(~out)):
                ours[out] = judged.ours(out, given=False)
        errors = [median_errors(told, judged.change_um)[0] for told in (ours, linear)]
        ratios.append(errors[0] / errors[1])
    for name, values in (
        ("mean ratio", np.mean(ratios, axis=0)),
        ("deviation of the ratio", np.std(ratios, axis=0)),
    ):
        for angle, value in zip(ANGLES_DEG, values, strict=True):
            yield Row(
                *("people", "people over linear, M", "left out"),
                *(f"retina {angle:+.0f} deg", draws, 0.0, 0.0, memory_mb()),
                *(name, float(value), "Jaeken & Artal 2012"),
            )


def _population_of(people: MeasuredEyes):
    """Return a context in which these people are the population."""
    population = Population.fit(people)
    return patch("estimator.periphery.change.measured_population", lambda: population)


def _rows(method, setting, count, time_ms, errors, reference) -> Iterator[Row]:
    for name, error in zip(("power_error_dpt", "rms_um"), errors, strict=True):
        yield Row(
            *("people", method, "left out", setting, count, time_ms, time_ms),
            *(memory_mb(), name, float(error), reference),
        )


def meridian_rows(judged: Meridian, predictions: dict) -> Iterator[Row]:
    """Errors of each method at each angle."""
    for method, (predicted_um, time_ms) in predictions.items():
        errors = median_errors(predicted_um, judged.change_um)
        known = np.isfinite(predicted_um + judged.change_um).all(axis=-1).sum(axis=0)
        for k, angle in enumerate(ANGLES_DEG):
            if "20 deg" in method and angle in GIVEN_DEG:
                continue
            yield from _rows(
                *(method, f"retina {angle:+.0f} deg", int(known[k]), time_ms),
                *((errors[0][k], errors[1][k]), "Jaeken & Artal 2012"),
            )


def direction_rows() -> Iterator[Row]:
    """What 627 directions of each preset take, and how far M is from people's."""
    h_deg, v_deg = (
        values.ravel()
        for values in np.meshgrid(np.linspace(-40, 40, 33), np.linspace(-24, 24, 19))
    )
    for name in preset_names():
        profile = parse_profile({"kind": "preset", "name": name})
        times_ms = []
        for _ in range(REPEATS):
            start_s = time.perf_counter()
            found_um = told_change_um(profile, h_deg, v_deg)
            times_ms.append(1e3 * (time.perf_counter() - start_s))
        told_um = peripheral_change(profile).zernike_um(h_deg, v_deg)
        error_um = found_um - told_um[:, list(TERMS)]
        sphere = TERMS.index(4)
        error_dpt = SPHERE_PER_C20 * np.abs(error_um[:, sphere]) / CIRCLE_MM**2
        yield Row(
            *("people", "627 directions", name, "40 x 24 deg", REPEATS),
            float(np.median(times_ms)),
            float(np.max(times_ms)),
            *(memory_mb(), "M, median error, dpt", float(np.median(error_dpt))),
            "people's change for such an axis",
        )


def field_rows() -> Iterator[Row]:
    """Errors over the whole field of five people that no population has seen."""
    directions_deg, zernike_um = load_measured_fields(FILE)
    h_deg, v_deg = directions_deg.T
    axis = int(np.flatnonzero((h_deg == 0.0) & (v_deg == 0.0))[0])
    on_disc = (h_deg >= 10.0) & (h_deg <= 20.0)  # the optic disc spoils these
    judged = (h_deg % 10.0 == 0.0) & ~on_disc & (np.hypot(h_deg, v_deg) > 5.0)
    change_um = zernike_um[:, judged] - zernike_um[:, [axis]]
    others = [
        np.mean(np.delete(change_um, k, axis=0), axis=0) for k in range(len(change_um))
    ]
    methods = {
        "the axis everywhere": np.zeros_like(change_um),
        "mean change of the other four": np.array(others),
    }
    times_ms = dict.fromkeys(methods, 0.0)
    for method, more in (("eye model alone", {"periphery": "model"}), ("people", {})):
        start_s = time.perf_counter()
        methods[method] = np.array(
            [
                told_change_um(profile_of(eye[axis], **more), *directions_deg[judged].T)
                for eye in zernike_um
            ]
        )
        times_ms[method] = 1e3 * (time.perf_counter() - start_s) / len(zernike_um)
    for method, predicted_um in methods.items():
        flat = [values.reshape(-1, len(TERMS)) for values in (predicted_um, change_um)]
        errors = [float(error) for error in median_errors(*flat)]
        yield from _rows(
            *(method, "40 x 25 deg", len(flat[0]), times_ms[method], errors),
            "Polans 2015",
        )


def field_findings(
    people: MeasuredEyes, fold_count: int, fields: int, step: int, curves: Curves
) -> Iterator[Finding]:
    """Compare modulations of predicted fields with those of the same people's own."""
    angles = list(FIELD_ANGLES_DEG)
    at = [int(np.flatnonzero(people.h_deg == h)[0]) for h in angles]
    own_um = people.zernike_um[::step, at]
    counts = {"most probable periphery": 1, "drawn peripheries": fields}
    predicted_um = {
        method: np.full((count, *own_um.shape), np.nan)
        for method, count in counts.items()
        if count
    }
    times_ms = dict.fromkeys(predicted_um, 0.0)
    for out in folds(people, fold_count):
        judged = np.flatnonzero(out[::step])
        with _population_of(people.select(~out)):
            for method, found_um in predicted_um.items():
                start_s = time.perf_counter()
                for k, eye in itertools.product(range(len(found_um)), judged.tolist()):
                    more = {}
                    if method == "drawn peripheries":
                        # Draws with the same seed deviate equally in all eyes.
                        more = {"sample": k * len(own_um) + eye}
                    axis_um = people.axis_um[::step][eye]
                    change_um = told_change_um(profile_of(axis_um, **more), angles)
                    found_um[k, eye] = axis_um + change_um
                elapsed_ms = 1e3 * (time.perf_counter() - start_s)
                times_ms[method] += elapsed_ms / found_um[:, :, 0, 0].size
    yield from own_field_findings(
        own_um,
        predicted_um,
        people.axis_um[::step],
        angles,
        times_ms,
        curves,
        REFRACTIONS,
    )


def found_beside_people(
    people: MeasuredEyes,
    seeds: Sequence[int],
    quick: bool,
    curves: Curves,
    task: Callable[[float, str], None],
) -> list[Finding]:
    """Return the results of all comparisons with published measurements."""
    step = QUICK_STEP if quick else 1
    readers = QUICK_ACUITY_PEOPLE if quick else ACUITY_PEOPLE
    fields = QUICK_FIELDS if quick else FIELDS
    fold_count = QUICK_FOLDS if quick else FOLDS
    sections = {
        "modulation": lambda: modulation_findings(
            seeds, people.select(_every(step, people)), curves
        ),
        "same people": lambda: field_findings(
            people, fold_count, fields if seeds else 0, step, curves
        ),
        "spread": lambda: spread_findings(
            people,
            folds(people, fold_count),
            profile_of,
            draws=QUICK_SPREAD_DRAWS if quick else SPREAD_DRAWS,
            persons=QUICK_PERSONS if quick else PERSONS,
        ),
        "higher orders": lambda: higher_order_findings(seeds, people),
        "near periphery": lambda: near_findings(seeds),
        "refraction": lambda: refraction_findings(seeds, people),
        "acuity": lambda: acuity_findings(
            seeds[:readers], QUICK_PUPILS_MM if quick else PUPILS_MM
        ),
        "straylight": straylight_findings,
    }
    found: list[Finding] = []
    for k, (name, section) in enumerate(sections.items()):
        task(k / len(sections), name)
        found += section()
    return found


def _every(step: int, people: MeasuredEyes) -> NDArray[np.bool_]:
    return np.arange(len(people.person)) % step == 0


def print_table(rows: list[Row]) -> None:
    """Print errors over the retina, a method a line."""
    print(f"{'retina, deg':34s}" + "".join(f"{a:+7.0f}" for a in ANGLES_DEG))
    names = dict.fromkeys(row.error_name for row in rows if "retina" in row.setting)
    units = {"power_error_dpt": "dpt", "rms_um": "um"}
    for name in names:
        for method in dict.fromkeys(row.method for row in rows):
            cells = {
                row.setting: row.error
                for row in rows
                if row.method == method and row.error_name == name
            }
            line = [cells.get(f"retina {angle:+.0f} deg") for angle in ANGLES_DEG]
            if any(cell is not None for cell in line):
                print(
                    f"{method + ', ' + units.get(name, name):34.34s}"
                    + "".join("      -" if c is None else f"{c:7.2f}" for c in line)
                )


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="two folds")
    parser.add_argument("--json", action="store_true", help="print the report alone")
    parser.add_argument("--plot", action="store_true", help="fields of the presets")
    parser.add_argument("--people", type=int, metavar="N", help="drawn persons")
    options = parser.parse_args()
    judged = Meridian(load_measured_eyes(FILE))
    measured_population()
    with Progress(quiet=options.json) as progress:
        task = progress.task("people", total=1.0, unit="%")
        count = QUICK_FOLDS if options.quick else FOLDS
        predictions = meridian_predictions(
            judged, count, lambda done: task.update(done, "folds")
        )
        task.update(1.0, "ratios")
        draws = QUICK_DRAWS if options.quick else DRAWS
        ratios = list(ratio_rows(judged, count, draws))
        persons = options.people
        if persons is None:
            persons = QUICK_PEOPLE if options.quick else PEOPLE
        curves: Curves = {}
        findings = found_beside_people(
            judged.people,
            range(persons),
            options.quick,
            curves,
            lambda done, name: task.update(done, name),
        )
    rows = [*meridian_rows(judged, predictions), *ratios]
    rows += [*field_rows(), *direction_rows()]
    rows += [row for found in findings for row in found.rows()]
    if not options.json:
        print_table(rows)
        print_findings(findings)
    whole = not options.quick and options.people is None
    folder = RESULTS if whole else OUT
    plot_findings(folder / "people_measures.png", findings, curves)
    if options.plot:
        plot_fields(RESULTS / "people.png")
        show_scene(RESULTS / "people_scene.jpg")
    publish("people", rows, as_json=options.json, is_whole=whole)


if __name__ == "__main__":
    main()
