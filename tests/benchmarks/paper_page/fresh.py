"""The benchmarks that the page needs, run one after the other.

Their results go to a folder of their own; whole runs of those that keep results renew
the committed files as well, as `ocufilter bench` does.  What needs another machine, an
hour (live.json), or the training, stays as it is: see `announcement`.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from filter_service.progress import Progress
from tests.benchmarks.harness import ROOT

TAIL_CHARACTERS = 300


class BenchFailed(Exception):
    """A benchmark ended with an error."""


@dataclass(frozen=True)
class Run:
    """A benchmark, and about how long it takes on two cores.

    ``module`` may name the benchmark that it runs, after a blank.
    """

    name: str
    module: str
    whole_min: float
    quick_min: float
    prints_json: bool = True


RUNS = (
    Run("paper_layouts", "tests.benchmarks.paper_page.layouts", 0.2, 0.2),
    Run("layers", "tests.benchmarks layers", 4.0, 1.0),
    Run("networks", "tests.benchmarks.bench_networks", 8.0, 1.5),
    Run("published", "tests.benchmarks published", 8.0, 2.0),
    Run("paper_figures", "tests.benchmarks.paper_page.pictures", 12.0, 1.0, False),
    Run("field", "tests.benchmarks field", 55.0, 1.5),
)


def announcement(*, quick: bool) -> str:
    """Say what will run, and about how long."""
    parts, total_min = [], 0.0
    for run in RUNS:
        minutes = run.quick_min if quick else run.whole_min
        total_min += minutes
        parts.append(f"{run.name} {minutes:g} min")
    return (
        f"Running {len(RUNS)} benchmarks, about {total_min:.0f} minutes of two quiet "
        f"cores: {', '.join(parts)}.  gpu.json, live.json, table3.json and "
        "table11.json stay as committed."
    )


def run_all(folder: Path, *, quick: bool, progress: Progress) -> None:
    """Run every benchmark; results lie in a folder then.

    Raises
    ------
    BenchFailed
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.json"):
        old.unlink()
    task = progress.task("Benchmarks", total=len(RUNS), unit="done")
    for done, run in enumerate(RUNS):
        task.update(done, run.name)
        _run(run, folder, quick=quick)
    task.update(len(RUNS))


def _run(run: Run, folder: Path, *, quick: bool) -> None:
    arguments = ["--json"] if run.prints_json else ["--out", str(folder)]
    if quick:
        arguments.append("--quick")
    finished = subprocess.run(
        [sys.executable, "-m", *run.module.split(), *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if finished.returncode != 0:
        why = finished.stderr.strip()[-TAIL_CHARACTERS:]
        raise BenchFailed(f"{run.name} ended with code {finished.returncode}: {why}")
    if run.prints_json:
        path = folder / f"{run.name}.json"
        path.write_text(finished.stdout, encoding="utf-8")
