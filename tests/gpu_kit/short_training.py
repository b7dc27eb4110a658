"""A data set and a short training: rows a second.

    python -m tests.gpu_kit.short_training RUN.toml

Everything is made in a folder of its own.  Prints one JSON object; the errors of the
network are those of `training.train`.
"""

import argparse
import json
import sys
import tempfile
import time
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import torch

from tests.benchmarks.harness import commit_id, machine_info
from training.generate import generate
from training.run_file import Run, read_run
from training.train import train


def data_set_row(run: Run) -> dict:
    """Trace the data set by the processor."""
    start_s = time.perf_counter()
    with redirect_stdout(sys.stderr):  # it prints its statistics
        generate(run.recipe, run.data_folder)
    return _row("data set", run.recipe.n_rows, time.perf_counter() - start_s)


def training_row(run: Run) -> dict:
    """Train to the end of the run file."""
    entry = train(run)
    return _row("training", entry["rows"], entry["seconds"]) | {"last": entry}


def _row(method: str, count: int, seconds: float) -> dict:
    return {
        "bench": "training",
        "method": method,
        "n": count,
        "seconds": seconds,
        "rows_per_s": count / seconds,
    }


def main() -> None:
    """Run both, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, metavar="RUN.toml")
    file = parser.parse_args().run
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    with tempfile.TemporaryDirectory() as folder:
        run = replace(
            read_run(file),
            data_folder=Path(folder) / "data",
            output_folder=Path(folder) / "run",
        )
        rows = [data_set_row(run), training_row(run)]
    machine = {**machine_info(), "torch": torch.__version__, "device": str(device)}
    print(json.dumps({"machine": machine, "commit": commit_id(), "rows": rows}))


if __name__ == "__main__":
    main()
