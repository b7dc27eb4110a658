"""Run of a batch: processes the missing frames and returns a summary."""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, cast

from clients.batch.atomic_files import content_of, remove_parts, write_whole
from clients.batch.job import Job, code_version
from clients.batch.manifest import (
    LINES,
    SUMMARY,
    Manifest,
    below,
    records_of,
    summary_of,
    write_summary,
)
from clients.batch.source import SourceFrame
from clients.batch.work import Record, Unit
from estimator import InvalidFile

UNIT_FRAMES = 16
"""Frames per unit of work: few enough that all workers finish at about the same time,
and enough that distribution takes no time."""

SEGMENT_FRAMES = 48
"""Frames per video segment. The number does not depend on the workers, because it
determines the bytes of the video."""

SEGMENTS = ".segments"
VIDEO_SUFFIXES = (".mkv", ".mp4")
LOCK = ".lock"


class Pool(Protocol):
    """Interface of pools that run units."""

    def run(self, units: Sequence[Unit]) -> Iterator[Record]:
        """Yield the records of units as frames are finished, in any order."""


@dataclass(frozen=True)
class Batch:
    """Frames to filter, parameters and output folder.

    Attributes
    ----------
    job : Job
        Parameters that determine the images.
    layout : str
        Layout of the data set.
    source : Path
        Folder or video of the frames.
    frames : sequence of SourceFrame
        Frames to filter.
    out : Path
        Output folder.
    """

    job: Job
    layout: str
    source: Path
    frames: Sequence[SourceFrame]
    out: Path

    def described(self) -> dict[str, Any]:
        """Return the parameters that determine the images, for JSON."""
        return {
            "made_by": code_version(),
            "source": {
                "name": self.source.resolve().name,
                "layout": self.layout,
                "videos": self._videos(),
            },
            **self.job.described(),
        }

    def _videos(self) -> dict[str, str]:
        """Return the hashes of the source videos."""
        paths = {
            path
            for frame in self.frames
            for path in {frame.color, frame.depth} - set(frame.files)
            if frame.fault is None
        }
        return {path.name: content_of(path)["sha256"] for path in sorted(paths)}


def prepare_folder(batch: Batch, *, overwrite: bool) -> None:
    """Create the output folder, or check that it belongs to a batch.

    Raises
    ------
    ValueError
        If it contains other files.
    """
    out = batch.out
    out.mkdir(parents=True, exist_ok=True)
    if not (out / LINES).exists():
        others = [path.name for path in out.iterdir() if path.name != LOCK]
        if others:
            raise ValueError(
                f"--out '{out}' contains '{min(others)}' and no {LINES}; allowed: an "
                "empty folder, or the folder of an earlier batch"
            )
    elif overwrite:
        _remove_results(batch)


def _remove_results(batch: Batch) -> None:
    """Remove the results of an earlier batch that its manifest lists."""
    for record in records_of(batch.out / LINES):
        names = [record.get("file")]
        profiles = record.get("profiles", ())
        if isinstance(profiles, dict | list):
            names += [f"{k}{suffix}" for k in profiles for suffix in VIDEO_SUFFIXES]
        for name in names:
            path = below(batch.out, name)
            if path is not None and not path.is_dir():
                path.unlink(missing_ok=True)
    shutil.rmtree(batch.out / SEGMENTS, ignore_errors=True)
    for name in (SUMMARY, LINES):
        (batch.out / name).unlink(missing_ok=True)


@contextmanager
def only_one(out: Path) -> Iterator[None]:
    """Lock a folder against a second batch.

    Raises
    ------
    ValueError
        If another batch is running there.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(out / LOCK, flags, 0o644)
    except OSError as error:
        found = f"cannot be opened ({error.strerror})"
        raise InvalidFile(out / LOCK, found, "a plain file or none") from None
    with os.fdopen(descriptor, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"--out '{out}': another batch is running there") from None
        yield


def missing_units(batch: Batch, manifest: Manifest) -> list[Unit]:
    """Return the missing work as units, profile by profile."""
    units: list[Unit] = []
    for profile in batch.job.profiles:
        for segment, frames in _parts(batch, profile):
            missing = [
                frame
                for frame in frames
                if not manifest.is_done(profile, frame.name, frame.files)
            ]
            if missing and segment is not None:
                missing = list(frames)  # a segment is always written completely
            step = SEGMENT_FRAMES if segment is not None else UNIT_FRAMES
            for start in range(0, len(missing), step):
                some = tuple(missing[start : start + step])
                units.append(Unit(len(units), profile, some, segment))
    return units


def _parts(
    batch: Batch, profile: str
) -> list[tuple[Path | None, Sequence[SourceFrame]]]:
    """Return the frames of a profile, divided into segments for a video."""
    if not batch.job.is_video:
        return [(None, batch.frames)]
    return [
        (
            Path(SEGMENTS) / profile / f"{start:08d}.mkv",
            batch.frames[start : start + SEGMENT_FRAMES],
        )
        for start in range(0, len(batch.frames), SEGMENT_FRAMES)
    ]


def run_batch(
    batch: Batch,
    manifest: Manifest,
    pool: Pool,
    *,
    on_done: Callable[[int, int], None] = lambda n_done, n_all: None,
) -> dict[str, Any]:
    """Process the missing frames; write and return the summary.

    Parameters
    ----------
    batch : Batch
        Batch to run.
    manifest : Manifest
        Record of the finished frames.
    pool : Pool
        Workers.
    on_done : callable
        Called with the number of finished frames and the total.
    """
    remove_parts(batch.out)
    started_s = time.monotonic()
    units = missing_units(batch, manifest)
    wanted = {(p, frame.name) for p in batch.job.profiles for frame in batch.frames}
    n_missing = sum(len(unit.frames) for unit in units)
    n_done = len(wanted) - n_missing
    on_done(n_done, len(wanted))
    for profile in {unit.profile for unit in units}:
        video_of(batch, profile).unlink(missing_ok=True)  # it will be written again
    cpu_s, n_failed = 0.0, 0
    for record in pool.run(units):
        manifest.append(record)
        n_failed += not record["ok"]
        cpu_s += record.get("cpu_ms", 0.0) / 1e3
        n_done += 1
        on_done(n_done, len(wanted))
    remove_parts(batch.out)  # of killed workers
    if batch.job.is_video:
        _join_videos(batch, manifest)
    took_s = time.monotonic() - started_s
    summary = {
        "frames": len(wanted),
        **summary_of(manifest, wanted),
        "this_run": {
            "frames": n_missing,
            "failed": n_failed,
            "seconds": round(took_s, 3),
            "core_seconds": round(cpu_s, 3),
        },
    }
    write_summary(batch.out, {**batch.described(), **summary})
    return summary


def video_of(batch: Batch, profile: str) -> Path:
    """Return the path of a profile's video."""
    suffix = ".mp4" if batch.job.format == "h264" else ".mkv"
    return batch.out / f"{profile}{suffix}"


def _join_videos(batch: Batch, manifest: Manifest) -> None:
    """Join the segments of each profile whose video is missing.

    Segments are kept, so that after an input file is repaired, only its segment is
    written again.
    """
    from clients.batch.video_writing import VIDEO_KINDS, join_segments

    kind, rate_hz = VIDEO_KINDS[batch.job.format], batch.job.rate_hz
    for profile in batch.job.profiles:
        target = video_of(batch, profile)
        if target.is_file():
            continue
        segments = [
            (number * SEGMENT_FRAMES, batch.out / cast(Path, segment))
            for number, (segment, frames) in enumerate(_parts(batch, profile))
            if any(_is_ok(manifest, profile, frame) for frame in frames)
        ]
        if not segments:
            continue

        def join(path: Path, segments: list[tuple[int, Path]] = segments) -> None:
            join_segments(path, segments, kind=kind, rate_hz=rate_hz)

        write_whole(target, join)


def _is_ok(manifest: Manifest, profile: str, frame: SourceFrame) -> bool:
    record = manifest.record(profile, frame.name)
    return record is not None and record["ok"]
