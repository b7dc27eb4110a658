"""Export a trained network as ONNX, with a card that states its accuracy.

    python -m training.export RUN.toml [--out DIR] [--half]

Reads the checkpoint of the run. Inputs and outputs are in physical units; scaling and
optics are part of the graph. ``--half`` stores weights in 16 bits; arithmetic is in 32.
The card is a JSON file with settings, ranges, data, parity with the checkpoint on 1,000
samples, and the error of the exported network on newly traced samples.
"""

import argparse
import copy
import json
import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from estimator.networks.inference import WEIGHTS_FOLDER
from training.batches import task_rows
from training.checkpoint import load_finished
from training.command import make_parser, run_command
from training.datasets import (
    DataError,
    Recipe,
    Shard,
    draw,
    input_ranges,
    label,
    read_manifest,
)
from training.focus_features import is_within_reach
from training.models import Network
from training.run_file import Run, RunFileError, read_run
from training.tasks import TASKS, Task
from training.train import CHECKPOINT
from training.validation import error_columns, misfit_of_eyes, summary
from training.versions import commit_id

CARD_FORMAT = 1
PARITY_ROWS = 1_000
EVALUATION_ROWS = 20_000
EVALUATION_SEED = 20_001
"""Seed of fresh rows, which no data set uses."""

SMALLEST_HALVED = 256
"""Smaller tensors are stored in 32 bits."""

LARGEST_PARITY_RATIO = 0.25
"""Largest mean difference from the trained network, over its error."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser("export", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN.toml")
    parser.add_argument("--out", type=Path, default=WEIGHTS_FOLDER)
    parser.add_argument("--half", action="store_true", help="weights in 16 bits")
    parser.add_argument("--rows", type=int, default=EVALUATION_ROWS, help="traced anew")
    return run_command(parser, _work, arguments)


def _work(options: argparse.Namespace) -> None:
    run = read_run(options.run)
    card = export(run, options.out, is_half=options.half, n_rows=options.rows)
    print(json.dumps({k: card[k] for k in ("network", "bytes", "parity", "error")}))


def export(
    run: Run, folder: Path, *, is_half: bool, n_rows: int = EVALUATION_ROWS
) -> dict[str, Any]:
    """Write ``<task>.onnx`` and its card; return the card.

    Raises
    ------
    DataError
        There is no checkpoint, its training is not finished, or the exported network
        differs from it by more than `LARGEST_PARITY_RATIO`.
    RunFileError
        The checkpoint belongs to another run file.
    """
    network, state = load_finished(run.output_folder / CHECKPOINT)
    if state["run"] != run.text:
        raise RunFileError(
            f"{run.output_folder / CHECKPOINT} was trained with another run file; a "
            "card requires the one of the training"
        )
    task = TASKS[run.task]
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{task.name}.onnx"
    written = to_onnx(network.eval(), n_inputs=len(task.inputs), half=is_half)
    session = onnxruntime.InferenceSession(written, providers=["CPUExecutionProvider"])
    x, y = fresh_rows(task, n_rows)
    errors = {"table_2": tracing_errors(task, evaluate(session, x), x, y)}
    if run.recipe.population_ratio:
        people, wanted = fresh_rows(task, n_rows, population_ratio=1.0)
        found = evaluate(session, people)
        errors["population"] = tracing_errors(task, found, people, wanted)
        x = np.concatenate([x, people])
    card = {
        "network": task.name,
        "format": CARD_FORMAT,
        "inputs": column_ranges(run, x),
        "outputs": list(task.outputs),
        "architecture": asdict(run.model),
        "settings": asdict(run.training) | {"seed": run.seed},
        "data": _data(run),
        "trained": {
            "steps": state["step"],
            "seconds": round(state["seconds"]),
            "validation": state["log"],
        },
        "commit": commit_id(),
        "n_parameters": network.n_parameters,
        "precision": "float16" if is_half else "float32",
        "bytes": len(written),
        "parity": _parity(task, network, session, x[:: max(1, len(x) // PARITY_ROWS)]),
        # Users' eyes are like those of the population.
        "error": errors.get("population", errors["table_2"]),
        "error_by_rows": errors,
    }
    _check_parity(card)
    _write_both(file, written, card)
    return card


def _check_parity(card: dict[str, Any]) -> None:
    unit, error = card["error"]["unit"], card["error"]["mean_abs"]
    gap = card["parity"]["mean_abs"].get(unit, 0.0)  # absent for the eye estimator
    if gap > LARGEST_PARITY_RATIO * error:
        raise DataError(
            f"the exported network differs from the trained one by {gap:.2g} {unit} on "
            f"average; allowed is {LARGEST_PARITY_RATIO:g} of its error of {error:.2g} "
            f"{unit}; nothing was written"
        )


def _write_both(file: Path, written: bytes, card: dict[str, Any]) -> None:
    """Write network and card, and replace the previous ones when both are complete."""
    text = json.dumps(card, indent=1) + "\n"
    contents = {file: written, file.with_suffix(".json"): text.encode()}
    partials = {
        target: target.with_name(target.name + ".partial") for target in contents
    }
    for target, content in contents.items():
        partials[target].write_bytes(content)
    for target, partial in partials.items():
        partial.replace(target)


def fresh_rows(
    task: Task, n_rows: int, *, population_ratio: float = 0.0
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return float32 inputs and targets that are in no data set.

    Eyes are drawn from the ranges of Table 2 and, with probability
    ``population_ratio``, from the population.
    """
    domain = task.evaluation_domain
    n_rows = -(-n_rows // domain.n_repeats) * domain.n_repeats
    recipe = Recipe(
        *(domain.name, n_rows, n_rows, EVALUATION_SEED, "random", population_ratio)
    )
    shard: Shard = label(domain, draw(recipe, 0))
    if task.name == "focus":
        return shard.inputs, shard.targets
    x, y = task_rows(task.name, shard)
    return x.numpy(), y.numpy()


def column_ranges(run: Run, x: NDArray[Any]) -> list[dict[str, Any]]:
    """Return the ranges of inputs: as sampled or, for coefficients, as observed."""
    task = TASKS[run.task]
    domain = task.evaluation_domain
    ranges = input_ranges(domain, run.recipe.population_ratio)
    sampled = dict(zip(domain.inputs, ranges.tolist(), strict=True))
    seen = zip(x.min(axis=0).tolist(), x.max(axis=0).tolist(), strict=True)
    rows = []
    for name, extremes in zip(task.inputs, seen, strict=True):
        low, high = sampled.get(name, extremes)
        rows.append({"name": name, "low": low, "high": high})
    return rows


def _data(run: Run) -> dict[str, Any]:
    try:
        manifest = read_manifest(run.data_folder)
    except DataError:
        return asdict(run.recipe)
    keys = ("n_rows_kept", "n_rows_rejected", "commit")
    return asdict(run.recipe) | {name: manifest[name] for name in keys}


def evaluate(
    session: onnxruntime.InferenceSession, x: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the outputs of an exported network, in physical units."""
    return session.run(None, {"features": x})[0]


def _parity(
    task: Task, network: Network, session: onnxruntime.InferenceSession, x: NDArray[Any]
) -> dict[str, Any]:
    """Return the largest and the mean difference of exported and trained network."""
    with torch.no_grad():
        wanted = network(torch.from_numpy(x)).numpy()
    gap = np.abs(evaluate(session, x) - wanted)
    units = np.array([name.rsplit("_", 1)[-1] for name in task.outputs])
    columns = {unit: gap[:, units == unit] for unit in dict.fromkeys(units.tolist())}
    return {
        "n_samples": len(x),
        "max_abs": {unit: float(part.max()) for unit, part in columns.items()},
        "mean_abs": {unit: float(part.mean()) for unit, part in columns.items()},
    }


def tracing_errors(
    task: Task, found: NDArray[Any], x: NDArray[Any], y: NDArray[Any]
) -> dict[str, Any]:
    """Return errors against ray tracing, in the form of a card."""
    if task.name == "eye":
        error = misfit_of_eyes(found.astype(np.float64), x.astype(np.float64))
    else:
        error = found.astype(np.float64) - y
    names = error_columns(task.name)
    n_main = sum(name.endswith(f"_{task.unit}") for name in names)
    is_compared = np.ones(len(error), dtype=bool)
    if task.name == "focus":  # at a bound of the lens, any output beyond it is correct
        is_compared = is_within_reach(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    everywhere = float(np.abs(error).mean())
    error = error[is_compared]
    good = np.all(np.isfinite(error), axis=1)
    found_means = summary(task.name, error)
    per_row = np.abs(error[good][:, :n_main]).mean(axis=1)
    report = {
        "judge": "ray tracing",
        "n_samples": len(error),
        "n_failed": int(np.sum(~good)),
        "unit": task.unit,
        "mean_abs": found_means["error"],
        "median_abs": float(np.median(per_row)),
        "p95_abs": float(np.percentile(per_row, 95)),
        "by_radial_order": {
            key.removeprefix("error_n"): value
            for key, value in found_means.items()
            if key.startswith("error_n")
        },
    }
    if task.name == "focus":
        report["mean_abs_with_bounded"] = everywhere
    if "error_rim_mm" in found_means:
        report["rim_mean_abs_mm"] = found_means["error_rim_mm"]
    return report


def to_onnx(network: Network, *, n_inputs: int, half: bool) -> bytes:
    """Return a network as ONNX: one input ``features``, one output ``values``."""
    example = torch.rand(4, n_inputs)
    network = with_one_exponential(network)
    rows = torch.export.Dim("rows", min=1)
    with warnings.catch_warnings():
        # The exporter of torch emits warnings about torch itself.
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        program = torch.onnx.export(
            network,
            (example,),
            dynamo=True,
            input_names=["features"],
            output_names=["values"],
            dynamic_shapes=({0: rows},),
            verbose=False,
        )
    model = program.model_proto
    # Source locations of layers are not needed; they are half of the text of the file.
    for node in model.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    for value in (*model.graph.value_info, *model.graph.initializer):
        value.ClearField("metadata_props")
    if half:
        _halve_weights(model.graph)
    onnx.checker.check_model(model)
    return model.SerializeToString()


class OneExponential(nn.Module):
    """Mish, x tanh(log(1 + e^x)), as x n / (n + 2) with n = e^x (e^x + 2).

    The Mish and Softplus of onnxruntime are not vectorized and would take three
    quarters of the time of a network.
    """

    LARGEST = 20.0
    """Value above which Mish is x in float32."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply Mish to values of any shape."""
        power = torch.exp(torch.clamp(x, max=self.LARGEST))
        ratio = power * (power + 2.0)
        return x * ratio / (ratio + 2.0)


def with_one_exponential(network: Network) -> Network:
    """Return a copy of a network whose Mish layers are `OneExponential`."""
    network = copy.deepcopy(network)
    for module in list(network.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, nn.Mish):
                setattr(module, name, OneExponential())
    return network


def _halve_weights(graph: onnx.GraphProto) -> None:
    """Store weights of layers in 16 bits, with a cast to 32 bits in the graph.

    Optics and quadratic form remain in 32 bits, because no layer compensates for their
    rounding errors.
    """
    casts = []
    for tensor in graph.initializer:
        values = numpy_helper.to_array(tensor)
        is_layer = tensor.name.startswith("layers.") and values.dtype == np.float32
        if not is_layer or values.size < SMALLEST_HALVED:
            continue
        name = tensor.name
        stored = numpy_helper.from_array(values.astype(np.float16), f"{name}_half")
        tensor.CopyFrom(stored)
        casts.append(
            helper.make_node("Cast", [stored.name], [name], to=TensorProto.FLOAT)
        )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


if __name__ == "__main__":
    sys.exit(main())
