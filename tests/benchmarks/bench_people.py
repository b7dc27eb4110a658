"""Predicted eyes compared with people: their periphery, modulation, acuity, spread.

129 eyes of 65 people along the horizontal meridian (4 mm), in folds that keep a
person's eyes together.  ``people`` is `field_table` of a profile that has the axis
alone, or the axis and 20 deg to both sides, with the population fitted to the other
folds; linear predictors are fitted to the same folds.  Error is the median over eyes of
the length of the error in (M, J0, J45), dpt, of the change from the axis; beside it
stands that of the RMS of all terms from the second to the fourth order, um.

Then the typical eye of a prescription of 0 dpt, and N persons drawn with this
prescription, are compared with published measurements of people.  `people_optics` and
`people_vision` define the measures, `tests/human_data.py` contains the sources.  The
modulation of a group is the mean over its eyes, not that of the mean wavefront.
`people_spread` compares spread, couplings and extremes of drawn persons with those of
people left out of the population.  The setting of a row has the value of the modeled
eyes, with the changes by residual refraction and by scattered light (double pass).

A whole run draws people_measures.png, too.
"""

import itertools
import sys
import time
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from estimator.periphery.population import (
    MeasuredEyes,
    load_measured_eyes,
)
from tests.benchmarks.harness import Row, Run, written_path
from tests.benchmarks.people_findings import Finding
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
from tests.benchmarks.people_spread import DRAWS as SPREAD_DRAWS
from tests.benchmarks.people_spread import PERSONS, spread_findings
from tests.benchmarks.people_vision import (
    PUPILS_MM,
    acuity_findings,
    straylight_findings,
)
from tests.benchmarks.rows import row_of
from tests.numerical.left_out_people import (
    ANGLES_DEG,
    FILE,
    GIVEN_DEG,
    Meridian,
    folds,
    median_errors,
    population_of,
    profile_of,
    told_change_um,
)

MINUTES = 3.5
FOLDS, QUICK_FOLDS = 5, 2
PEOPLE, QUICK_PEOPLE = 50, 4
"""Drawn persons."""

ACUITY_PEOPLE = 8
"""Drawn persons whose acuity is predicted, which takes 0.5 s per value."""

FIELDS, QUICK_FIELDS = 10, 2
"""Peripheries drawn for each measured axis."""

FIELD_ANGLES_DEG = (-20.0, -10.0, -5.0, 5.0, 10.0, 20.0)
QUICK_SPREAD_DRAWS, QUICK_PERSONS = 10, 100
QUICK_STEP = 6
"""Every sixth measured eye is used."""


def meridian_predictions(
    judged: Meridian, fold_count: int
) -> dict[str, tuple[NDArray, float]]:
    """Predictions (n, 8, 12) of each method, and what one of ours takes, ms."""
    shape = judged.change_um.shape
    names = ("linear, M", "linear, all central terms", "linear, axis and +-20 deg")
    ours = ("people", "people, +-20 deg given", "eye model alone")
    found = {name: np.full(shape, np.nan) for name in (*names, *ours)}
    times_ms = dict.fromkeys(found, 0.0)
    for out in folds(judged.people, fold_count):
        for name in names:
            found[name][out] = judged.linear(name.removeprefix("linear, "), out)
        with population_of(judged.people.select(~out)):
            for name, options in (
                ("people", {"given": False}),
                ("people, +-20 deg given", {"given": True}),
                ("eye model alone", {"given": False, "periphery": "model"}),
            ):
                start_s = time.perf_counter()
                found[name][out] = judged.ours(out, **options)
                elapsed_ms = 1e3 * (time.perf_counter() - start_s)
                times_ms[name] += elapsed_ms / shape[0]
    mean = np.full(shape, np.nan)
    for out in folds(judged.people, fold_count):
        mean[out] = np.nanmean(judged.change_um[~out], axis=0)
    return {
        "the axis everywhere": (np.zeros(shape), 0.0),
        "mean change": (mean, 0.0),
        **{name: (values, times_ms[name]) for name, values in found.items()},
    }


def meridian_rows(judged: Meridian, predictions: dict) -> Iterator[Row]:
    """Errors of each method at each angle."""
    for method, (predicted_um, time_ms) in predictions.items():
        errors = median_errors(predicted_um, judged.change_um)
        known = np.isfinite(predicted_um + judged.change_um).all(axis=-1).sum(axis=0)
        for k, angle in enumerate(ANGLES_DEG):
            if "20 deg" in method and angle in GIVEN_DEG:
                continue
            for name, error in zip(("power_error_dpt", "rms_um"), errors, strict=True):
                yield row_of(
                    *("people", method, "left out", f"retina {angle:+.0f} deg"),
                    *([time_ms], name, error[k], "Jaeken & Artal 2012"),
                    n=int(known[k]),
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
        with population_of(people.select(~out)):
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


def options(parser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--people", type=int, metavar="N", help="drawn persons")


def measure(run: Run) -> list[Row]:
    """Return the rows of all comparisons, and draw the picture."""
    quick = run.is_quick
    judged, step = Meridian(load_measured_eyes(FILE)), QUICK_STEP if quick else 1
    people, fold_count = judged.people, QUICK_FOLDS if quick else FOLDS
    count = run.options.people
    if count is None:
        count = QUICK_PEOPLE if quick else PEOPLE
    seeds = range(count)
    curves: Curves = {}
    sections = {
        "modulation": lambda: modulation_findings(
            seeds, people.select(np.arange(len(people.person)) % step == 0), curves
        ),
        "same people": lambda: field_findings(
            people, fold_count, QUICK_FIELDS if quick else FIELDS, step, curves
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
            seeds[: 0 if quick else ACUITY_PEOPLE], (4.0,) if quick else PUPILS_MM
        ),
        "straylight": straylight_findings,
    }
    print("people: folds", file=sys.stderr, flush=True)
    rows = list(meridian_rows(judged, meridian_predictions(judged, fold_count)))
    findings: list[Finding] = []
    for name, section in sections.items():
        print(f"people: {name}", file=sys.stderr, flush=True)
        findings += section()
    plot_findings(written_path("people_measures.png"), findings, curves)
    return rows + [row for found in findings for row in found.rows()]
