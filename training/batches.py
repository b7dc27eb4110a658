"""Inputs and targets of a task from the rows of a data set, and training batches."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from estimator.eye.parameters import sampled_ranges
from training.datasets import (
    DataError,
    Recipe,
    Shard,
    draw,
    label,
    load,
    read_manifest,
    recipe_of,
    split,
)
from training.models import Network
from training.run_file import Run
from training.tasks import N_EYE, TASKS

SCALING_ROWS = 200_000
"""Rows from which means and standard deviations are computed."""

FRESH_SEED = 7919
"""Added to the seed of the run, so that fresh rows differ from those of the shards."""

FRESH_STEPS = 8
"""Steps whose rows are traced in one call."""


@dataclass(frozen=True)
class Rows:
    """Inputs (n, n_inputs) and targets (n, n_targets) of a task, and their split.

    The eye estimator's targets are the eye (45) and its coefficients (27).
    """

    task: str
    x: Tensor
    y: Tensor
    training_index: NDArray[np.int64]
    validation_index: NDArray[np.int64]

    def fit_scaling(self, network: Network) -> None:
        """Fit scales, and a baseline, to training rows.

        The eye estimator's outputs are scaled to the ranges of Table 2, or to those of
        its features.
        """
        step = -(-len(self.training_index) // SCALING_ROWS)
        chosen = torch.as_tensor(self.training_index[::step])
        x, y = self.x[chosen], self.y[chosen]
        if self.task == "eye":
            network.fit_scaling(x, y[:, :N_EYE])
            ranges = getattr(network.features, "output_ranges", sampled_ranges)()
            network.set_output_range(*torch.from_numpy(ranges.T))
        else:
            network.fit_scaling(x, y)

    @property
    def validation(self) -> tuple[Tensor, Tensor]:
        """Return inputs and targets that training does not see."""
        chosen = torch.as_tensor(self.validation_index)
        return self.x[chosen], self.y[chosen]


def task_rows(task: str, shard: Shard) -> tuple[Tensor, Tensor]:
    """Return inputs and targets of a task, from labeled rows of its domain."""
    inputs, targets = torch.from_numpy(shard.inputs), torch.from_numpy(shard.targets)
    if task == "focus":
        # Rows have a lens and its traced focus; the network learns the inverse.
        known = torch.cat([inputs[:, : N_EYE + 1], targets[:, :1]], dim=1)
        return known, targets[:, 1:]
    if task != "eye":
        return inputs, targets
    measured = torch.cat([targets[:, 2:], inputs[:, N_EYE:]], dim=1)
    return measured, torch.cat([inputs[:, :N_EYE], targets], dim=1)


def load_rows(run: Run, folder: Path) -> Rows:
    """Read the data set of a run and split it.

    Raises
    ------
    DataError
        The data set is missing or incomplete, or does not match the run file.
    """
    found = recipe_of(read_manifest(folder))
    if found != run.recipe:
        raise DataError(
            f"{folder} contains {found}, expected {run.recipe}; choose another folder, "
            "or remove this one and run python -m training.generate"
        )
    shard, share = load(folder), run.training.validation_ratio
    parts = split(shard.inputs, share=share, seed=run.seed)
    return Rows(run.task, *task_rows(run.task, shard), *parts)


class Batches:
    """Training batches, which depend only on the seed of the run and the step.

    Parameters
    ----------
    rows : Rows
    run : Run
    rank, n_ranks : int
        This process uses every n-th batch.
    device : torch.device

    Raises
    ------
    DataError
        There are fewer rows than a step requires.
    """

    def __init__(
        self, rows: Rows, run: Run, *, rank: int, n_ranks: int, device: torch.device
    ) -> None:
        settings = run.training
        self._rows, self._run, self._device = rows, run, device
        self._rank, self._n_ranks = rank, n_ranks
        self._size = settings.batch_size
        self.rows_per_step = self._size * n_ranks
        n_rows = len(rows.training_index)
        if n_ranks > 1 and n_rows < self.rows_per_step:
            raise DataError(
                f"{n_rows} training rows: a step of {n_ranks} processes requires "
                f"{self.rows_per_step}"
            )
        self.steps_per_epoch = max(1, n_rows // self.rows_per_step)
        self.n_steps = max(1, round(settings.n_epochs * self.steps_per_epoch))
        self._order = (-1, rows.training_index)
        self._pool = ThreadPoolExecutor(1) if settings.is_fresh else None
        self._pending: dict[int, Future[tuple[Tensor, Tensor]]] = {}

    def at(self, step: int) -> tuple[Tensor, Tensor]:
        """Return inputs and targets of a step, on the device."""
        if self._pool is None:
            x, y = self._stored(step)
        else:
            x, y = self._fresh(step)
        return x.to(self._device), y.to(self._device)

    def _stored(self, step: int) -> tuple[Tensor, Tensor]:
        epoch, place = divmod(step, self.steps_per_epoch)
        if self._order[0] != epoch:
            rng = np.random.default_rng([self._run.seed, epoch])
            self._order = (epoch, rng.permutation(self._rows.training_index))
        first = (place * self._n_ranks + self._rank) * self._size
        chosen = torch.from_numpy(self._order[1][first : first + self._size])
        return self._rows.x[chosen], self._rows.y[chosen]

    def _fresh(self, step: int) -> tuple[Tensor, Tensor]:
        """Return the rows of a step; a thread traces the next block of steps."""
        assert self._pool is not None
        block, place = divmod(step, FRESH_STEPS)
        for number in (block, block + 1):
            if number not in self._pending:
                self._pending[number] = self._pool.submit(self._trace, number)
        self._pending = {n: self._pending[n] for n in (block, block + 1)}
        x, y = self._pending[block].result()
        share = len(x) // FRESH_STEPS
        part = slice(place * share, (place + 1) * share)
        return x[part], y[part]

    def _trace(self, block: int) -> tuple[Tensor, Tensor]:
        domain = TASKS[self._run.task].domain
        recipe = self._fresh_recipe(domain.n_repeats)
        inputs = draw(recipe, block * self._n_ranks + self._rank)
        return task_rows(self._run.task, label(domain, inputs))

    def _fresh_recipe(self, n_repeats: int) -> Recipe:
        per_shard = -(-self._size * FRESH_STEPS // n_repeats) * n_repeats
        n_blocks = -(-self.n_steps // FRESH_STEPS) + 1  # one is always started ahead
        n_rows = per_shard * self._n_ranks * n_blocks
        return replace(
            self._run.recipe,
            n_rows=n_rows,
            rows_per_shard=per_shard,
            seed=self._run.seed + FRESH_SEED,
            sampling="random",
        )
