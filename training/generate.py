"""Ray-trace a data set into shards.

    python -m training.generate RUN.toml [--folder DIR]
    torchrun --nproc-per-node 2 -m training.generate RUN.toml

Reads the table ``[data]`` of the run file. Existing shards are not regenerated, so an
interrupted run can be resumed. With `torchrun`, each process generates a part of the
shards. Finally prints the statistics of the paper's Table 11.
"""

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from training.command import make_parser, run_command
from training.datasets import (
    MANIFEST,
    DataError,
    Recipe,
    draw,
    label,
    load,
    read_manifest,
    recipe_of,
    shard_file,
    write_manifest,
    write_shard,
)
from training.run_file import read_run
from training.statistics import format_statistics, group_statistics
from training.tasks import DOMAINS
from training.versions import commit_id


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = make_parser("generate", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN.toml")
    parser.add_argument("--folder", type=Path, help="instead of the run file's")
    return run_command(parser, _work, arguments)


def _work(options: argparse.Namespace) -> None:
    run = read_run(options.run)
    folder = options.folder or run.data_folder
    generate(run.recipe, folder, rank=_rank(), n_ranks=_n_ranks())


def _rank() -> int:
    return int(os.environ.get("RANK", "0"))


def _n_ranks() -> int:
    return int(os.environ.get("WORLD_SIZE", "1"))


def generate(recipe: Recipe, folder: Path, *, rank: int = 0, n_ranks: int = 1) -> None:
    """Generate the missing shards out of ``rank``, ``rank + n_ranks``, ...

    Raises
    ------
    DataError
        The folder contains a data set of another recipe.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / MANIFEST).exists() and recipe_of(read_manifest(folder)) != recipe:
        raise DataError(
            f"{folder} contains another data set ({recipe_of(read_manifest(folder))}); "
            "choose another folder or remove this one"
        )
    if rank == 0:
        commit = _commits(recipe, folder)
        write_manifest(folder, recipe, commit=commit)
    mine = range(rank, recipe.n_shards, n_ranks)
    wanted = [k for k in mine if not shard_file(folder, k).exists()]
    domain, started_s = DOMAINS[recipe.domain], time.perf_counter()
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=rank != 0) as bar:
        task = bar.add_task(f"{recipe.domain}: shards", total=len(wanted))
        for number in wanted:
            write_shard(folder, number, label(domain, draw(recipe, number)))
            bar.advance(task)
    if rank == 0:
        _await_others(recipe, folder, n_ranks)
        manifest = write_manifest(folder, recipe, commit=commit)
        _finish(manifest, folder, console, started_s)


def _commits(recipe: Recipe, folder: Path) -> str:
    """Return the commits of all shards, including those to be generated."""
    is_made = [shard_file(folder, k).exists() for k in range(recipe.n_shards)]
    is_begun = any(is_made) and (folder / MANIFEST).exists()
    before = read_manifest(folder)["commit"].split(", ") if is_begun else []
    now = [] if all(is_made) else [commit_id()]
    return ", ".join(dict.fromkeys(before + now))


def _finish(
    manifest: dict[str, Any], folder: Path, console: Console, started_s: float
) -> None:
    console.print(
        f"{manifest['n_rows_kept']} rows, {manifest['n_rows_rejected']} rejected, "
        f"{time.perf_counter() - started_s:.0f} s, in {folder}"
    )
    name, data = manifest["domain"], load(folder)
    print(format_statistics(name, group_statistics(DOMAINS[name], data.targets)))


def _await_others(recipe: Recipe, folder: Path, n_ranks: int) -> None:
    """Wait for the shards of the other processes."""
    while n_ranks > 1 and not all(
        shard_file(folder, k).exists() for k in range(recipe.n_shards)
    ):
        time.sleep(0.2)


if __name__ == "__main__":
    sys.exit(main())
