"""The main figure of each scenario, an independent calculation of it, and times.

- ``figure``: acuity, contrast, straylight, halo, defocus or refraction of a state, less
  that of `scenario_truth`, whose calculations take numbers of the profile and, with
  an implant, coefficients of the eye.  The time is that of the program's figure.
- ``picture``: both states of a scenario at 480x270, from the rendered scene: time of
  eye and frame, and how much of the light the states move (the mean difference of
  linear light, in parts of white; one cannot be compared with anything else).
"""

import time

import numpy as np

from clients.scenarios import filtered_states, scenario_view, scenarios
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.scenario_truth import figures

MINUTES = 2
SIZE_PX = (480, 270)


def figure_rows() -> list[Row]:
    """Return a row for each figure."""
    rows = []
    for figure in figures():
        start_s = time.perf_counter()
        found = figure.found()
        elapsed_ms = 1e3 * (time.perf_counter() - start_s)
        expected = figure.expected()
        setting = (
            f"{figure.name}: {found:.4g}, own {expected:.4g}, "
            f"allowed {figure.tolerance:g}"
        )
        rows.append(
            row_of(
                *("scenarios", "figure", figure.scenario, setting, [elapsed_ms]),
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
            row_of(
                *("scenarios", "picture", name, f"{SIZE_PX[0]}x{SIZE_PX[1]}"),
                *([elapsed_ms / 2.0], "mean difference of the states"),
                *(moved, "each other"),
                n=2,
            )
        )
    return rows


def measure(run: Run) -> list[Row]:
    """Return a row for each figure, and for the pictures of one or all scenarios."""
    names = sorted(scenarios())[: 1 if run.is_quick else None]
    return figure_rows() + picture_rows(names)
