"""Time to estimate an eye, and its error: network, refinement and search.

    python -m tests.benchmarks.bench_estimate [--quick] [--json]

Reference: exact ray tracing of the estimated eye; errors are the mean absolute
difference from the measurement over the 25 terms without tilt.  Times are wall clock,
warm, with the threads the program uses.  Writes results/estimate.json and .png.
"""

import argparse
import json
import time

import numpy as np

from estimator.estimate.estimation import estimate_eye
from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.parameters import random_vectors
from estimator.eye.tracing import seen_refraction_of_vectors, zernike_of_vectors
from estimator.profiles.parse import preset_names
from tests.benchmarks.eye_ways import (
    ERROR_NAME,
    REFERENCE,
    TimedEye,
    preset_profile,
    timed_eye,
    timed_search,
)
from tests.benchmarks.harness import (
    RESULTS,
    Row,
    memory_mb,
    print_rows,
    report,
    time_calls,
    write_report,
)
from tests.benchmarks.network_nodes import FOCUSES_DPT
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.published_networks import published_step
from tests.numerical.eye_cases import population_profiles, random_eye_profiles
from tests.numerical.test_peripheral_refraction import (
    ANGLES_DEG,
    PROLATE,
    relative_refraction_dpt,
    retina_of_refraction,
)

PERIPHERAL_REFERENCE = "at 30 deg: myopes +0.80, emmetropes -0.41 (Mutti 2000)"
SEARCH_TIMES_S = (1.0, 8.0)
QUICK_SEARCH_TIMES_S = (1.0,)
WAYS = (
    # method, where a refined eye may start
    ("refined", ("table", "network")),
    ("refined", ("table",)),
    ("refined", ("network",)),
    ("network", ("table",)),
)
TRACED_EYES = 2000


def _row(method, case, setting, n, times_ms, error, *, name=ERROR_NAME) -> Row:
    median_ms, p95_ms = times_ms
    return Row(
        *("estimate", method, case, setting, n, median_ms, p95_ms, memory_mb()),
        *(name, float(error), REFERENCE),
    )


def _eye_row(method, case, setting, timed: TimedEye) -> Row:
    error_um = timed.found.mean_abs_error_um
    return _row(method, case, setting, timed.n, timed.times_ms, error_um)


def preset_rows(repeats: int, search_times_s) -> list[Row]:
    """Every condition by every method."""
    rows = []
    for name in preset_names():
        profile = preset_profile(name)
        for method, starts in WAYS:
            timed = timed_eye(profile, repeats=repeats, method=method, starts=starts)
            found = timed.found
            setting = f"{found.n_evaluations} eyes traced"
            if method == "refined":
                setting += ", from " + (" or ".join(starts))
            if found.method != method:
                setting = f"{found.method}: {found.network_reason}"
            rows.append(_eye_row(method, name, setting, timed))
        for limit_s in search_times_s:
            timed = timed_search(profile, max_time_s=limit_s)
            setting = f"{timed.found.n_evaluations} eyes traced"
            rows.append(_eye_row("search", name, setting, timed))
    return rows


def many_rows(count: int) -> list[Row]:
    """Random eyes and population wavefronts: median and 95th percentile."""
    rng = np.random.default_rng(132)
    cases = {
        "random eyes": [p for p, _ in random_eye_profiles(count, rng)],
        "population": population_profiles(count, rng),
    }
    rows = []
    for case, profiles in cases.items():
        found = [estimate_eye(profile) for profile in profiles]
        times_ms = np.array([f.time_ms for f in found])
        errors_um = np.array([f.mean_abs_error_um for f in found])
        spread = (float(np.median(times_ms)), float(np.percentile(times_ms, 95)))
        for label, value in (
            ("median error", np.median(errors_um)),
            ("95th percentile error", np.percentile(errors_um, 95)),
            ("largest error", errors_um.max()),
        ):
            rows.append(_row("refined", case, label, count, spread, value))
    return rows


def focus_rows(repeats: int) -> list[Row]:
    """Seven focus states of each of three conditions, in one batch."""
    rows = []
    for name in ("emmetropia", "myopia", "keratoconus"):
        found = estimate_eye(preset_profile(name))
        eye = AccommodatingEye(found.parameters, pupil_diameter_mm=4.0)

        def focus_all(parameters=found.parameters):
            made = AccommodatingEye(parameters, pupil_diameter_mm=4.0)
            return made.focused_at(FOCUSES_DPT)

        states = eye.focused_at(FOCUSES_DPT)
        refractions_dpt = seen_refraction_of_vectors(
            np.stack([s.parameters.to_vector() for s in states]), pupil_diameter_mm=4.0
        )
        focuses_dpt = np.array([s.focus_dpt for s in states])
        error_dpt = float(np.abs(refractions_dpt + focuses_dpt).max())
        times_ms = time_calls(focus_all, repeats=repeats)
        setting = f"{len(FOCUSES_DPT)} focus states"
        rows.append(
            _row("focus", name, setting, repeats, times_ms, error_dpt, name="max_dpt")
        )
    return rows


def trace_rows(repeats: int) -> list[Row]:
    """Cost of one eye's coefficients on axis, and the share that has none."""
    vectors = random_vectors(TRACED_EYES, np.random.default_rng(0))

    def trace():
        return zernike_of_vectors(vectors, pupil_diameter_mm=5.0, wavelength_nm=555.0)

    lost_ratio = float(np.mean(np.isnan(trace()).any(axis=1)))
    times_ms = time_calls(trace, repeats=repeats, per_call=TRACED_EYES)
    setting = f"{1000.0 / times_ms[0]:.0f} eyes per s"
    return [
        _row(
            *("trace", "random eyes", setting, TRACED_EYES, times_ms, lost_ratio),
            name="lost_ratio",
        )
    ]


def peripheral_rows() -> list[Row]:
    """Relative peripheral refraction of a -6 dpt eye by its retina, 0 to 45 deg."""
    rows = []
    for case, name, retina in (
        ("-6 D, sphere", "myopia", None),
        ("-6 D, prolate", "myopia", PROLATE),
        ("-6 D, Atchison", "myopia", retina_of_refraction(-6.0)),
        ("0 D, Atchison", "emmetropia", retina_of_refraction(0.0)),
    ):
        start_s = time.perf_counter()
        relative_dpt = relative_refraction_dpt(name, retina)
        time_ms = 1000.0 * (time.perf_counter() - start_s)
        for angle_deg, value in zip(ANGLES_DEG, relative_dpt, strict=True):
            rows.append(
                Row(
                    *("estimate", "peripheral", case, f"{angle_deg:g} deg", 1),
                    *(time_ms, time_ms, memory_mb(), "relative_dpt", float(value)),
                    PERIPHERAL_REFERENCE,
                )
            )
    return rows


def plot(rows: list[Row]) -> None:
    """Error against time of both methods, beside the published ones."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axes = figure.subplots()
    colors = {name: f"C{i}" for i, name in enumerate(CONDITIONS)}
    for name, color in colors.items():
        for method, marker in (("refined", "o"), ("search", "s"), ("network", "^")):
            chosen = [r for r in rows if r.case == name and r.method == method]
            axes.plot(
                [r.median_ms / 1000.0 for r in chosen],
                [r.error for r in chosen],
                marker=marker,
                color=color,
                lw=0.8,
                label=name if method == "refined" else None,
            )
        for method, marker in (("search", "x"), ("network", "+")):
            theirs = published_step("eye", name, method)
            axes.plot(theirs.median_ms / 1e3, theirs.error, marker, color=color)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("time, s")
    axes.set_ylabel("mean absolute error, um")
    axes.set_title("o refined, ^ network, squares search; published: x and + network")
    axes.legend(fontsize=8)
    RESULTS.mkdir(parents=True, exist_ok=True)
    figure.savefig(RESULTS / "estimate.png", dpi=120)


def main() -> None:
    """Print a table, write results/estimate.json and its plot; or print only JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="short search, few eyes")
    parser.add_argument("--json", action="store_true", help="print only JSON")
    arguments = parser.parse_args()
    start_s = time.perf_counter()
    search_times_s = QUICK_SEARCH_TIMES_S if arguments.quick else SEARCH_TIMES_S
    rows = (
        preset_rows(5 if arguments.quick else 20, search_times_s)
        + many_rows(20 if arguments.quick else 200)
        + focus_rows(5)
        + trace_rows(3)
        + peripheral_rows()
    )
    content = report(rows)
    if arguments.json:
        print(json.dumps(content))
    else:
        print_rows(rows)
    if not arguments.quick:
        plot(rows)
        path = write_report("estimate", content)
        if not arguments.json:
            print(f"written to {path}; {time.perf_counter() - start_s:.0f} s")


if __name__ == "__main__":
    main()
