"""Pupil and accommodation over time, compared with published curves.

    python -m tests.benchmarks.bench_dynamics [--quick] [--json]

- ``pupil, fitted``: pulses of light of 1 s at five powers, recorded by Martin, Pinto,
  Bulte & Spitschan (2021), which the time constants were fitted to.
- ``pupil, not fitted``: a longer pulse of another instrument, the same source.
- ``pupil, steady``: Watson & Yellott's unified formula (2012), reference values.
- ``accommodation``: peak speed of steps less the main sequence of young adults (ARVO
  2007, article 2407307); its error is in dpt/s.
- ``relaxation``: peak speed less Bharadwaj & Schor (2006).

Times are of one frame's step.  Writes results/dynamics.json and results/dynamics.png.
"""

import argparse
import json
import math
import time

import numpy as np

from estimator.dynamics import AccommodationResponse, PupilReflex, steady_pupil_mm
from tests.benchmarks.harness import OUT, RESULTS, Row, memory_mb, publish
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


def step_ms(n_steps: int) -> dict[str, tuple[float, float]]:
    """Return median and 95th percentile of one frame's step of pupil and focus."""
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
        found[name] = tuple(np.percentile(times_ms, (50, 95)).tolist())
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


def measured_rows(n_steps: int) -> list[Row]:
    """Return all rows."""
    costs_ms = step_ms(n_steps)

    def row(method, case, setting, of, name, error, reference):
        median_ms, p95_ms = costs_ms[of]
        return Row(
            *("dynamics", method, case, setting, n_steps, median_ms, p95_ms),
            *(memory_mb(), name, float(error), reference),
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


def draw(path) -> None:
    """Draw our curves over the published ones."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 2, figsize=(12, 8), layout="constrained")
    (pulse, longer), (steps, speeds) = axes
    for number, (name, times_s, seen_mm, ours_mm) in enumerate(recorded_pulses()):
        at = longer if "not fitted" in name else pulse
        color = f"C{number}"
        at.plot(times_s, seen_mm, "o", color=color, markersize=4, label=name)
        at.plot(times_s, ours_mm, "-", color=color)
    for at, title in (
        (pulse, "Pupil, pulses it was fitted to (dots: recorded)"),
        (longer, "Pupil, a pulse it was not fitted to"),
    ):
        at.set(xlabel="s", ylabel="pupil diameter, mm", title=title)
        at.legend(fontsize=8)
    for size_dpt in STEPS_DPT:
        for cue, style in (("blur", "--"), ("both", "-")):
            times_s, found_dpt = steps_response(0.0, size_dpt, cue=cue)
            steps.plot(times_s, found_dpt, style, label=f"to {size_dpt:g} dpt, {cue}")
        times_s, found_dpt = steps_response(size_dpt, 0.0)
        steps.plot(times_s, found_dpt, ":", label=f"from {size_dpt:g} dpt")
    steps.axvline(0.36, color="0.6", linewidth=0.8)
    steps.text(0.38, 2.9, "latency 0.36 s\nCampbell & Westheimer 1960", fontsize=8)
    steps.set(xlim=(0, 3), xlabel="s", ylabel="dpt", title="Focus after a step")
    steps.legend(fontsize=7, ncols=3)
    for number, (kind, size_dpt, published, ours) in enumerate(peak_speeds()):
        spread = SPREADS_PER_DPT.get(kind, 0.0) * size_dpt
        speeds.errorbar(number, published, yerr=spread, fmt="o", color="0.4", capsize=4)
        speeds.plot(number, ours, "x", color="C3")
        speeds.text(number, 0.2, f"{kind}\n{size_dpt:g} dpt", ha="center", fontsize=8)
    speeds.set(
        xticks=[],
        ylabel="peak speed, dpt/s",
        title="Peak speeds: published, with spread among people; ours (x)",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def main() -> None:
    """Measure, draw, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer steps")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    rows = measured_rows(200 if arguments.quick else 5000)
    draw((OUT if arguments.quick else RESULTS) / "dynamics.png")
    publish("dynamics", rows, as_json=arguments.json, is_whole=not arguments.quick)


if __name__ == "__main__":
    main()
