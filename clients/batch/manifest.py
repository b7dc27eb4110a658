"""Record of a batch: a line per frame during the run, and a summary at the end.

    manifest.jsonl   the job and facts about its start, then a line for each frame and
                     each video; if one was made again, its last line counts
    manifest.json    the job, counts, failures and notes

One process appends complete lines; a partial line after a power failure is removed. A
frame without a line is processed again even if its files exist.  File names that are
not UTF-8 are written with escapes (`text_of`).  Results are written atomically, and
recorded with their size and hash.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from msgspec import ValidationError, convert, defstruct

from clients.batch.source import SourceFrame
from clients.frame_log import Notes, add_notes
from clients.provenance import fingerprint
from estimator import InvalidFile
from estimator.bounded_files import loads_bounded
from filter_service.atomic_files import PART_NAME, replace_atomically, write_atomically

LINES, SUMMARY = "manifest.jsonl", "manifest.json"
LABELS = "labels.csv"
"""Labels of frames that have eyes of their own."""

RESTART = "the same value, another folder, or --overwrite"
MAX_LINE_BYTES, MAX_LINE_ITEMS = 16_000_000, 2_000_000
"""Limits of a line; a job with states of 200,000 frames, the maximum, takes half."""

SYNC_S = 2.0
"""Interval of writes to disk: a power failure loses at most this much work."""

Record = dict[str, Any]
"""A line of the manifest."""

ContentOf = Callable[[Path], Mapping[str, Any]]
"""Function that returns the size and the hash of a file, as `content_of`."""

_VIDEO = ""
"""Name of a profile's video among frames, whose names are not empty."""

_ESCAPE = re.compile(r"\\(?:\\|x[89a-f][0-9a-f])")
_FRAME = [("profile", str), ("frame", str), ("ok", bool)]
_CONTENT = [("bytes", int), ("sha256", str)]
FACTS = ("created", "argv", "display_nm")
"""Fields of the first line that do not determine the images: the time of the start, the
command line, and the wavelengths of the display."""

COUNTS = ("missing_depth_count", "clamped_depth_count", "overflow_count")
_Failed = defstruct("_Failed", [*_FRAME, ("error", str)])
_Video = defstruct("_Video", [("profile", str), ("file", str), *_CONTENT])
_Input = defstruct("_Input", _CONTENT)
_Done = defstruct(
    "_Done",
    [
        *_FRAME,
        ("file", str),
        *_CONTENT,
        ("inputs", list[_Input]),  # type: ignore[valid-type]
        ("notes", list[str]),
        *((name, int) for name in COUNTS),
    ],
)


def write_whole(path: Path, write: Callable[[Path], object]) -> dict[str, Any]:
    """Write a file atomically, and its folder if that is missing.

    A killed process leaves at most one temporary file, which `remove_parts` removes.

    Parameters
    ----------
    path : Path
        File to write.
    write : callable
        Function that writes the content to a path.

    Returns
    -------
    dict
        Size in ``bytes`` and ``sha256`` of the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {}

    def write_and_hash(part: Path) -> None:
        write(part)
        content.update(content_of(part))

    replace_atomically(path, write_and_hash)
    return content


def content_of(path: Path) -> dict[str, Any]:
    """Return the size of a file in bytes and its SHA-256."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"bytes": file.tell(), "sha256": digest}


def remove_parts(folder: Path) -> int:
    """Remove temporary files of killed processes; return their number."""
    parts = [
        path
        for path in folder.rglob(".ocufilter-*")
        if PART_NAME.fullmatch(path.name) and path.is_file() and not path.is_symlink()
    ]
    for path in parts:
        path.unlink(missing_ok=True)
    return len(parts)


def below(folder: Path, name: object) -> Path | None:
    """Return the path of a file below a folder; None if the name leads outside.

    Links in the folder are followed: a folder that is a link leads outside.
    """
    if not isinstance(name, str) or not name or "\0" in name:
        return None
    inner = Path(name)
    if inner.is_absolute() or ".." in inner.parts:
        return None
    path = folder / inner
    is_inside = path.parent.resolve().is_relative_to(folder.resolve())
    return path if is_inside else None


def text_of(name: str) -> str:
    r"""Return a file name as text that JSON can hold, whatever its bytes.

    Bytes that are not UTF-8 become ``\xNN``, and a backslash is doubled, so that no two
    names have the same text.
    """
    doubled = os.fsencode(name.replace("\\", r"\\"))
    return doubled.decode("utf-8", "backslashreplace")


def name_of(text: str) -> str:
    """Return the file name that `text_of` returned as text."""

    def unescaped(match: re.Match[str]) -> str:
        escape = match[0]
        return "\\" if escape == r"\\" else chr(0xDC00 + int(escape[2:], 16))

    return _ESCAPE.sub(unescaped, text)


_AS_TEXT: dict[str, Callable[[Any], Any]] = {
    "frame": text_of,
    "file": text_of,
    "files": lambda names: [*map(text_of, names)],
    "inputs": lambda files: [{**one, "name": text_of(one["name"])} for one in files],
    "error": lambda error: error.encode("utf-8", "backslashreplace").decode(),
}
"""Functions that make the values of a record text that JSON can hold."""


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
    facts : mapping
        Facts about the start of the job, such as the time, which `facts` returns when
        it is resumed.
    read_only : bool
        Whether to leave the file as it is, because another process may write to it.

    Attributes
    ----------
    facts : mapping
        Facts about the start of the job; none in manifests of earlier versions.

    Raises
    ------
    ManifestDiffers
        If the manifest belongs to another job.  The message names the difference.
    ValueError
        If the file is not a manifest.
    """

    def __init__(
        self,
        out: Path,
        job: Mapping[str, Any],
        *,
        facts: Mapping[str, Any] | None = None,
        read_only: bool = False,
    ) -> None:
        self._out = out
        self.facts: Mapping[str, Any] = facts or {}
        self._path = out / LINES
        self._read_only = read_only
        # Length and offset of lines by profile and frame, for videos `_VIDEO`
        self._places: dict[tuple[str, str], tuple[int, int]] = {}
        self._synced_s = time.monotonic()
        flags = os.O_RDONLY if read_only else os.O_RDWR | os.O_CREAT | os.O_APPEND
        flags |= os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            self._file = os.open(self._path, flags, 0o600)
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
        try:
            if not self._read_only:
                os.fsync(self._file)
        finally:
            os.close(self._file)

    def _read(self, job: Mapping[str, Any]) -> None:
        end = 0
        with self._path.open("rb") as file:
            while (line := file.readline(MAX_LINE_BYTES + 1)).endswith(b"\n"):
                record = _parsed(line, self._path)
                if end == 0:
                    _check_same(record, job, self._path)
                    self.facts = {key: record[key] for key in FACTS if key in record}
                elif record.get("kind") in ("frame", "video"):
                    _check(record, self._path)
                    self._places[_key(record)] = len(line), end
                end += len(line)
        if len(line) > MAX_LINE_BYTES:
            found = f"a line has more than {MAX_LINE_BYTES:,} bytes"
            raise InvalidFile(self._path, found, "fewer")
        if self._read_only:
            return
        os.ftruncate(self._file, end)
        if end == 0:
            self._write(_job_line(job, self.facts))

    def append(self, record: Record) -> None:
        """Append a line for a frame, or for the video of a profile."""
        written = {
            key: _AS_TEXT[key](value) if key in _AS_TEXT else value
            for key, value in record.items()
        }
        self._places[_key(written)] = self._write(_line(written))

    def check_in_place(self) -> None:
        """Check that the folder still contains the file.

        Raises
        ------
        OSError
            If it has been removed or replaced.
        """
        try:
            found = os.stat(self._path, follow_symlinks=False)
            in_place = os.path.samestat(found, os.fstat(self._file))
        except FileNotFoundError:
            in_place = False
        if not in_place:
            raise OSError(f"'{self._path}' was removed or replaced during the run")

    def _write(self, line: bytes) -> tuple[int, int]:
        place = os.lseek(self._file, 0, os.SEEK_END)
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
        return written, place

    def record(self, profile: str, frame: str) -> Record | None:
        """Return the last record of a frame, or None."""
        place = self._places.get((profile, text_of(frame)))
        return None if place is None else self._at(place)

    def _at(self, place: tuple[int, int]) -> Record:
        return json.loads(os.pread(self._file, *place))

    def records(self) -> Iterator[Record]:
        """Yield the last record of each frame, sorted by profile and name.

        Names are in the form that `text_of` returns.
        """
        for key in sorted(self._places):
            if key[1] != _VIDEO:
                yield self._at(self._places[key])

    def is_done(self, profile: str, frame: SourceFrame, content_of: ContentOf) -> bool:
        """Return whether a frame's output is intact and its inputs are unchanged.

        Parameters
        ----------
        content_of : callable
            Returns the size and hash of a file.
        """
        record = self.record(profile, frame.name)
        if record is None or not record["ok"]:
            return False
        # Records of earlier versions have no camera.
        source = json.loads(json.dumps(frame.described()))
        files, inputs = frame.files, record["inputs"]
        path = below(self._out, name_of(record["file"]))
        return (
            record.get("source", source) == source
            and len(files) == len(inputs)
            and path is not None
            and _has_content(path, record, content_of)
            and all(map(_has_content, files, inputs, [content_of] * len(files)))
        )

    def has_video(self, profile: str, path: Path, content_of: ContentOf) -> bool:
        """Return whether a file is the last video of a profile, unchanged."""
        record = self.record(profile, _VIDEO)
        return (
            record is not None
            and record["kind"] == "video"
            and _has_content(path, record, content_of)
        )


def begin_manifest(
    out: Path, job: Mapping[str, Any], facts: Mapping[str, Any] | None = None
) -> None:
    """Replace the manifest of a folder by a new one for a job, atomically."""
    write_atomically(out / LINES, _job_line(job, facts or {}))


def _job_line(job: Mapping[str, Any], facts: Mapping[str, Any]) -> bytes:
    return _line({"kind": "job", "fingerprint": fingerprint(job), **facts, **job})


def _key(record: Record) -> tuple[str, str]:
    name = record["frame"] if record["kind"] == "frame" else _VIDEO
    return record["profile"], name


def _line(record: Mapping[str, Any]) -> bytes:
    return json.dumps(record, allow_nan=False).encode() + b"\n"


def _has_content(
    path: Path, recorded: Mapping[str, Any], content_of: ContentOf
) -> bool:
    """Return whether a file has the recorded size and hash."""
    try:
        if not path.is_file() or path.stat().st_size != recorded["bytes"]:
            return False
        return content_of(path)["sha256"] == recorded["sha256"]
    except OSError:
        return False


def records_of(path: Path) -> Iterator[Record]:
    """Yield the readable records of a manifest."""
    with path.open("rb") as file:
        while line := file.readline(MAX_LINE_BYTES + 1):
            try:
                yield _parsed(line, path)
            except InvalidFile:
                continue


def _parsed(line: bytes, path: Path) -> Record:
    try:
        record = loads_bounded(line, max_bytes=MAX_LINE_BYTES, max_items=MAX_LINE_ITEMS)
    except ValueError:
        record = None
    if not isinstance(record, dict):
        found = f"a line is not a JSON object: {line[:60]!r}"
        raise InvalidFile(path, found, "the manifest of a batch")
    return record


def _check(record: Record, path: Path) -> None:
    """Check that the record of a frame or a video has all required fields."""
    kind = _Done if record.get("ok") else _Failed
    try:
        convert(record, _Video if record["kind"] == "video" else kind)
    except ValidationError as error:
        found = f"the record of a {record['kind']} is invalid: {error}"
        allowed = "the manifest of a batch, or --overwrite"
        raise InvalidFile(path, found, allowed) from None


def _check_same(found: Record, job: Mapping[str, Any], path: Path) -> None:
    if found.get("fingerprint") == fingerprint(job):
        return
    wanted = json.loads(json.dumps(job))  # lists for tuples, as in the file
    for name in sorted({*wanted, *found} - {"kind", "fingerprint", *FACTS}):
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
    write_atomically(out / SUMMARY, text)


def summary_of(manifest: Manifest, wanted: set[tuple[str, str]]) -> dict[str, Any]:
    """Return the counts, failures and notes of the requested frames, and of eyes.

    ``wanted`` contains profiles and frames as in the manifest.
    """
    n_done, failures = Counter[str](), []
    eyes: dict[str, list[str]] = {}
    notes: Notes = {}
    pixels = Counter[str]()
    for record in manifest.records():
        if (record["profile"], record["frame"]) not in wanted:
            continue
        if not record["ok"]:
            failures.append({k: record[k] for k in ("profile", "frame", "error")})
            continue
        n_done[record["profile"]] += 1
        if "eye_notes" in record:
            eyes.setdefault(record["profile"], record["eye_notes"])
        add_notes(notes, record["notes"])
        for name in COUNTS:
            pixels[name] += record[name]
    return {
        "frames_done": dict(n_done),
        "failures": failures,
        **pixels,
        "notes": list(notes.values()),
        "eye_notes": eyes,
    }
