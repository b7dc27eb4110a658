"""Learning curves: error by number of training rows and by number of weights.

    python -m training.learning_curve [--tasks NAME ...] [--json FILE] [--plot FILE]

Trains the modified ResNet on physical features with a quadratic form, with the data of
`table3`: for several numbers of rows at one width, and for several widths at one number
of rows. All are evaluated by ray tracing on fresh rows of the paper's Table 2. Finished
networks are not trained again.
"""

import argparse
import sys
from pathlib import Path

from training.command import make_parser, run_command
from training.evaluate import PUBLISHED, Evaluation, make_table
from training.export import EVALUATION_ROWS
from training.table3 import ROWS_SEEN, VARIANTS, WIDTH, make_run, trained
from training.tasks import TASKS

ROWS = (125_000, 250_000, 500_000, 1_000_000, 2_000_000, 4_000_000)
WIDTHS = (32, 64, 128, 256)
VARIANT = "ours, quadratic"
LOSSES = {"discriminator": "physical", "aberration": "physical", "focus": "standard"}
"""As in the run files. In standard units, the smallest terms have the same weight as
the largest."""


def sizes(
    rows: tuple[int, ...] = ROWS, widths: tuple[int, ...] = WIDTHS
) -> list[tuple[int, int]]:
    """Return width and rows seen of every point, each once."""
    points = [(WIDTH, n) for n in rows] + [(width, ROWS_SEEN) for width in widths]
    return list(dict.fromkeys(points))


def plot(rows: list[Evaluation], file: Path) -> None:
    """Plot both curves of every task; dashed lines: the paper's networks."""
    from matplotlib import pyplot as plt
    from matplotlib.ticker import LogLocator

    figure, (by_rows, by_weights) = plt.subplots(
        1, 2, figsize=(10, 4.5), sharey=True, layout="constrained"
    )
    for number, task in enumerate(dict.fromkeys(row.task for row in rows)):
        mine, color = [row for row in rows if row.task == task], f"C{number}"
        for axes, name, shown in (
            (by_rows, "rows_seen", [r for r in mine if r.width == WIDTH]),
            (by_weights, "n_parameters", _of_one_budget(mine)),
        ):
            shown.sort(key=lambda row: getattr(row, name))
            x = [getattr(row, name) / 1e6 for row in shown]
            y = [row.error["mean_abs"] for row in shown]
            axes.loglog(x, y, "o-", color=color, label=f"{task}, {TASKS[task].unit}")
            axes.axhline(PUBLISHED[task, "ours", ""], color=color, linestyle="--")
    by_rows.plot([], [], "k--", label="the paper's, 72 million weights")
    label = "mean absolute error against ray tracing"
    by_rows.set(xlabel="rows seen, millions", ylabel=label)
    by_weights.set(xlabel="weights, millions")
    for axes in (by_rows, by_weights):
        axes.grid(which="both", alpha=0.3)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
    handles, _ = by_rows.get_legend_handles_labels()
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    figure.savefig(file, dpi=110)
    plt.close(figure)


def _of_one_budget(rows: list[Evaluation]) -> list[Evaluation]:
    return [row for row in rows if abs(row.rows_seen / ROWS_SEEN - 1.0) < 0.05]


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser("learning_curve", __doc__)
    parser.add_argument("--tasks", nargs="+", choices=LOSSES, default=list(LOSSES))
    parser.add_argument("--rows", type=int, nargs="+", default=ROWS)
    parser.add_argument("--widths", type=int, nargs="+", default=WIDTHS)
    parser.add_argument("--judged-rows", type=int, default=EVALUATION_ROWS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    return run_command(parser, _work, arguments)


def _work(options: argparse.Namespace) -> None:
    variant = (VARIANT, VARIANTS[VARIANT])
    runs = (
        make_run(task, *variant, LOSSES[task], 0.0, width=width, rows=rows)
        for task in options.tasks
        for width, rows in sizes(tuple(options.rows), tuple(options.widths))
    )
    evaluations = make_table(map(trained, runs), options.judged_rows, options.json)
    if options.plot:
        plot(evaluations, options.plot)


if __name__ == "__main__":
    sys.exit(main())
