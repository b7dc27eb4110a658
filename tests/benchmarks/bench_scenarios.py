"""The main figure of each scenario, an independent calculation of it, and times.

    python -m tests.benchmarks.bench_scenarios [--quick] [--json]

- ``figure``: acuity, contrast, straylight, halo, defocus or refraction of a state, less
  that of `scenario_truth`, whose calculations take numbers of the profile and, with
  an implant, coefficients of the eye.  The time is that of the program's figure.
- ``picture``: both states of a scenario at 480x270, from the rendered scene: time of
  eye and frame, and how much of the light the states move (the mean difference of
  linear light, in parts of white; one cannot be compared with anything else).

Writes results/scenarios.json.
"""

import argparse
import time

import numpy as np

from clients.scenarios import filtered_states, scenario_view, scenarios
from tests.benchmarks.harness import Row, memory_mb, publish
from tests.scenario_truth import figures

SIZE_PX = (480, 270)


def figure_rows() -> list[Row]:
    """Return a row for each figure."""
    rows = []
    for figure in figures():
        start_s = time.perf_counter()
        found = figure.found()
        elapsed_ms = 1e3 * (time.perf_counter() - start_s)
        expected = figure.expected()
        rows.append(
            Row(
                *("scenarios", "figure", figure.scenario),
                f"{figure.name}: {found:.4g}, own {expected:.4g}, "
                f"allowed {figure.tolerance:g}",
                *(1, elapsed_ms, elapsed_ms, memory_mb()),
                *(figure.unit, found - expected, figure.reference),
            )
        )
    return rows


def picture_rows(names: list[str]) -> list[Row]:
    """Return a row for each scenario."""
    rows = []
    for name in names:
        scenario = scenarios()[name]
        view = scenario_view(scenario, SIZE_PX)
        start_s = time.perf_counter()
        a, b = filtered_states(scenario, view, output="linear")
        elapsed_ms = 1e3 * (time.perf_counter() - start_s)
        moved = float(np.abs(a.color - b.color).mean())
        rows.append(
            Row(
                *("scenarios", "picture", name, f"{SIZE_PX[0]}x{SIZE_PX[1]}", 2),
                *(elapsed_ms / 2.0, elapsed_ms / 2.0, memory_mb()),
                *("mean difference of the states", moved, "each other"),
            )
        )
    return rows


def main() -> None:
    """Run, print, and write results/scenarios.json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="one picture")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    names = sorted(scenarios())[: 1 if options.quick else None]
    rows = figure_rows() + picture_rows(names)
    publish("scenarios", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
