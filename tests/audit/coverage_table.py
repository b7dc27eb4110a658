"""Print the covered lines of each package, from a folder of `coverage.sh`."""

import os
import sys
from collections import defaultdict
from pathlib import Path

from coverage import Coverage

from tests.source_tree import ROOT

SOURCES = ("estimator", "filter_service", "clients", "ocufilter")


def main(folder: Path) -> None:
    """Print a Markdown table; compiled functions are excluded by coverage.ini."""
    os.environ.setdefault("OCUFILTER_COVERAGE", str(folder))
    settings = str(Path(__file__).with_name("coverage.ini"))
    measured = Coverage(config_file=settings, data_file=str(folder / "combined"))
    measured.load()
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for source in SOURCES:
        for path in sorted((ROOT / source).rglob("*.py")):
            _, lines, _, missing, _ = measured.analysis2(str(path))
            for name in (source, "/".join(path.relative_to(ROOT).parts[:2]), "all"):
                if not name.endswith(".py"):
                    counts[name][0] += len(lines) - len(missing)
                    counts[name][1] += len(lines)
    print("| package | covered | of lines | % |\n|---|---|---|---|")
    for name, (covered, total) in sorted(counts.items()):
        print(f"| {name} | {covered} | {total} | {100 * covered / max(total, 1):.1f} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
