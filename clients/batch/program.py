"""`ocufilter batch`: offline filtering of data sets of color and depth."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Sequence
from typing import Any

from clients.batch.dry_run import dry_run, lines_of
from clients.batch.exact_filter import EngineUnusable
from clients.batch.manifest import Manifest, note_line
from clients.batch.options import arguments_of, batch_of, workers_and_threads
from clients.batch.process_pool import THREADS_VARIABLE, ProcessPool
from clients.batch.run import (
    Batch,
    Pool,
    begin_anew,
    check_folder,
    check_links,
    only_one,
    run_batch,
)
from estimator.bounded_files import printable
from filter_service.errors import FilterError
from filter_service.progress import Progress

SHOWN_FAILURES = 10
INSTALL = f"{sys.executable} -m pip install"


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Run the batch; return its summary.

    Raises
    ------
    ValueError
        If an input is invalid.  The message names it.
    EngineUnusable
        If the engine does not work on this machine.
    """
    n_workers, n_threads = workers_and_threads(options)
    batch = batch_of(options)
    if options.dry_run:
        os.environ[THREADS_VARIABLE] = "1"
        price = options.price_per_core_hour
        return dry_run(batch, n_cores=n_workers * n_threads, price_per_core_hour=price)
    check_folder(batch.out)
    with only_one(batch.out) as lock:
        check_links(batch)
        pool = _pool(options, batch, n_workers, n_threads, lock)
        if options.overwrite:
            begin_anew(batch)
        with (
            Manifest(batch.out, batch.described()) as manifest,
            Progress("batch", quiet=options.json) as progress,
        ):
            task = progress.task(
                ", ".join(batch.job.profiles),
                total=len(batch.frames) * len(batch.job.profiles),
            )
            return run_batch(
                batch, manifest, pool, on_done=lambda n_done, n_all: task.update(n_done)
            )


def _pool(
    options: argparse.Namespace,
    batch: Batch,
    n_workers: int,
    n_threads: int,
    lock: int,
) -> Pool:
    if options.ray is None:
        return ProcessPool(
            batch.job, batch.out, n_workers=n_workers, n_threads=n_threads, lock=lock
        )
    from clients.batch.ray_pool import RayPool

    return RayPool(
        batch.job,
        batch.out.absolute(),
        address=options.ray,
        n_workers=options.workers,
        n_threads=options.threads or 1,
    )


def report_lines(summary: dict[str, Any], options: argparse.Namespace) -> list[str]:
    """Format the summary as lines of text."""
    this_run = summary["this_run"]
    n_all, n_failed = summary["frames"], len(summary["failures"])
    lines = [
        f"{options.out}: {n_all - n_failed} of {n_all} images, "
        f"{this_run['frames'] - this_run['failed']} of them in this run, in "
        f"{this_run['seconds']:.1f} s"
    ]
    for kind in ("missing", "clamped"):
        if count := summary.get(f"{kind}_depth_count"):
            lines.append(f"note: {count} pixels with {kind} depth")
    return lines + [f"note: {note_line(note)}" for note in summary["notes"]]


def failure_lines(summary: dict[str, Any]) -> list[str]:
    """Format the first failures and the number of all."""
    failures = summary.get("failures", [])
    lines = [
        f"batch: {one['profile']}, {one['frame']}: {one['error']}"
        for one in failures[:SHOWN_FAILURES]
    ]
    if failures:
        lines.append(f"batch: {len(failures)} images failed; the manifest lists them")
    return lines


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code."""
    options = arguments_of(argv)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        summary = run(options)
    except KeyboardInterrupt:
        print("batch: stopped; run the same command again to continue", file=sys.stderr)
        return 130
    except ModuleNotFoundError as error:
        if error.name not in ("av", "ray"):
            raise
        extra = "batch" if error.name == "av" else "batch-ray"
        print(
            f"batch: {error.name} is not installed: {INSTALL} 'ocufilter[{extra}]'",
            file=sys.stderr,
        )
        return 1
    except ValueError as error:
        print(f"batch: {printable(' '.join(str(error).split()))}", file=sys.stderr)
        return 2
    except (EngineUnusable, FilterError, OSError) as error:
        print(f"batch: {printable(str(error))}", file=sys.stderr)
        return 1
    if options.json:
        lines = [json.dumps(summary, allow_nan=False)]  # ASCII of any length
    elif options.dry_run:
        lines = [*map(printable, lines_of(summary, options.price_per_core_hour))]
    else:
        lines = [*map(printable, report_lines(summary, options))]
    sys.stdout.write("\n".join(lines) + "\n")
    if options.dry_run and all(p["errors"] for p in summary["profiles"]):
        return 1
    failures = failure_lines(summary)
    sys.stderr.writelines(f"{printable(line)}\n" for line in failures)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
