"""The paper's Table 3 at one size: architectures and losses compared.

    python -m training.table3 [--width N] [--rows N] [--tasks NAME ...] [--json FILE]

Trains three architectures on raw inputs (the paper's ablation) and the modified ResNet
on physical features, with and without a quadratic form, for each of the four networks;
and the eye estimator with each of its losses. Every network has about the same number
of weights and is trained on the same number of rows, from the ranges of the paper's
Table 2. All are evaluated by ray tracing on the same fresh rows. Missing data sets are
generated; finished networks are not trained again. The loss of the eye estimator
requires the trained discriminator of ``training/runs``.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from training.command import make_parser, run_command
from training.datasets import MANIFEST, Recipe
from training.evaluate import make_table
from training.export import EVALUATION_ROWS
from training.generate import generate
from training.models import ModelSettings
from training.run_file import (
    Run,
    TrainingSettings,
    default_data_folder,
    read_run,
)
from training.tasks import TASKS
from training.train import CHECKPOINT, train

RUNS = Path(__file__).parent / "runs"
FOLDER = Path("out/training/table3")
WIDTH, ROWS_SEEN = 128, 1_000_000
DATA_ROWS = {"on_axis": 2_000_000, "field": 1_000_000, "lens": 1_000_000}
VALIDATION_RATIO = 0.02
BATCH_SIZE, EYE_BATCH_SIZE = 1024, 512
LEARNING_RATE = 0.003
PRIOR_WEIGHT = 0.01

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


def variants(task: str) -> list[tuple[str, ModelSettings, str, float]]:
    """Return name, model, loss and weight of the prior of every row of a task."""
    if task != "eye":
        return [(name, model, "standard", 0.0) for name, model in VARIANTS.items()]
    kinds = [
        (name, VARIANTS[name], "discriminator", 0.0)
        for name in ("ffn", "resnet", "ours")
    ]
    physical = VARIANTS["ours, physical"]
    losses = [(f"ours, {loss} loss", physical, loss, 0.0) for loss in EYE_LOSSES]
    with_prior = ("ours, with prior", physical, "discriminator", PRIOR_WEIGHT)
    return [*kinds, *losses, with_prior]


def make_run(
    task: str,
    name: str,
    model: ModelSettings,
    loss: str,
    prior_weight: float,
    *,
    width: int,
    rows: int,
) -> Run:
    """Return the run of one table row, on data of the paper's Table 2."""
    domain = TASKS[task].domain.name
    recipe = Recipe(domain, DATA_ROWS[domain])
    discriminator_file = (
        read_run(RUNS / "discriminator.toml").output_folder / CHECKPOINT
    )
    settings = TrainingSettings(
        loss=loss,
        batch_size=EYE_BATCH_SIZE if task == "eye" else BATCH_SIZE,
        n_epochs=rows / (recipe.n_rows * (1.0 - VALIDATION_RATIO)),
        learning_rate=LEARNING_RATE,
        weight_decay=0.01,
        decay_per_epoch=1.0,
        final_ratio=0.5,
        validation_ratio=VALIDATION_RATIO,
        discriminator=str(discriminator_file) if loss == "discriminator" else "",
        prior_weight=prior_weight,
    )
    label = name.replace(", ", "-").replace(" ", "-")
    return Run(
        name=f"{task}: {name}",
        task=task,
        recipe=recipe,
        data_folder=default_data_folder(recipe),
        output_folder=FOLDER / f"{task}-{label}-{loss}-{width}-{rows // 1000}k",
        model=replace(model, width=width),
        training=settings,
        text=repr((task, name, width, settings)),
    )


def trained(run: Run) -> Run:
    """Train a run unless it is finished, and return it; generate missing data.

    Raises
    ------
    DataError
        The folder contains data of another recipe.
    RunFileError
        The checkpoint there belongs to another run.
    """
    if not (run.data_folder / MANIFEST).exists():
        generate(run.recipe, run.data_folder)
    train(run)
    return run


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser("table3", __doc__)
    parser.add_argument("--width", type=int, default=WIDTH)
    parser.add_argument("--rows", type=int, default=ROWS_SEEN, help="seen in training")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--judged-rows", type=int, default=EVALUATION_ROWS)
    parser.add_argument("--json", type=Path)
    return run_command(parser, _work, arguments)


def _work(options: argparse.Namespace) -> None:
    runs = (
        make_run(task, *variant, width=options.width, rows=options.rows)
        for task in options.tasks
        for variant in variants(task)
    )
    make_table(map(trained, runs), options.judged_rows, options.json)


if __name__ == "__main__":
    sys.exit(main())
