"""Errors of a network on validation rows, in physical units."""

import numpy as np
import torch
from numpy.typing import NDArray

from training.batches import Rows
from training.focus_features import is_within_reach
from training.models import Network
from training.run_file import Run
from training.statistics import radial_order_columns
from training.tasks import COMPARED_NAMES, TASKS, ZERNIKE_NAMES, label_on_axis

VALIDATION_ROWS = 50_000
TRACED_ROWS = 4_000
"""Limit for the eye estimator, whose outputs are traced, at 0.25 ms per row."""

CHUNK = 8192


@torch.no_grad()
def predict(
    network: Network, x: torch.Tensor, device: torch.device
) -> NDArray[np.float64]:
    """Return outputs (n, n_outputs) in physical units."""
    network.eval()
    parts = [network(part.to(device)).cpu() for part in x.split(CHUNK)]
    return torch.cat(parts).double().numpy()


def misfit_of_eyes(
    eyes: NDArray[np.float64], measured: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return traced minus measured coefficients (n, 25), um; nan for failed rows.

    ``eyes`` (n, 45); ``measured`` (n, 27) is 25 coefficients, pupil and wavelength.
    """
    inputs = np.concatenate([eyes, measured[:, 25:]], axis=1)
    return label_on_axis(inputs)[:, 2:] - measured[:, :25]


def errors(
    task: str, network: Network, x: torch.Tensor, y: torch.Tensor, device: torch.device
) -> NDArray[np.float64]:
    """Return errors (n, n_columns): of outputs or, for eyes, of traced coefficients."""
    found = predict(network, x, device)
    if task == "eye":
        return misfit_of_eyes(found, x.double().numpy())
    return found - y.double().numpy()


def error_columns(task: str) -> tuple[str, ...]:
    """Return the names of the columns of `errors`."""
    return COMPARED_NAMES if task == "eye" else TASKS[task].outputs


def summary(task: str, error: NDArray[np.float64]) -> dict[str, float]:
    """Return mean absolute errors: total, by order, of the rim; and failed rows."""
    names = error_columns(task)
    good = np.all(np.isfinite(error), axis=1)
    size = np.abs(error[good])
    n_main = sum(name in ZERNIKE_NAMES for name in names) or len(names)
    found = {"error": float(size[:, :n_main].mean())}
    for n, columns in radial_order_columns(names).items():
        found[f"error_n{n}"] = float(size[:, columns].mean())
    if n_main < len(names):
        found["error_rim_mm"] = float(size[:, n_main:].mean())
    found["failed_ratio"] = float(1.0 - good.mean())
    return found


def validation_error(
    network: Network, run: Run, rows: Rows, device: torch.device
) -> dict[str, float]:
    """Return the `summary` on the validation rows of a run."""
    limit = TRACED_ROWS if run.task == "eye" else VALIDATION_ROWS
    x, y = rows.validation
    if run.task == "focus":
        is_compared = is_within_reach(x, y)
        x, y = x[is_compared], y[is_compared]
    x, y = x[:limit], y[:limit]
    return summary(run.task, errors(run.task, network, x, y, device))
