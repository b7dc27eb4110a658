"""Run of a batch: processes the missing frames and returns a summary."""

from __future__ import annotations

import fcntl
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, cast

from clients.batch.labels import write_labels
from clients.batch.manifest import (
    LABELS,
    LINES,
    SUMMARY,
    Manifest,
    begin_manifest,
    below,
    content_of,
    name_of,
    records_of,
    remove_parts,
    summary_of,
    text_of,
    write_summary,
    write_whole,
)
from clients.batch.pools import ProcessPool, RayPool
from clients.batch.source import SourceFrame
from clients.batch.work import EYES_FOLDER, Job, Unit
from estimator import InvalidFile, thread_count

UNIT_FRAMES = 16
"""Frames per unit of work: few enough that all workers finish at about the same time,
and enough that distribution takes no time."""

MANY_EYES, EYE_FRAMES = 32, 64
"""Number of eyes of single frames from which units are larger, so that one worker
builds an eye: there are enough units for all workers."""

SEGMENT_FRAMES = 48
"""Frames per video segment. The number does not depend on the workers, because it
determines the bytes of the video."""

SEGMENTS = ".segments"
VIDEO_SUFFIXES = (".mkv", ".mp4")
LOCK = ".lock"
LOCK_WAIT_S = 3.0
"""Time that the workers of a killed batch, which hold the lock, have to exit."""

_CHECKED_AT_ONCE = 1000
_SEGMENT_NAME = re.compile(r"\d{8}\.mkv")


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
    details : mapping
        More that determines the frames, for the manifest.
    """

    job: Job
    layout: str
    source: Path
    frames: Sequence[SourceFrame]
    out: Path
    details: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def frames_of(self) -> dict[str, Sequence[SourceFrame]]:
        """The frames of each profile: all, or those that have this eye."""
        if not self.has_own_eyes:
            return dict.fromkeys(self.job.profiles, self.frames)
        found: dict[str, list[SourceFrame]] = {}
        for frame in self.frames:
            assert frame.eye is not None
            found.setdefault(frame.eye.name, []).append(frame)
        return {**found}

    @property
    def has_own_eyes(self) -> bool:
        """Whether each frame has an eye of its own instead of all profiles."""
        return any(frame.eye is not None for frame in self.frames)

    @property
    def count(self) -> int:
        """Number of results."""
        return sum(map(len, self.frames_of.values()))

    @property
    def unit_frames(self) -> int:
        """Number of frames per unit of work, apart from videos."""
        is_by_eye = self.has_own_eyes and len(self.frames_of) >= MANY_EYES
        return EYE_FRAMES if is_by_eye else UNIT_FRAMES

    @property
    def folders(self) -> Sequence[str]:
        """Folders of results in the output folder."""
        return [EYES_FOLDER] if self.has_own_eyes else list(self.job.profiles)

    def described(self) -> dict[str, Any]:
        """Return the parameters that determine the images, for JSON."""
        return self._described

    def facts(self) -> dict[str, Any]:
        """Return facts about the start of the job, for the manifest."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return {
            "created": now,
            "argv": ["ocufilter", *map(text_of, sys.argv[1:])],
            "display_nm": self.job.settings.display_nm,
        }

    @cached_property
    def _described(self) -> dict[str, Any]:
        # Once, because code and videos may change during the run.
        return {
            "made_by": dict(self.job.made_by),
            "source": {
                "name": text_of(self.source.resolve().name),
                "layout": self.layout,
                "videos": {
                    text_of(path.name): digest
                    for path, (_, digest) in self._videos.items()
                },
                **self.details,
            },
            **self.job.described(),
        }

    @cached_property
    def _videos(self) -> dict[Path, tuple[tuple[int, ...], str]]:
        """Return the identity and the hash of each source video."""
        paths = {
            path
            for frame in self.frames
            for path in frame.videos
            if frame.fault is None
        }
        return {
            path: (_identity(path), content_of(path)["sha256"])
            for path in sorted(paths)
        }

    def check_videos(self) -> None:
        """Check that the source videos are those whose hashes the manifest contains.

        Raises
        ------
        OSError
            If one has changed since it was hashed.
        """
        for path, (identity, _) in self._videos.items():
            if _identity(path) != identity:
                raise OSError(
                    f"'{path}' changed during the run; start again with --overwrite"
                )


def _identity(path: Path) -> tuple[int, ...]:
    status = path.stat()
    times_ns = status.st_mtime_ns, status.st_ctime_ns  # users cannot set the latter
    return status.st_dev, status.st_ino, status.st_size, *times_ns


def check_folder(out: Path, *, own: Sequence[str] = ()) -> None:
    """Create the output folder, or check that it is empty or belongs to a batch.

    Parameters
    ----------
    own : sequence of str
        Names of files that may be there before a batch.

    Raises
    ------
    ValueError
        If it contains other files.
    """
    out.mkdir(parents=True, exist_ok=True)
    others = [path.name for path in out.iterdir() if path.name not in (LOCK, *own)]
    # In this order: another batch may be creating its manifest.
    if others and not (out / LINES).exists():
        raise ValueError(
            f"--out '{out}' contains '{min(others)}' and no {LINES}; allowed: an "
            "empty folder, or the folder of an earlier batch"
        )


def discard_results(batch: Batch) -> None:
    """Remove the results that the manifest lists, and replace it by the batch's.

    The caller must hold the lock of `only_one`.  If this is interrupted, the earlier
    manifest stays.
    """
    if not (batch.out / LINES).exists():
        return
    job = batch.described()  # raises if a video cannot be read
    for record in records_of(batch.out / LINES):
        file = record.get("file")
        names = [name_of(file)] if isinstance(file, str) else []
        profiles = record.get("profiles", ())
        if isinstance(profiles, dict | list):
            names += [f"{k}{suffix}" for k in profiles for suffix in VIDEO_SUFFIXES]
        for name in names:
            path = below(batch.out, name)
            if path is not None and not path.is_dir():
                path.unlink(missing_ok=True)
    _remove_segments(batch.out)
    for name in (SUMMARY, LABELS):
        (batch.out / name).unlink(missing_ok=True)
    begin_manifest(batch.out, job, batch.facts())


def _remove_segments(out: Path) -> None:
    """Remove the segments of videos, including those that no manifest lists."""
    for path in (out / SEGMENTS).glob("*/*.mkv"):
        name = path.relative_to(out).as_posix()
        if _SEGMENT_NAME.fullmatch(path.name) and below(out, name) is not None:
            path.unlink()
    with suppress(OSError):  # contains other files, or does not exist
        for folder in (out / SEGMENTS).iterdir():
            folder.rmdir()
        (out / SEGMENTS).rmdir()


def check_links(batch: Batch) -> None:
    """Check that no folder of results is a link to another place.

    Raises
    ------
    ValueError
        If one is.  The message names it.
    """
    for name in (SEGMENTS, *batch.folders):
        if below(batch.out, f"{name}/file") is None:
            raise ValueError(
                f"'{batch.out / name}' leads outside '{batch.out}'; allowed: a folder "
                "that is not a link"
            )


@contextmanager
def only_one(out: Path) -> Iterator[int]:
    """Lock a folder against a second batch; yield the descriptor that holds the lock.

    Processes that inherit the descriptor hold the lock, too.

    Raises
    ------
    ValueError
        If another batch is running there.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(out / LOCK, flags, 0o600)
    except OSError as error:
        found = f"cannot be opened ({error.strerror})"
        raise InvalidFile(out / LOCK, found, "a plain file or none") from None
    with os.fdopen(descriptor, "w") as file:
        deadline_s = time.monotonic() + LOCK_WAIT_S
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline_s:
                    found = f"--out '{out}': another batch is running there"
                    raise ValueError(found) from None
            time.sleep(0.02)
        yield file.fileno()


def missing_units(batch: Batch, manifest: Manifest) -> list[Unit]:
    """Return the missing work as units, profile by profile.

    This reads the results and the inputs of all frames in the manifest, on all cores.
    """
    units: list[Unit] = []
    known = cache(content_of)  # frames share segments, and profiles share inputs
    for profile in batch.frames_of:
        for segment, frames in _parts(batch, profile):
            is_done = _are_done(profile, frames, manifest, known)
            missing = [
                frame for frame, done in zip(frames, is_done, strict=True) if not done
            ]
            if missing and segment is not None:
                missing = list(frames)  # a segment is always written completely
            step = SEGMENT_FRAMES if segment is not None else batch.unit_frames
            for start in range(0, len(missing), step):
                some = tuple(missing[start : start + step])
                units.append(Unit(len(units), profile, some, segment))
    return units


def _are_done(
    profile: str,
    frames: Sequence[SourceFrame],
    manifest: Manifest,
    known: Callable[[Path], dict[str, Any]],
) -> list[bool]:
    found: list[bool] = []
    with ThreadPoolExecutor(thread_count()) as threads:
        for start in range(0, len(frames), _CHECKED_AT_ONCE):
            some = frames[start : start + _CHECKED_AT_ONCE]
            found += threads.map(
                lambda one: manifest.is_done(profile, one, known), some
            )
    return found


def _parts(
    batch: Batch, profile: str
) -> list[tuple[Path | None, Sequence[SourceFrame]]]:
    """Return the frames of a profile, divided into segments for a video."""
    if not batch.job.is_video:
        return [(None, batch.frames_of[profile])]
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
    pool: ProcessPool | RayPool,
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
    wanted = {
        (profile, text_of(frame.name))
        for profile, frames in batch.frames_of.items()
        for frame in frames
    }
    n_missing = sum(len(unit.frames) for unit in units)
    n_done = len(wanted) - n_missing
    on_done(n_done, len(wanted))
    for profile in {unit.profile for unit in units}:
        video_of(batch, profile).unlink(missing_ok=True)  # it will be written again
    cpu_s, n_failed = 0.0, 0
    try:
        with closing(pool.run(units)) as records:
            for record in records:
                batch.check_videos()
                manifest.append(record)
                n_failed += not record["ok"]
                cpu_s += record.get("cpu_ms", 0.0) / 1e3
                n_done += 1
                on_done(n_done, len(wanted))
    finally:
        remove_parts(batch.out)  # of killed workers
    if batch.job.is_video:
        _join_videos(batch, manifest)
    if batch.has_own_eyes:
        settings, source = batch.job.settings, batch.source
        write_labels(
            batch.out, manifest, batch.frames, settings=settings, source=source
        )
    manifest.check_in_place()
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
    write_summary(batch.out, {**manifest.facts, **batch.described(), **summary})
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
    given = [frame.time_s for frame in batch.frames if frame.time_s is not None]
    times_s = given if len(given) == len(batch.frames) else None
    for profile in batch.job.profiles:
        target = video_of(batch, profile)
        if manifest.has_video(profile, target, content_of):
            continue
        segments = [
            (number * SEGMENT_FRAMES, batch.out / cast(Path, segment))
            for number, (segment, frames) in enumerate(_parts(batch, profile))
            if any(
                (record := manifest.record(profile, frame.name)) and record["ok"]
                for frame in frames
            )
        ]
        if not segments:
            continue
        join = partial(
            join_segments,
            segments=segments,
            kind=kind,
            rate_hz=rate_hz,
            times_s=times_s,
        )
        content = write_whole(target, join)
        manifest.append(
            {"kind": "video", "profile": profile, "file": target.name, **content}
        )
