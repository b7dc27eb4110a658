"""The paper's Table 11: statistics of our data and the published ones, and differences.

    python -m training.table11 [--rows N] [--json OUT.json]

Draws N eyes of Table 2 and labels them several times: as in our data sets, and with the
known properties of the published data sets added one by one (`published_labels`). These
properties explain a difference if the last row of a group agrees with the paper.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from training.command import make_parser, run_command
from training.datasets import Recipe, draw
from training.published_labels import (
    FIELD_STEPS,
    ON_AXIS_STEPS,
    label_field_as_published,
    label_on_axis_as_published,
    lens_search_as_published,
    narrow_posterior_conic,
)
from training.statistics import PUBLISHED, ROWS, group_statistics
from training.tasks import DOMAINS
from training.versions import commit_id

ROWS_DRAWN = 6_000
SEED = 132
PUBLISHED_FOCUS_DPT = (0.125, 8.125)
"""Published range of focus distances; ours is larger on both sides."""


@dataclass(frozen=True)
class Line:
    """Statistics of one group of targets under one chain."""

    domain: str
    chain: str
    group: str
    statistics: dict[str, float]


def _lines(name: str, chain: str, targets: NDArray[Any]) -> list[Line]:
    good = targets[np.all(np.isfinite(targets), axis=1)]
    found = group_statistics(DOMAINS[name], good)
    return [_line(name, chain, *item) for item in found.items()]


def _line(name: str, chain: str, group: str, values: tuple[float, ...]) -> Line:
    return Line(name, chain, group, dict(zip(ROWS, values, strict=True)))


def _published(name: str) -> list[Line]:
    return [_line(name, "paper", *item) for item in PUBLISHED[name].items()]


def aberration_lines(name: str, n_rows: int) -> list[Line]:
    """Return our labels, the published chain step by step, and the paper's figures."""
    inputs = draw(Recipe(name, n_rows, n_rows, SEED), 0)
    lines = _lines(name, "ours", DOMAINS[name].label(inputs))
    steps, label = (
        (ON_AXIS_STEPS, label_on_axis_as_published)
        if name == "on_axis"
        else (FIELD_STEPS, label_field_as_published)
    )
    narrow = narrow_posterior_conic(inputs)
    for count in range(1, len(steps) + 1):
        targets = label(narrow, steps[:count])
        lines += _lines(name, f"+ {steps[count - 1]}", targets)
    return lines + _published(name)


def focus_lines(n_rows: int) -> list[Line]:
    """Return our lens changes, also with the bound of the published search."""
    repeats = DOMAINS["focus"].n_repeats
    n_rows = -(-n_rows // repeats) * repeats
    inputs = draw(Recipe("focus", n_rows, n_rows, SEED), 0)
    targets = DOMAINS["focus"].label(inputs)
    low_dpt, high_dpt = PUBLISHED_FOCUS_DPT
    theirs = (inputs[:, -1] >= low_dpt) & (inputs[:, -1] <= high_dpt)
    bound = lens_search_as_published(inputs[theirs], targets[theirs])
    return [
        *_lines("focus", "ours", targets),
        *_lines("focus", f"{low_dpt:g} to {high_dpt:g} dpt", targets[theirs]),
        *_lines("focus", "+ lens diameter within 9 %", bound),
        *_published("focus"),
    ]


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser("table11", __doc__)
    parser.add_argument("--rows", type=int, default=ROWS_DRAWN)
    parser.add_argument("--json", type=Path)
    return run_command(parser, _work, arguments)


def _work(options: argparse.Namespace) -> None:
    lines = []
    for name in ("on_axis", "field"):
        lines += aberration_lines(name, options.rows)
    lines += focus_lines(options.rows)
    print(f"{'':10s}{'':38s}" + "".join(f"{row:>10s}" for row in ROWS))
    for line in sorted(lines, key=lambda line: (line.domain, line.group)):
        label = f"{line.group.removesuffix('_mm'):28s}{line.chain:28s}"
        print(label + "".join(f"{value:10.4f}" for value in line.statistics.values()))
    if options.json:
        rows = [asdict(line) for line in lines]
        table = {"commit": commit_id(), "n_rows": options.rows, "rows": rows}
        options.json.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
