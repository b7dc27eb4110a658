"""The paper's tables and figures beside ours, as one page.

    ocufilter paper [-o paper.html] [--fresh [--quick]] [--json]

Without options from the committed results, in seconds.  With --fresh the benchmarks run
first and the page says so; --quick takes few cases of each, at small sizes.
"""

import argparse
import json
import sys
from pathlib import Path

from filter_service.progress import Progress
from tests.benchmarks.harness import OUT
from tests.benchmarks.paper_page.fresh import (
    BenchFailed,
    announcement,
    run_all,
)
from tests.benchmarks.paper_page.measured import Measured, ResultMissing
from tests.benchmarks.paper_page.page import (
    all_sections,
    page,
    summary_line,
    without_pictures,
)
from tests.benchmarks.paper_page.rows import VERDICTS, counts, counts_there

FRESH = OUT / "paper"


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
                run_all(FRESH, quick=arguments.quick, progress=progress)
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
    tables = without_pictures(sections)

    def numbers(found) -> dict[str, int]:
        return {verdict: found[verdict] for verdict in VERDICTS}

    return {
        "page": str(path),
        "published": {
            "own": numbers(counts(sections, own=True)),
            "earlier": numbers(counts(sections, own=False)),
        },
        "rebuilt": {
            "own": numbers(counts_there(tables, own=True)),
            "earlier": numbers(counts_there(tables, own=False)),
        },
    }


if __name__ == "__main__":
    sys.exit(main())
