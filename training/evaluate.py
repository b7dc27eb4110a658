"""Evaluate trained networks by ray tracing, in one table.

    python -m training.evaluate RUN.toml [RUN.toml ...] [--rows N] [--json OUT.json]

The checkpoints of all runs are evaluated on the same newly traced rows; estimated eyes
are traced for it. The table is the paper's Table 3, by radial order, with the paper's
values for 72 M and 221 M parameters.
"""

import argparse
import json
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from training.checkpoint import load_finished
from training.command import make_parser, run_command
from training.export import EVALUATION_ROWS, fresh_rows, tracing_errors
from training.run_file import Run, read_run
from training.tasks import TASKS
from training.train import CHECKPOINT
from training.validation import predict
from training.versions import commit_id

if TYPE_CHECKING:
    from numpy.typing import NDArray

PUBLISHED = {
    # Table 3: validation MAE, um or mm
    ("eye", "ffn", "discriminator"): 0.123248,
    ("eye", "resnet", "discriminator"): 0.021555,
    ("eye", "ours", "discriminator"): 0.009016,
    ("eye", "ours", "parameters"): 0.075660,
    ("discriminator", "ffn", ""): 0.070620,
    ("discriminator", "resnet", ""): 0.013066,
    ("discriminator", "ours", ""): 0.003137,
    ("focus", "ffn", ""): 0.003099,
    ("focus", "resnet", ""): 0.001538,
    ("focus", "ours", ""): 0.000429,
    ("aberration", "ffn", ""): 0.087222,
    ("aberration", "resnet", ""): 0.037234,
    ("aberration", "ours", ""): 0.015308,
}
"""Csoba & Kunkli 2023. Their eyes were evaluated by a discriminator instead of tracing,
over 27 terms including tilt; their circles are about 13 % larger."""


@dataclass(frozen=True)
class Evaluation:
    """One row of the table: a network, its cost and its error."""

    run: str
    task: str
    kind: str
    features: str
    loss: str
    width: int
    n_parameters: int
    rows_seen: int
    time_s: float
    error: dict[str, Any]
    published_mae: str


def evaluate_run(run: Run, x: "NDArray[Any]", y: "NDArray[Any]") -> Evaluation:
    """Evaluate the checkpoint of a run on rows (n, n_inputs), (n, n_targets).

    Raises
    ------
    DataError
        There is no checkpoint, or its training is not finished.
    """
    network, state = load_finished(run.output_folder / CHECKPOINT)
    found = predict(network, torch.from_numpy(x), torch.device("cpu"))
    loss = run.training.loss if run.task == "eye" else ""
    return Evaluation(
        run=run.name,
        task=run.task,
        kind=run.model.kind,
        features=run.model.features,
        loss=run.training.loss,
        width=run.model.width,
        n_parameters=network.n_parameters,
        rows_seen=state["log"]["rows"],
        time_s=round(state["seconds"]),
        error=tracing_errors(TASKS[run.task], found, x, y),
        published_mae=_published(run.task, run.model.kind, loss),
    )


def _published(task: str, kind: str, loss: str) -> str:
    value = PUBLISHED.get((task, kind, loss))
    return "" if value is None else f"{value:.6f} {TASKS[task].unit}"


def format_row(row: Evaluation) -> str:
    """Format one row as text."""
    orders = "  ".join(
        f"n{n} {value:.4f}" for n, value in row.error["by_radial_order"].items()
    )
    paper = f"  (paper {row.published_mae})" if row.published_mae else ""
    return (
        f"{row.run:28s} {row.kind:7s} {row.features:9s} {row.loss:14s}"
        f"{row.n_parameters / 1e6:7.2f} M {row.rows_seen / 1e6:7.1f} M rows "
        f"{row.time_s:6.0f} s  {row.error['mean_abs']:.5f} {row.error['unit']}"
        f"{paper}  {orders}"
    )


def make_table(runs: Iterable[Run], n_rows: int, file: Path | None) -> list[Evaluation]:
    """Evaluate runs on the same fresh rows per task, and print each row.

    The table is also written to ``file`` as JSON, with the commit.

    Raises
    ------
    DataError
        A run's training is not finished.
    """
    rows, samples = [], {}
    for run in runs:
        if run.task not in samples:
            samples[run.task] = fresh_rows(TASKS[run.task], n_rows)
        rows.append(evaluate_run(run, *samples[run.task]))
        print(format_row(rows[-1]), flush=True)
    if file:
        table = {"commit": commit_id(), "rows": [asdict(row) for row in rows]}
        file.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser("evaluate", __doc__)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN.toml")
    parser.add_argument("--rows", type=int, default=EVALUATION_ROWS)
    parser.add_argument("--json", type=Path, help="write the table here, too")
    return run_command(parser, _work, arguments)


def _work(options: argparse.Namespace) -> None:
    make_table(map(read_run, options.runs), options.rows, options.json)


if __name__ == "__main__":
    sys.exit(main())
