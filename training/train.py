"""Train one network.

    python -m training.train RUN.toml [--folder DIR]
    torchrun --nproc-per-node 2 -m training.train RUN.toml

Writes ``checkpoint.pt`` and ``log.jsonl`` to the folder of the run. When started again,
it resumes exactly from the last checkpoint. `train` contains the training loop.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.distributed as dist
from rich.console import Console
from rich.progress import Progress
from torch.nn.parallel import DistributedDataParallel

from training.batches import Batches, Rows, load_rows
from training.checkpoint import load_checkpoint, make_network, save_checkpoint
from training.command import make_parser, run_command
from training.losses import (
    DiscriminatorLoss,
    TracerLoss,
    parameter_loss,
    physical_loss,
    standard_loss,
)
from training.optimizer import Lookahead, make_optimizer, rate_factor
from training.run_file import Run, RunFileError, read_run
from training.validation import validation_error

if TYPE_CHECKING:
    from training.models import Network

    Loss = Callable[[Network, torch.Tensor, torch.Tensor], torch.Tensor]

CHECKPOINT = "checkpoint.pt"
LOG = "log.jsonl"
CHECKPOINT_SECONDS = 120.0


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser("train", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN.toml")
    parser.add_argument("--folder", type=Path, help="of the data, not the run file's")
    return run_command(parser, _work, arguments)


def _work(options: argparse.Namespace) -> None:
    train(read_run(options.run), data_folder=options.folder)


def _loss(run: Run, device: torch.device) -> "Loss":
    named: dict[str, Callable[[], Loss]] = {
        "standard": lambda: standard_loss,
        "physical": lambda: physical_loss,
        "parameters": lambda: parameter_loss,
        "tracer": lambda: TracerLoss(prior_weight=run.training.prior_weight),
    }
    if run.training.loss in named:
        return named[run.training.loss]()
    if not run.training.discriminator:
        raise RunFileError("training.discriminator: missing; expected a checkpoint")
    discriminator, _ = load_checkpoint(Path(run.training.discriminator))
    return DiscriminatorLoss(
        discriminator.to(device), prior_weight=run.training.prior_weight
    )


def train(run: Run, *, data_folder: Path | None = None) -> dict[str, Any]:
    """Train the network of a run to the end; return the last entry of its log.

    Raises
    ------
    DataError
        The data set is missing or incomplete.
    RunFileError
        The run file is invalid, or the checkpoint does not match it.
    """
    done = _finished_log(run)
    if done:
        return done
    settings, started_s = run.training, time.perf_counter()
    rank, n_ranks, device = _join()
    torch.manual_seed(run.seed)
    rows: Rows = load_rows(run, data_folder or run.data_folder)
    batches = Batches(rows, run, rank=rank, n_ranks=n_ranks, device=device)
    network = make_network(run.task, run.model)
    rows.fit_scaling(network)
    if settings.start_from:
        network.load_state_dict(
            load_checkpoint(Path(settings.start_from))[0].state_dict()
        )
    network.to(device)
    optimizer = make_optimizer(
        network.parameters(),
        learning_rate=settings.learning_rate,
        weight_decay=settings.weight_decay,
    )
    folder = run.output_folder
    folder.mkdir(parents=True, exist_ok=True)
    step, spent_s, smooth, entry = _resumed(run, batches, network, optimizer)
    if rank == 0:
        _cut_log(folder / LOG, step)
    model = _Whole(network, _loss(run, device))
    if n_ranks > 1:  # BatchNorm's running means must agree; other buffers are constant
        has_means = run.model.kind == "resnet"
        model = DistributedDataParallel(model, broadcast_buffers=has_means)
    n_steps, per_epoch = batches.n_steps, batches.steps_per_epoch
    n_mixed = (1.0 - settings.final_ratio) * n_steps if settings.is_mixed else 0
    saved_s, console = time.perf_counter(), Console(stderr=True)
    with Progress(console=console, disable=rank != 0) as bar:
        task = bar.add_task(run.name, total=n_steps, completed=step)
        while step < n_steps:
            x, y = batches.at(step)
            share = rate_factor(
                step / n_steps,
                n_epochs=settings.n_epochs,
                decay_per_epoch=settings.decay_per_epoch,
                final_ratio=settings.final_ratio,
            )
            optimizer.set_rates(
                learning_rate=settings.learning_rate * share,
                weight_decay=settings.weight_decay * share,
            )
            network.train()
            network.is_mixed = device.type == "cuda" and step < n_mixed
            loss = model(x, y)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            step += 1
            value = float(loss.detach())
            smooth = value if smooth is None else 0.98 * smooth + 0.02 * value
            bar.update(task, advance=1, description=f"{run.name} loss {smooth:.5f}")
            is_last = step == n_steps
            if step % per_epoch == 0 or is_last:
                entry = {
                    "step": step,
                    "epoch": step / per_epoch,
                    "rows": step * batches.rows_per_step,
                    "loss": smooth,
                    "learning_rate": settings.learning_rate * share,
                    "seconds": spent_s + time.perf_counter() - started_s,
                    **validation_error(network, run, rows, device),
                }
                if rank == 0:
                    with (folder / LOG).open("a", encoding="utf-8") as log:
                        log.write(json.dumps(entry) + "\n")
                    console.print(_line(entry))
            is_due = time.perf_counter() - saved_s > CHECKPOINT_SECONDS
            if rank == 0 and (is_due or is_last):
                save_checkpoint(
                    folder / CHECKPOINT,
                    network,
                    run,
                    {
                        "optimizer": optimizer.state_dict(),
                        "step": step,
                        "n_steps": n_steps,
                        "rows_per_step": batches.rows_per_step,
                        "smooth_loss": smooth,
                        "seconds": spent_s + time.perf_counter() - started_s,
                        "run": run.text,
                        "log": entry,
                    },
                )
                saved_s = time.perf_counter()
    if n_ranks > 1:
        dist.destroy_process_group()
    return entry


def _finished_log(run: Run) -> dict[str, Any]:
    """Return the last log entry of a finished run, or an empty dict."""
    file = run.output_folder / CHECKPOINT
    if not file.exists():
        return {}
    _, state = load_checkpoint(file)
    is_done = state["step"] == state["n_steps"] and state["run"] == run.text
    return state["log"] if is_done else {}


def _resumed(
    run: Run, batches: Batches, network: "Network", optimizer: Lookahead
) -> tuple[int, float, float | None, dict[str, Any]]:
    """Restore a checkpoint; return step, seconds spent, loss and last entry."""
    file = run.output_folder / CHECKPOINT
    if not file.exists():
        return 0, 0.0, None, {}
    saved, state = load_checkpoint(file)
    if state["run"] != run.text:
        raise RunFileError(
            f"{file} belongs to another run file; remove it to restart the training"
        )
    if state["rows_per_step"] != batches.rows_per_step:
        raise RunFileError(
            f"{file} has {state['rows_per_step']} rows per step of all processes, got "
            f"{batches.rows_per_step}; start as many processes as before, or remove it "
            "to restart the training"
        )
    network.load_state_dict(saved.state_dict())
    optimizer.load_state_dict(state["optimizer"])
    return state["step"], state["seconds"], state["smooth_loss"], state["log"]


def _cut_log(file: Path, step: int) -> None:
    """Drop log entries after the step from which training resumes."""
    if not file.exists():
        return
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    try:
        retained = [line for line in lines if json.loads(line)["step"] <= step]
    except (ValueError, TypeError, LookupError, RecursionError):
        raise RunFileError(
            f"{file} has a line without a step; remove it to restart the training"
        ) from None
    file.write_text("".join(retained), encoding="utf-8")


class _Whole(torch.nn.Module):
    """Network and loss as one module, so that processes share gradients."""

    def __init__(self, network: "Network", loss_of: "Loss") -> None:
        super().__init__()
        self.network, self.loss_of = network, loss_of

    def forward(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return self.loss_of(self.network, x, y)


def _join() -> tuple[int, int, torch.device]:
    """Return rank, number of processes and device of this process.

    The device is the CPU if the machine has fewer GPUs than processes.
    """
    names = {"RANK": "0", "WORLD_SIZE": "1", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "1"}
    rank, n_ranks, local_rank, n_local = (
        int(os.environ.get(name, default)) for name, default in names.items()
    )
    device, backend = torch.device("cpu"), "gloo"
    if torch.cuda.device_count() >= n_local:
        device, backend = torch.device("cuda", local_rank), "nccl"
        torch.cuda.set_device(device)
    if n_ranks > 1 and not dist.is_initialized():
        dist.init_process_group(backend)
    return rank, n_ranks, device


def _line(entry: dict[str, Any]) -> str:
    errors = ", ".join(
        f"{name} {value:.5f}"
        for name, value in entry.items()
        if isinstance(value, float) and name.startswith("error")
    )
    return (
        f"epoch {entry['epoch']:.1f}  {entry['seconds']:.0f} s  "
        f"loss {entry['loss']:.5f}  {errors}"
    )


if __name__ == "__main__":
    sys.exit(main())
