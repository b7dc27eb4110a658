"""Work of a worker: reads and filters frames, writes files and returns records."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clients.batch.atomic_files import below, write_whole
from clients.batch.exact_filter import ExactFilter
from clients.batch.job import Job
from clients.batch.source import BadFrame, SourceFrame, check_sizes
from estimator.bounded_files import read_bytes
from filter_service import Filtered, FilterError, RgbdView
from filter_service.bounded_images import MAX_FILE_BYTES
from filter_service.camera import PixelGrid
from filter_service.image_files import (
    ImageFile,
    named_note,
    read_color_file,
    write_image,
)

if TYPE_CHECKING:
    from clients.batch.video_reading import VideoReader

Record = dict[str, Any]
"""A line of the manifest."""

PNG_LEVEL = 1
"""Files are a fifth larger than by default and take a quarter of the time."""

FAILURES = (ValueError, FilterError, OSError, MemoryError)
"""Exceptions that make a frame fail, but not the batch."""


@dataclass(frozen=True)
class Unit:
    """Unit of work: consecutive frames through one profile.

    Attributes
    ----------
    number : int
        Number of the unit in the run.
    profile : str
        Name of the profile.
    frames : tuple of SourceFrame
        Frames to filter.
    segment : Path, optional
        Video segment to write, relative to the output folder.
    """

    number: int
    profile: str
    frames: tuple[SourceFrame, ...]
    segment: Path | None = None


@dataclass
class FilteredPicture:
    """A filtered frame, the place of its pixels, and its record without the file."""

    filtered: Filtered
    grid: PixelGrid
    record: Record


class UnitRunner:
    """Runner of units, which reads, filters and writes the frames of one job."""

    def __init__(self, job: Job, out: Path) -> None:
        self._job, self._out = job, out
        self._filter = ExactFilter(job)
        self._readers: dict[Path, VideoReader] = {}

    def close(self) -> None:
        """Release the filter and the video readers."""
        self._filter.close()
        for reader in self._readers.values():
            reader.close()
        self._readers = {}

    @property
    def build_s(self) -> float:
        """Return the total preparation time of eyes so far."""
        return self._filter.build_s

    def run(
        self, unit: Unit, is_wanted: Callable[[], bool] = lambda: True
    ) -> Iterator[Record]:
        """Yield the record of each frame once its file is written.

        Parameters
        ----------
        unit : Unit
            Frames to process.
        is_wanted : callable
            Called before each frame; the unit stops if it returns False.
        """
        if unit.segment is not None:
            yield from self._segment(unit, is_wanted)
            return
        for frame in unit.frames:
            if not is_wanted():
                return
            cpu_s = time.process_time()
            record = self._picture(unit.profile, frame)
            yield record | {"cpu_ms": _cpu_ms_since(cpu_s)}

    def _picture(self, profile: str, frame: SourceFrame) -> Record:
        seen = self._attempt(profile, frame)
        if not isinstance(seen, FilteredPicture):
            return seen
        start_s = time.perf_counter()
        file = Path(profile) / f"{frame.name}.{self._job.format}"
        color = seen.filtered.color

        def write(path: Path) -> None:
            write_image(path, color, png_level=PNG_LEVEL, grid=seen.grid)

        try:
            written = write_whole(self._place(file), write)
        except FAILURES as error:
            return _failed(profile, frame, error)
        seen.record["ms"]["write"] = _ms_since(start_s)
        return {**seen.record, "file": file.as_posix(), **written}

    def _segment(self, unit: Unit, is_wanted: Callable[[], bool]) -> Iterator[Record]:
        """Write a video segment; yield its records when it is complete."""
        from clients.batch.video_writing import VIDEO_KINDS, write_segment

        assert unit.segment is not None
        records: list[Record] = []
        ratio = 1.0

        def images() -> Iterator[tuple[int, NDArray[np.uint8]]]:
            nonlocal ratio
            shape = None
            for number, frame in enumerate(unit.frames):
                if not is_wanted():
                    raise Cancelled
                cpu_s = time.process_time()
                seen = self._attempt(unit.profile, frame)
                if isinstance(seen, FilteredPicture):
                    image = seen.filtered.color
                    shape = shape or image.shape
                    if image.shape == shape:
                        ratio = seen.grid.pixel_aspect_ratio
                        yield number, image  # encoded before the next line runs
                        records.append(seen.record | {"cpu_ms": _cpu_ms_since(cpu_s)})
                        continue
                    seen = _failed(unit.profile, frame, BadFrame("its size differs"))
                records.append(seen | {"cpu_ms": _cpu_ms_since(cpu_s)})

        def write(path: Path) -> None:
            kind, rate_hz = VIDEO_KINDS[self._job.format], self._job.rate_hz
            write_segment(
                path,
                images(),
                kind=kind,
                rate_hz=rate_hz,
                pixel_aspect_ratio=lambda: ratio,
            )
            path.touch()  # exists even without frames

        try:
            place = self._place(unit.segment)
            written = write_whole(place, write)
        except Cancelled:
            return
        except FAILURES as error:
            for frame in unit.frames:
                yield _failed(unit.profile, frame, error)
            return
        if not any(record["ok"] for record in records):
            place.unlink()
        for record in records:
            if record["ok"]:
                record = {**record, "file": unit.segment.as_posix(), **written}
            yield record

    def _place(self, file: Path) -> Path:
        """Return the path of a result; reject a folder that is a link to elsewhere."""
        path = below(self._out, file.as_posix())
        if path is None:
            raise BadFrame(
                f"'{self._out / file}' leads outside '{self._out}'; allowed: folders "
                "that are not links"
            )
        return path

    def _attempt(self, profile: str, frame: SourceFrame) -> FilteredPicture | Record:
        try:
            return self._filtered(profile, frame)
        except FAILURES as error:
            return _failed(profile, frame, error)

    def _filtered(self, profile: str, frame: SourceFrame) -> FilteredPicture:
        if frame.fault is not None:
            raise BadFrame(frame.fault)
        start_s = time.perf_counter()
        color, depth, inputs = self._read(frame)
        check_sizes(frame, color, depth)
        depth_m = depth.pixels
        tangents = frame.optics.tangents(color.grid)
        view = RgbdView(color.pixels, depth_m, tangents)
        pupil_mm, focus_dpt = self._job.states.of(frame.name, depth_m)
        read_ms, start_s = _ms_since(start_s), time.perf_counter()
        built_s = self._filter.build_s
        seen = self._filter.see(profile, view, pupil_mm=pupil_mm, focus_dpt=focus_dpt)
        built_now = self._filter.build_s > built_s
        record: Record = {
            "kind": "frame",
            "profile": profile,
            "frame": frame.name,
            "ok": True,
            "pupil_mm": seen.pupil_diameter_mm,
            "focus_dpt": seen.focus_dpt,
            "missing_depth_count": int(seen.missing_depth_count),
            "clamped_depth_count": int(seen.clamped_depth_count),
            "overflow_count": int(seen.overflow_count),
            "notes": [*color.notes, *depth.notes, *seen.notes],
            "inputs": inputs,
            "source": frame.described(),
            "ms": {"read": read_ms, "filter": _ms_since(start_s)},
        }
        if built_now:
            record["ms"]["build"] = 1e3 * (self._filter.build_s - built_s)
        return FilteredPicture(seen, color.grid, record)

    def _read(self, frame: SourceFrame) -> tuple[ImageFile, ImageFile, list[Record]]:
        """Return color, depth and the records of the image files.

        Each file is read once: the bytes that are decoded are those that are hashed,
        even if the file changes.
        """
        inputs: list[Record] = []

        def content_of(path: Path) -> bytes:
            content = read_bytes(path, max_bytes=MAX_FILE_BYTES)
            digest = hashlib.sha256(content).hexdigest()
            n_bytes = len(content)
            inputs.append({"name": path.name, "bytes": n_bytes, "sha256": digest})
            return content

        if frame.color_index is None:
            content = content_of(frame.color)
            color = read_color_file(frame.color, option="", content=content)
        else:
            color = self._reader(frame.color).color(frame.color_index)
        if frame.depth_index is None:
            content = content_of(frame.depth)
            return color, frame.depth_form.read(frame.depth, content), inputs
        stored = self._reader(frame.depth).integers(frame.depth_index)
        depth_m, notes = frame.depth_form.of_integers(stored)
        grid = PixelGrid(depth_m.shape[1], depth_m.shape[0])
        named = tuple(named_note(frame.depth, note) for note in notes)
        return color, ImageFile(depth_m, grid, named), inputs

    def _reader(self, path: Path) -> VideoReader:
        if path not in self._readers:
            from clients.batch.video_reading import VideoReader

            self._readers[path] = VideoReader(path)
        return self._readers[path]


class Cancelled(Exception):
    """The unit is no longer needed."""


def failed_records(unit: Unit, names: Sequence[str], reason: str) -> list[Record]:
    """Return the records of frames that failed for a reason."""
    return [
        _failed(unit.profile, frame, BadFrame(reason))
        for frame in unit.frames
        if frame.name in names
    ]


def _failed(profile: str, frame: SourceFrame, error: BaseException) -> Record:
    text = str(error) or type(error).__name__
    return {
        "kind": "frame",
        "profile": profile,
        "frame": frame.name,
        "ok": False,
        "error": text,
        "files": [frame.color.name, frame.depth.name],
    }


def _ms_since(start_s: float) -> float:
    return round(1e3 * (time.perf_counter() - start_s), 2)


def _cpu_ms_since(start_s: float) -> float:
    """Return the CPU time of this process, without that of building PSFs."""
    return round(1e3 * (time.process_time() - start_s), 2)
