"""Networks compared with ray tracing, at every step of the preparation of an eye.

    python -m tests.benchmarks.bench_networks [--quick] [--json] [--plot]

Tables 4 and 5 of the paper (`network_steps`), with its figures beside; random eyes
refined from a table and from the network's guess (`first_guess`).  A whole run writes
results/networks.json and .png, the quick one with --plot out/networks.png.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version

from estimator.networks.inference import DamagedWeights, WeightsMissing, load_network
from tests.benchmarks.first_guess import GuessRow, guess_rows
from tests.benchmarks.harness import (
    OUT,
    RESULTS,
    Row,
    machine_info,
    report,
    write_report,
)
from tests.benchmarks.network_plot import plot_steps
from tests.benchmarks.network_steps import StepRow, condition_rows
from tests.benchmarks.published_figures import CONDITIONS
from tests.benchmarks.published_networks import HARDWARE

REPEATS, QUICK_REPEATS = 20, 3
SEARCH_S, QUICK_SEARCH_S = 8.0, 1.0
N_RANDOM_EYES, N_QUICK_EYES = 1000, 50
QUICK_CONDITIONS = ("emmetropia", "keratoconus")
ASKED = ("eye", "focus", "aberration")
"""Networks that are measured; the discriminator only serves the training."""

PICTURE = "networks.png"


def weights() -> dict[str, dict]:
    """Say which networks are measured.

    Raises
    ------
    WeightsMissing, DamagedWeights
    """
    cards = {name: load_network(name).card for name in ASKED}
    return {
        name: {
            "n_parameters": card.n_parameters,
            "precision": card.precision,
            "commit": card.commit,
            "expected_error": f"{card.error}",
        }
        for name, card in cards.items()
    }


def run(*, quick: bool, say=lambda text: None) -> list[Row]:
    """Measure everything; ``say`` hears what is at work."""
    rows: list[Row] = []
    for case in QUICK_CONDITIONS if quick else CONDITIONS:
        say(case)
        rows += condition_rows(
            case,
            repeats=QUICK_REPEATS if quick else REPEATS,
            search_s=QUICK_SEARCH_S if quick else SEARCH_S,
        )
    say("first guess")
    rows += guess_rows(N_QUICK_EYES if quick else N_RANDOM_EYES)
    return rows


def print_steps(rows: Sequence[StepRow]) -> None:
    """Tables 4 and 5 in one: ours, and the paper's on its own hardware."""
    print(f"\npaper: {HARDWARE}, its own eyes, circles and reference")
    print(
        f"{'step':<10}{'method':<19}{'condition':<13}{'nodes':>5}{'ms':>10}"
        f"{'error':>10} {'of':<12}{'target':>8}{'paper ms':>11}{'error':>8}  setting"
    )
    for row in rows:
        paper = f"{'':>11}{'':>8}"
        if row.published:
            figures = row.published
            paper = f"{figures['median_ms']:>11.0f}{figures['error']:>8.4f}"
        print(
            f"{row.step:<10}{row.method:<19}{row.case:<13}{row.n_nodes:>5}"
            f"{row.median_ms:>10.2f}{row.error:>10.3g} {row.error_name:<12}"
            f"{row.target:>8.4f}{paper}  {row.setting}"
        )


def print_guesses(rows: Sequence[GuessRow]) -> None:
    """Refinements of random eyes, by where they start."""
    print("\nrandom eyes, refined")
    print(
        f"{'start':<24}{'n':>5}{'ms':>8}{'p95':>8}{'steps':>7}{'p95':>6}{'traced':>8}"
        f"{'error um':>10}{'p95':>9}{'failed':>8}{'outside':>9}"
    )
    for row in rows:
        print(
            f"{row.setting:<24}{row.n:>5}{row.median_ms:>8.1f}{row.p95_ms:>8.1f}"
            f"{row.median_iterations:>7.0f}{row.p95_iterations:>6.0f}"
            f"{row.median_traced:>8.0f}{row.error:>10.2g}{row.p95_error_um:>9.2g}"
            f"{row.n_failed:>8}{row.n_outside:>9}"
        )


def print_all(rows: Sequence[Row]) -> None:
    """Print both tables."""
    print_steps([row for row in rows if isinstance(row, StepRow)])
    print_guesses([row for row in rows if isinstance(row, GuessRow)])


def main() -> None:
    """Print tables, or only JSON; a whole run is also written."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="two eyes, few repeats")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", action="store_true", help="draw a quick run, too")
    arguments = parser.parse_args()
    start_s = time.perf_counter()
    try:
        measured = weights()
    except (WeightsMissing, DamagedWeights) as error:
        sys.exit(f"bench networks: {error}")
    rows = run(
        quick=arguments.quick,
        say=lambda text: print(f"{text} ...", file=sys.stderr, flush=True),
    )
    machine = {**machine_info(), "onnxruntime": version("onnxruntime")}
    content = report(rows, machine=machine)
    content |= {"networks": measured}
    if arguments.json:
        print(json.dumps(content))
    else:
        print_all(rows)
    folder = OUT if arguments.quick else RESULTS
    if arguments.plot or not arguments.quick:
        plot_steps([row for row in rows if isinstance(row, StepRow)], folder / PICTURE)
    if not arguments.quick:
        path = write_report("networks", content)
        if not arguments.json:
            print(f"written to {path}; {time.perf_counter() - start_s:.0f} s")


if __name__ == "__main__":
    main()
