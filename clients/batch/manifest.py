"""Record of a batch: a line per frame during the run, and a summary at the end.

    manifest.jsonl   the job, then a line for each frame; if a frame was processed
    again,
                     its last line counts
    manifest.json    the job, counts, failures and notes

One process appends complete lines; a partial line after a power failure is removed. A
frame without a line is processed again even if its files exist.
"""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from clients.batch.atomic_files import is_unchanged, write_whole
from clients.batch.job import fingerprint
from clients.batch.work import Record
from clients.frame_log import Notes, add_notes
from estimator import InvalidFile
from estimator.bounded_files import loads_bounded

LINES, SUMMARY = "manifest.jsonl", "manifest.json"
RESTART = "the same value, another folder, or --overwrite"
MAX_LINE_BYTES, MAX_LINE_ITEMS = 16_000_000, 2_000_000
"""Limits of a line; a job with states of 200,000 frames, the maximum, takes half."""

SYNC_S = 2.0
"""Interval of writes to disk: a power failure loses at most this much work."""


class ManifestDiffers(InvalidFile):
    """The folder contains the results of another job."""


class Manifest:
    """Manifest of an output folder, which is read and then appended to.

    Parameters
    ----------
    out : Path
        Existing folder.
    job : mapping
        Parameters that determine the images, as JSON-compatible values.

    Raises
    ------
    ManifestDiffers
        If the manifest belongs to another job.  The message names the difference.
    ValueError
        If the file is not a manifest.
    """

    def __init__(self, out: Path, job: Mapping[str, Any]) -> None:
        self._out = out
        self._path = out / LINES
        self._places: dict[tuple[str, str], int] = {}  # byte offsets of lines
        self._synced_s = time.monotonic()
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK
        try:
            self._file = os.open(self._path, flags, 0o644)
        except OSError as error:
            found = f"cannot be opened ({error.strerror})"
            raise InvalidFile(self._path, found, "a plain file or none") from None
        try:
            self._read(job)
        except BaseException:
            os.close(self._file)
            raise

    def __enter__(self) -> Self:
        """Return the manifest."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Close the file."""
        os.fsync(self._file)
        os.close(self._file)

    def _read(self, job: Mapping[str, Any]) -> None:
        end = 0
        with self._path.open("rb") as file:
            while (line := file.readline(MAX_LINE_BYTES + 1)).endswith(b"\n"):
                record = _parsed(line, self._path)
                if end == 0:
                    _check_same(record, job, self._path)
                elif record.get("kind") == "frame":
                    _check_frame(record, self._path)
                    self._places[record["profile"], record["frame"]] = end
                end += len(line)
        if len(line) > MAX_LINE_BYTES:
            found = f"a line has more than {MAX_LINE_BYTES:,} bytes"
            raise InvalidFile(self._path, found, "fewer")
        os.ftruncate(self._file, end)
        if end == 0:
            self._write({"kind": "job", "fingerprint": fingerprint(job), **job})

    def append(self, record: Record) -> None:
        """Append a line for a frame."""
        self._places[record["profile"], record["frame"]] = self._write(record)

    def _write(self, record: Record) -> int:
        place = os.lseek(self._file, 0, os.SEEK_END)
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        written = os.write(self._file, line)
        if written != len(line):  # disk full: remove the partial line
            os.ftruncate(self._file, place)
            raise OSError(
                f"'{self._path}': {written} of {len(line)} bytes were written"
            )
        now_s = time.monotonic()
        if now_s - self._synced_s > SYNC_S:
            os.fsync(self._file)
            self._synced_s = now_s
        return place

    def record(self, profile: str, frame: str) -> Record | None:
        """Return the last record of a frame, or None."""
        place = self._places.get((profile, frame))
        return None if place is None else self._at(place)

    def _at(self, place: int) -> Record:
        parts: list[bytes] = []
        while not parts or b"\n" not in parts[-1]:
            size = sum(map(len, parts))
            parts.append(os.pread(self._file, 4096, place + size))
        return json.loads(b"".join(parts).split(b"\n", 1)[0])

    def records(self) -> Iterator[Record]:
        """Yield the last record of each frame, sorted by profile and name."""
        for key in sorted(self._places):
            yield self._at(self._places[key])

    def is_done(self, profile: str, frame: str, files: tuple[Path, ...]) -> bool:
        """Return whether a frame's output exists and its inputs are unchanged."""
        record = self.record(profile, frame)
        if record is None or not record["ok"]:
            return False
        path = below(self._out, record["file"])
        if path is None or not path.is_file() or path.stat().st_size != record["bytes"]:
            return False
        return len(files) == len(record["inputs"]) and all(
            is_unchanged(path, recorded)
            for path, recorded in zip(files, record["inputs"], strict=True)
        )


def records_of(path: Path) -> Iterator[Record]:
    """Yield the readable records of a manifest."""
    with path.open("rb") as file:
        while line := file.readline(MAX_LINE_BYTES + 1):
            try:
                yield _parsed(line, path)
            except InvalidFile:
                continue


def below(folder: Path, name: object) -> Path | None:
    """Return the path of a file that a manifest names; None if outside the folder."""
    if not isinstance(name, str) or not name or "\0" in name:
        return None
    inner = Path(name)
    if inner.is_absolute() or ".." in inner.parts:
        return None
    path = folder / inner
    is_inside = path.parent.resolve().is_relative_to(folder.resolve())
    return path if is_inside else None


def _parsed(line: bytes, path: Path) -> Record:
    try:
        record = loads_bounded(line, max_bytes=MAX_LINE_BYTES, max_items=MAX_LINE_ITEMS)
    except ValueError:
        record = None
    if not isinstance(record, dict):
        found = f"a line is not a JSON object: {line[:60]!r}"
        raise InvalidFile(path, found, "the manifest of a batch")
    return record


_FRAME_FIELDS: dict[str, type | tuple[type, ...]] = {
    "profile": str,
    "frame": str,
    "ok": bool,
}
_DONE_FIELDS: dict[str, type | tuple[type, ...]] = {
    "file": str,
    "bytes": int,
    "inputs": list,
    "notes": list,
    "missing_depth_count": int,
    "clamped_depth_count": int,
    "overflow_count": int,
}
_INPUT_FIELDS = {"bytes": int, "mtime_ns": int, "sha256": str}


def _check_frame(record: Record, path: Path) -> None:
    """Check that a frame's record has all required fields."""
    wanted = _FRAME_FIELDS | (_DONE_FIELDS if record.get("ok") else {"error": str})
    wrong = [k for k, kind in wanted.items() if not isinstance(record.get(k), kind)]
    if not wrong and record["ok"]:
        if not all(isinstance(note, str) for note in record["notes"]):
            wrong.append("notes")
        for recorded in record["inputs"]:
            if not isinstance(recorded, dict) or not all(
                isinstance(recorded.get(k), kind) for k, kind in _INPUT_FIELDS.items()
            ):
                wrong.append("inputs")
    if wrong:
        found = f"the record of a frame has an invalid '{wrong[0]}'"
        raise InvalidFile(path, found, "the manifest of a batch, or --overwrite")


def _check_same(found: Record, job: Mapping[str, Any], path: Path) -> None:
    if found.get("fingerprint") == fingerprint(job):
        return
    wanted = json.loads(json.dumps(job))  # lists for tuples, as in the file
    for name in sorted({*wanted, *found} - {"kind", "fingerprint"}):
        if found.get(name) != wanted.get(name):
            before, now = _first_difference(name, found.get(name), wanted.get(name))
            found_text = (
                f"{now[0]} is {_short(now[1])}, but was {_short(before[1])} when the "
                "batch in this folder started"
            )
            raise ManifestDiffers(path, found_text, RESTART)
    raise ManifestDiffers(path, "the manifest belongs to another job", RESTART)


def _first_difference(
    name: str, before: Any, now: Any
) -> tuple[tuple[str, Any], tuple[str, Any]]:
    """Return name and value of the first field that differs, before and now."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted({*before, *now}):
            if before.get(key) != now.get(key):
                inner = f"{name}.{key}"
                return _first_difference(inner, before.get(key), now.get(key))
    return (name, before), (name, now)


def _short(value: Any) -> str:
    text = "not given" if value is None else json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."


def write_summary(out: Path, summary: Mapping[str, Any]) -> None:
    """Write the summary atomically."""
    text = json.dumps(summary, indent=1, allow_nan=False) + "\n"

    def write(path: Path) -> None:
        path.write_text(text, encoding="utf-8")

    write_whole(out / SUMMARY, write)


def summary_of(manifest: Manifest, wanted: set[tuple[str, str]]) -> dict[str, Any]:
    """Return the counts, failures and notes of the requested frames."""
    n_done, failures = Counter[str](), []
    notes: Notes = {}
    pixels = Counter[str]()
    for record in manifest.records():
        if (record["profile"], record["frame"]) not in wanted:
            continue
        if not record["ok"]:
            failures.append({k: record[k] for k in ("profile", "frame", "error")})
            continue
        n_done[record["profile"]] += 1
        add_notes(notes, record["notes"])
        for name in ("missing_depth_count", "clamped_depth_count", "overflow_count"):
            pixels[name] += record[name]
    return {
        "frames_done": dict(n_done),
        "failures": failures,
        **pixels,
        "notes": list(notes.values()),
    }


def note_line(note: Mapping[str, Any]) -> str:
    """Format a note with its number of frames."""
    return f"{note['frames']} frames: {note['example']}"
