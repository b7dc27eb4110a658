"""Checkpoints: a network with its settings in one file."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from training.datasets import DataError
from training.models import ModelSettings, Network
from training.run_file import Run
from training.tasks import TASKS


def make_network(task: str, settings: ModelSettings) -> Network:
    """Return an untrained network for a task."""
    wanted = TASKS[task]
    return Network(
        task,
        n_inputs=len(wanted.inputs),
        n_outputs=len(wanted.outputs),
        settings=settings,
        is_bounded=task == "eye",
    )


def save_checkpoint(
    file: Path, network: Network, run: Run, state: dict[str, Any]
) -> None:
    """Write a network and the state needed to resume, atomically."""
    partial = file.with_suffix(".partial")
    torch.save(
        {
            "task": run.task,
            "model": asdict(run.model),
            "weights": network.state_dict(),
            **state,
        },
        partial,
    )
    partial.replace(file)


def load_finished(file: Path) -> tuple[Network, dict[str, Any]]:
    """Load the checkpoint of a finished training; see `load_checkpoint`.

    Raises
    ------
    DataError
        There is no checkpoint, or its training is not finished.
    """
    network, state = load_checkpoint(file)
    if state["step"] != state["n_steps"]:
        raise DataError(
            f"checkpoint {file}: at step {state['step']} of {state['n_steps']}; resume "
            "with python -m training.train"
        )
    return network, state


def load_checkpoint(file: Path) -> tuple[Network, dict[str, Any]]:
    """Load a network and the state of its training, on the CPU.

    Raises
    ------
    DataError
        There is no checkpoint.
    """
    if not file.exists():
        raise DataError(f"checkpoint {file}: does not exist")
    state = torch.load(file, map_location="cpu", weights_only=True)
    network = make_network(state["task"], ModelSettings(**state["model"]))
    network.load_state_dict(state["weights"])
    return network, state
