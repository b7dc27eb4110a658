"""The paper's tables and figures beside ours, as one page.

    ocufilter paper [-o paper.html] [--fresh [--quick]] [--json]

Without options from the committed results, in seconds.  With --fresh the benchmarks run
first and the page says so; --quick takes few cases of each, at small sizes.  Results of
a fresh run go to a folder of their own.  What needs another machine, a
stream (live.json), or the training, stays as committed.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from filter_service.progress import Progress
from tests.benchmarks.harness import OUT, ROOT
from tests.benchmarks.paper_page.content import all_sections
from tests.benchmarks.paper_page.measured import Measured, ResultMissing
from tests.benchmarks.paper_page.page import page, summary_line, without_pictures
from tests.benchmarks.paper_page.rows import VERDICTS, counts

FRESH = OUT / "paper"
TAIL_CHARACTERS = 300
RUNS = {
    # benchmark: minutes of a whole and of a quick run
    "paper_layouts": (0.2, 0.2),
    "layers": (4.0, 1.0),
    "networks": (6.0, 0.5),
    "published": (5.0, 2.0),
    "paper_figures": (6.0, 1.0),
    "field": (22.0, 1.5),
}


class BenchFailed(Exception):
    """A benchmark ended with an error."""


def announcement(*, quick: bool) -> str:
    """Say what will run, and about how long."""
    minutes = {name: run[1 if quick else 0] for name, run in RUNS.items()}
    return (
        f"Running {len(RUNS)} benchmarks, about {sum(minutes.values()):.0f} minutes of "
        f"two quiet cores: {', '.join(f'{n} {m:g} min' for n, m in minutes.items())}.  "
        "gpu.json, live.json, table3.json and table11.json stay as committed."
    )


def run_all(*, quick: bool, progress: Progress) -> None:
    """Run every benchmark; results lie in `FRESH` then.

    Raises
    ------
    BenchFailed
    """
    FRESH.mkdir(parents=True, exist_ok=True)
    for old in FRESH.glob("*.json"):
        old.unlink()
    task = progress.task("Benchmarks", total=len(RUNS), unit="done")
    for done, name in enumerate(RUNS):
        task.update(done, name)
        finished = subprocess.run(
            [
                *(sys.executable, "-m", "tests.benchmarks", name, "--json"),
                *(["--quick"] if quick else []),
            ],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        if finished.returncode != 0:
            why = finished.stderr.strip()[-TAIL_CHARACTERS:]
            raise BenchFailed(f"{name} ended with code {finished.returncode}: {why}")
        (FRESH / f"{name}.json").write_text(finished.stdout, encoding="utf-8")
    task.update(len(RUNS))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="ocufilter paper",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("paper.html"), metavar="FILE"
    )
    parser.add_argument("--fresh", action="store_true", help="run the benchmarks first")
    parser.add_argument("--quick", action="store_true", help="with --fresh: few cases")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    if arguments.quick and not arguments.fresh:
        parser.error("--quick: allowed with --fresh only")
    return arguments


def main() -> int:
    """Run the program; its exit code."""
    arguments = _arguments()
    measured = Measured()
    try:
        if arguments.fresh:
            print(announcement(quick=arguments.quick), file=sys.stderr)
            with Progress() as progress:
                run_all(quick=arguments.quick, progress=progress)
            measured = Measured(fresh=FRESH)
        text = page(measured)
        arguments.out.write_text(text, encoding="utf-8")
    except (BenchFailed, ResultMissing, OSError) as error:
        print(f"ocufilter paper: {error}", file=sys.stderr)
        return 1
    sections = all_sections(measured)
    if arguments.json:
        print(json.dumps(_said(arguments.out, sections)))
    else:
        print(f"{arguments.out}: {len(text) / 1e6:.1f} MB.  {summary_line(sections)}")
    return 0


def _said(path: Path, sections) -> dict:
    said: dict = {"page": str(path)}
    for name, there in (("published", False), ("rebuilt", True)):
        judged = without_pictures(sections) if there else sections
        for whose, own in (("own", True), ("earlier", False)):
            found = counts(judged, own=own, there=there)
            numbers = {verdict: found[verdict] for verdict in VERDICTS}
            said.setdefault(name, {})[whose] = numbers
    return said


if __name__ == "__main__":
    sys.exit(main())
