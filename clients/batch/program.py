"""`ocufilter batch`: offline filtering of data sets of color and depth."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import typer

from clients.batch.description import batch_of
from clients.batch.dry_run import dry_run, lines_of
from clients.batch.manifest import Manifest
from clients.batch.options import (
    BatchOptions,
    ImageSetOptions,
    workers_and_threads,
)
from clients.batch.pools import THREADS_VARIABLE, ProcessPool, RayPool
from clients.batch.run import (
    Batch,
    check_folder,
    check_links,
    discard_results,
    only_one,
    run_batch,
)
from clients.batch.work import EngineUnusable
from clients.commands.options import with_options
from clients.frame_log import note_line
from estimator.bounded_files import printable
from filter_service.command_line import (
    EXIT_FAILURE,
    EXIT_INTERRUPTED,
    CommandFailed,
    Json,
    print_json,
)
from filter_service.progress import Progress

SHOWN_FAILURES = 10


def run(options: BatchOptions, *, quiet: bool) -> dict[str, Any]:
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
        return dry_run(
            batch,
            n_workers=n_workers,
            n_threads=n_threads,
            price_per_core_hour=options.price_per_core_hour,
        )
    check_folder(batch.out)
    with only_one(batch.out) as lock:
        check_links(batch)
        pool = _pool(options, batch, n_workers, n_threads, lock)
        return filter_batch(batch, pool, overwrite=options.overwrite, quiet=quiet)


def filter_batch(
    batch: Batch,
    pool: ProcessPool | RayPool,
    *,
    overwrite: bool,
    quiet: bool,
    prepare: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Filter the missing frames of a batch in a locked folder; return its summary.

    Parameters
    ----------
    overwrite : bool
        Whether to delete the output of another job.
    quiet : bool
        Whether to report no progress.
    prepare : callable
        Called once the folder is known to belong to the batch.
    """
    if overwrite:
        discard_results(batch)
    with (
        Manifest(batch.out, batch.described(), facts=batch.facts()) as manifest,
        Progress("batch", quiet=quiet) as progress,
    ):
        prepare()
        names = list(batch.frames_of)
        task = progress.task(
            names[0] if len(names) == 1 else f"{len(names)} profiles",
            total=batch.count,
        )
        return run_batch(
            batch, manifest, pool, on_done=lambda n_done, n_all: task.update(n_done)
        )


def _pool(
    options: BatchOptions,
    batch: Batch,
    n_workers: int,
    n_threads: int,
    lock: int,
) -> ProcessPool | RayPool:
    if options.ray is None:
        return ProcessPool(
            batch.job, batch.out, n_workers=n_workers, n_threads=n_threads, lock=lock
        )
    return RayPool(
        batch.job,
        batch.out.absolute(),
        address=options.ray,
        n_workers=options.workers,
        n_threads=options.threads or 1,
    )


def report_lines(summary: dict[str, Any], options: ImageSetOptions) -> list[str]:
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


def print_lines(lines: Iterable[str]) -> None:
    """Print lines of text, whose names may come from files."""
    sys.stdout.writelines(f"{printable(line)}\n" for line in lines)


def print_failures(summary: dict[str, Any]) -> bool:
    """Print the first failures and the number of all; return whether there are any."""
    failures = summary.get("failures", [])
    lines = [
        f"batch: {one['profile']}, {one['frame']}: {one['error']}"
        for one in failures[:SHOWN_FAILURES]
    ]
    if failures:
        lines.append(f"batch: {len(failures)} images failed; the manifest lists them")
    sys.stderr.writelines(f"{printable(line)}\n" for line in lines)
    return bool(failures)


@contextmanager
def resumable(command: str) -> Iterator[None]:
    """Exit with one line if the run of a command is stopped, or its engine fails.

    SIGTERM stops the run as Ctrl-C does.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    except KeyboardInterrupt:
        sys.stderr.write(
            f"{command}: stopped; run the same command again to continue\n"
        )
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except EngineUnusable as error:
        raise CommandFailed(str(error)) from error


@with_options
def batch(options: BatchOptions, json_output: Json = False) -> None:
    """Filter folders and videos on all cores, through profiles or an eye per image.

    Run the same command again to continue an interrupted batch.

    ocufilter batch rgbd_dataset_freiburg1_desk -p myopia -p keratoconus -o seen

    ocufilter batch room/ -p me.json --fov-deg 50 --focus-dpt center -o room_seen

    ocufilter batch walk.mp4 --depth walk_depth.mkv --fov-deg 60 -p myopia
    --format h264 -o walk_seen

    ocufilter batch photos/ --sample-eyes 9 --fov-deg 20 --distance-m 2 -o persons

    \b
    Layouts, detected from the content of the folder:
      tum         TUM RGB-D: rgb/, depth/ and their lists; depth / 5000,
                  camera of the driver
      nyu         NYU depth v2: N_colors.png with N_depth.png, rgb_N.jpg with
                  sync_depth_N.png (mm), or raw dumps r-*.ppm with d-*.pgm
      middlebury  im0.png, disp0.pfm, calib.txt of one scene or of a folder
                  of scenes
      pairs       color/ and depth/, or NAME_color with NAME_depth; depth as
                  16-bit PNG, float TIFF, NPY, EXR or PFM; requires --fov-deg
                  or --intrinsics
      video       a color video, with depth as a 16-bit gray video or a folder
                  of images

    Results are OUT/PROFILE/FRAME.png or OUT/PROFILE.mkv, with a line for each frame in
    OUT/manifest.jsonl and a summary in OUT/manifest.json.  If each image has an eye of
    its own, by --eyes, --sample-eyes or --bank, they are OUT/images/FRAME.png, with
    labels in OUT/labels.csv.  The exit code is 1 if some frames failed.
    """  # noqa: D301  (\b keeps the lines of the list)
    with resumable("batch"):
        summary = run(options, quiet=json_output)
    if json_output:
        print_json(summary)
    elif options.dry_run:
        print_lines(lines_of(summary, options.price_per_core_hour))
    else:
        print_lines(report_lines(summary, options))
    if print_failures(summary) or (
        options.dry_run and all(p["errors"] for p in summary["profiles"])
    ):
        raise typer.Exit(EXIT_FAILURE)
