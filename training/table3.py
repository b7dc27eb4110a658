"""The paper's Table 3 at one size: architectures and losses, equal weights and rows.

    python -m training.table3 [--width N] [--rows N] [--tasks NAME ...] [--json FILE]

Trains three architectures on the inputs as they come (the paper's ablation) and the
modified ResNet on physical features, with and without a quadratic form, for each of
the four networks; and the eye estimator with each of its losses.  Every network has
about the same number of weights and sees the same number of rows; all are judged by ray
tracing on the same fresh rows.  Needs the data sets of ``training/runs`` and, for the
eye's loss, a trained discriminator.  What is already trained is kept.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from training.datasets import DataError
from training.evaluate import Judged, format_row, judge, write_table
from training.export import JUDGED_ROWS, fresh_rows
from training.models import ModelSettings
from training.run_file import Run, RunFileError, read_run
from training.tasks import TASKS
from training.train import CHECKPOINT, train

RUNS = Path(__file__).parent / "runs"
FOLDER = Path("out/training/table3")
WIDTH, ROWS_SEEN = 128, 2_000_000
LEARNING_RATE = 0.003

VARIANTS = {
    "ffn": ModelSettings(kind="ffn"),
    "resnet": ModelSettings(kind="resnet"),
    "ours": ModelSettings(kind="ours"),
    "ours, physical": ModelSettings(kind="ours", features="physical"),
    "ours, quadratic": ModelSettings(
        kind="ours", features="physical", baseline="quadratic"
    ),
}
EYE_LOSSES = ("parameters", "discriminator", "tracer")


def variants(task: str) -> list[tuple[str, ModelSettings, str]]:
    """Name, model and loss of every row of a task."""
    if task != "eye":
        return [(name, model, "standard") for name, model in VARIANTS.items()]
    kinds = [
        (name, VARIANTS[name], "discriminator") for name in ("ffn", "resnet", "ours")
    ]
    physical = VARIANTS["ours, physical"]
    return kinds + [(f"ours, {loss} loss", physical, loss) for loss in EYE_LOSSES]


def make_run(task: str, name: str, model: ModelSettings, loss: str, options) -> Run:
    """Return the run of one row, on the data of the task's own run file."""
    base = read_run(RUNS / f"{task}.toml")
    n_training = base.recipe.n_rows * (1.0 - base.training.validation_ratio)
    judge_file = read_run(RUNS / "discriminator.toml").output_folder / CHECKPOINT
    label = name.replace(", ", "-").replace(" ", "-")
    settings = replace(
        base.training,
        loss=loss,
        n_epochs=options.rows / n_training,
        learning_rate=LEARNING_RATE,
        weight_decay=0.01,
        decay_per_epoch=1.0,
        final_ratio=0.5,
        discriminator=str(judge_file) if loss == "discriminator" else "",
    )
    return replace(
        base,
        name=f"{task}: {name}",
        model=replace(model, width=options.width),
        training=settings,
        output_folder=FOLDER / f"{task}-{label}-{options.width}",
        text=repr((task, name, options.width, settings)),
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.table3",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--width", type=int, default=WIDTH)
    parser.add_argument("--rows", type=int, default=ROWS_SEEN, help="seen in training")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--judged-rows", type=int, default=JUDGED_ROWS)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    rows: list[Judged] = []
    try:
        for task in options.tasks:
            samples = fresh_rows(TASKS[task], options.judged_rows)
            for name, model, loss in variants(task):
                run = make_run(task, name, model, loss, options)
                train(run)
                rows.append(judge(run, *samples))
                print(format_row(rows[-1]), flush=True)
    except (DataError, RunFileError) as error:
        print(f"table3: {error}", file=sys.stderr)
        return 2
    if options.json:
        write_table(rows, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
