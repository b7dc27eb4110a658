"""Pupil and accommodation over time, compared with published curves.

- ``pupil, fitted``: pulses of light of 1 s at five powers, recorded by Martin, Pinto,
  Bulte & Spitschan (2021), which the time constants were fitted to.
- ``pupil, not fitted``: a longer pulse of another instrument, the same source.
- ``pupil, steady``: Watson & Yellott's unified formula (2012), reference values.
- ``accommodation``: peak speed of steps less the main sequence of young adults (ARVO
  2007, article 2407307); its error is in dpt/s.
- ``relaxation``: peak speed less Bharadwaj & Schor (2006).

Times are of one frame's step.
"""

import json
import math
import time

import numpy as np

from estimator.dynamics import AccommodationResponse, PupilReflex, steady_pupil_mm
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import timed_row
from tests.numerical.moving_eyes import (
    recorded_pulses,
    steps_response,
)
from tests.source_tree import ROOT

REFERENCE = json.loads((ROOT / "tests/data/eye_reference.json").read_text("utf-8"))
PULSE = "recorded pupils, Martin et al. 2021"
SPEEDS_PER_DPT = {"blur": 7.10, "both": 3.56}  # and the deviation among people:
SPREADS_PER_DPT = {"blur": 2.64, "both": 0.95}
STEPS_DPT = (1.0, 2.0, 3.0)
BEGINS_DPT = (2.0, 3.0, 4.0)
MINUTES = 1


def step_ms(n_steps: int) -> dict[str, list[float]]:
    """Return the times of a frame's step of pupil and focus."""
    pupil, focus = PupilReflex(30.0, 2800.0, 50.0), AccommodationResponse(0.0, 8.0)
    found = {}
    for name, step in (
        ("pupil", lambda i: pupil.follow(50.0 + 40.0 * math.sin(0.1 * i), i / 90)),
        ("focus", lambda i: focus.follow(1.0 + math.sin(0.1 * i), i / 90)),
    ):
        times_ms = []
        for i in range(n_steps):
            start_s = time.perf_counter()
            step(i)
            times_ms.append(1e3 * (time.perf_counter() - start_s))
        found[name] = times_ms
    return found


def peak_speeds():
    """Yield (kind, step_dpt, published, ours) in dpt/s."""
    for cue, per_dpt in SPEEDS_PER_DPT.items():
        for size_dpt in STEPS_DPT:
            times_s, found_dpt = steps_response(0.0, size_dpt, cue=cue)
            peak = float((np.diff(found_dpt) / np.diff(times_s)).max())
            yield cue, size_dpt, per_dpt * size_dpt, peak
    for begin_dpt in BEGINS_DPT:
        times_s, found_dpt = steps_response(begin_dpt, begin_dpt - 1.0)
        peak = -float((np.diff(found_dpt) / np.diff(times_s)).min())
        yield "relaxing", begin_dpt, 1.39 * begin_dpt + 1.12, peak


def measure(run: Run) -> list[Row]:
    """Return all rows."""
    costs_ms = step_ms(200 if run.is_quick else 5000)

    def row(method, case, setting, of, name, error, reference):
        return timed_row(
            *("dynamics", method, case, setting, costs_ms[of], name, error, reference)
        )

    rows = []
    for name, _, seen_mm, ours_mm in recorded_pulses():
        method = "pupil, not fitted" if "not fitted" in name else "pupil, fitted"
        rms_mm = np.sqrt(np.mean((ours_mm - seen_mm) ** 2))
        of_mm = f"of {np.ptp(seen_mm):.2f} mm"
        rows.append(row(method, name, of_mm, "pupil", "rms_mm", rms_mm, PULSE))
    errors_mm = [
        abs(
            steady_pupil_mm(one["L"], math.pi * (one["fov_deg"] / 2) ** 2, one["age"])
            - one["D"]
        )
        for one in REFERENCE["watson_yellott"]
    ]
    rows.append(
        row(
            *("pupil, steady", f"{len(errors_mm)} values", "", "pupil"),
            *("max_abs_mm", max(errors_mm), "Watson & Yellott 2012"),
        )
    )
    for kind, size_dpt, published, ours in peak_speeds():
        method = "relaxation" if kind == "relaxing" else "accommodation"
        spread = SPREADS_PER_DPT.get(kind, 0.0) * size_dpt
        setting = f"{published:.2f} dpt/s published, spread {spread:.2f}"
        rows.append(
            row(
                *(method, f"{kind}, {size_dpt:g} dpt", setting, "focus"),
                *("peak_dpt_s", ours - published, "main sequence, as cited"),
            )
        )
    return rows
