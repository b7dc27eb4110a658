"""Work of a worker: reads and filters the frames of a job, writes files and records."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from clients.batch.manifest import COUNTS, Record, below, write_whole
from clients.batch.refraction import RelaxedEye
from clients.batch.source import (
    BadFrame,
    Constant,
    FrameEye,
    Scaled,
    SourceFrame,
    States,
)
from clients.provenance import code_version, picture_metadata, profile_identity
from estimator.bounded_files import read_bytes
from filter_service import (
    Camera,
    EyeFilter,
    FilterError,
    FilterSettings,
    Output,
    RgbdView,
)
from filter_service.bounded_images import MAX_FILE_BYTES
from filter_service.camera import PixelGrid
from filter_service.errors import WorkerCrashed
from filter_service.image_files import (
    ImageFile,
    depth_of,
    named_note,
    read_color_file,
    write_image,
)
from filter_service.settings import MAX_PLANES

if TYPE_CHECKING:
    from clients.batch.video_reading import VideoReader


FORMATS = ("png", "npy", "exr", "ffv1", "h264")
LINEAR_FORMATS = ("npy", "exr")
VIDEO_FORMATS = ("ffv1", "h264")

Format = Literal["png", "npy", "exr", "ffv1", "h264"]

ATTEMPTS = 2
PNG_LEVEL = 1
"""Files are a fifth larger than by default and take a quarter of the time."""

EYES_FOLDER = "images"
"""Folder of the results of frames that have eyes of their own."""

ARCMIN_PER_MRAD = 60.0 * math.degrees(1e-3)

FAILURES = (ValueError, FilterError, OSError, MemoryError)
"""Exceptions that make a frame fail, but not the batch."""


@dataclass(frozen=True)
class Job:
    """Parameters that determine the images, whatever the workers and the order.

    Attributes
    ----------
    profiles : mapping
        Profiles, as JSON objects, by name.
    settings : FilterSettings
        Settings of the filter.
    states : States
        Pupil and focus of each frame.
    format : str
        Output format, one of `FORMATS`.
    half : bool
        Whether to write half floats instead of floats.
    engine : "native" or "gl"
        Engine that filters.
    render_tolerance : float
        Rendering error relative to the default.
    rate_hz : float
        Frame rate of output videos.
    made_by : mapping
        Version and commit of the program.
    """

    profiles: Mapping[str, Mapping[str, Any]]
    settings: FilterSettings
    states: States
    format: Format = "png"
    half: bool = False
    engine: Literal["native", "gl"] = "native"
    render_tolerance: float = 1.0
    rate_hz: float = 30.0
    made_by: Mapping[str, str | None] = field(default_factory=code_version)

    @property
    def output(self) -> Output:
        """Return the output kind of the filter for this format."""
        if self.format not in LINEAR_FORMATS:
            return "srgb8"
        return "linear16" if self.half else "linear"

    @property
    def is_video(self) -> bool:
        """Return whether the output is one video per profile."""
        return self.format in VIDEO_FORMATS

    def described(self) -> dict[str, Any]:
        """Return the parameters as plain values."""
        return {
            "profiles": {name: dict(body) for name, body in self.profiles.items()},
            "settings": self.settings.fields(),
            "states": self.states.described(),
            "format": self.format,
            "half": self.half,
            "engine": self.engine,
            "render_tolerance": self.render_tolerance,
            "rate_hz": self.rate_hz if self.is_video else None,
        }


def checked_settings(given: Mapping[str, Any]) -> FilterSettings:
    """Return settings from the fields of ``--settings``.

    Raises
    ------
    ValueError
        If a setting is unknown or out of range.
    """
    try:
        return FilterSettings(**given)
    except TypeError as error:
        raise ValueError(f"--settings: {error}") from None


def batch_settings(
    given: Mapping[str, Any], states: States, distances_dpt: Sequence[float] = ()
) -> FilterSettings:
    """Return the settings of a batch.

    Parameters
    ----------
    given : mapping
        Fields of `FilterSettings`.  Ranges that are not given are the defaults, widened
        to include the states.
    states : States
        Pupil and focus of each frame.
    distances_dpt : sequence of float
        Distances of all objects, if the frames have no other depth.

    Raises
    ------
    ValueError
        If a setting is unknown or out of range.
    """
    settings = checked_settings(given).covering(
        pupils_mm=() if "pupil_range_mm" in given else states.pupil_range_mm,
        foci_dpt=() if "focus_range_dpt" in given else states.focus_range_dpt,
    )
    if not distances_dpt or "object_range_dpt" in given or "object_planes_dpt" in given:
        return settings
    if len(distances_dpt) <= MAX_PLANES:
        return settings.changed(object_planes_dpt=tuple(sorted(distances_dpt)))
    return settings.covering(objects_dpt=tuple(distances_dpt))


class EngineUnusable(RuntimeError):
    """The engine does not work on this machine; the message says what to install."""


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


class UnitRunner:
    """Runner of units, which reads, filters and writes the frames of one job."""

    def __init__(self, job: Job, out: Path) -> None:
        self._job, self._out = job, out
        self._open: EyeFilter | None = None
        self._key: tuple[str, Camera] | None = None
        self._failure: FilterError | None = None
        self._readers: dict[Path, VideoReader] = {}
        self._eye_notes: tuple[str, ...] | None = None  # of an eye without a record
        self._relaxed: tuple[str, RelaxedEye] | None = None
        self.build_s = 0.0

    def close(self) -> None:
        """Release the filter and the video readers."""
        if self._open is not None:
            self._open.close()
        for reader in self._readers.values():
            reader.close()

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
            yield from self._segment(unit, unit.segment, is_wanted)
            return
        for frame in unit.frames:
            if not is_wanted():
                return
            cpu_s = time.process_time()
            record = self._picture(unit.profile, frame)
            yield record | {"cpu_ms": _cpu_ms_since(cpu_s)}

    def _picture(self, profile: str, frame: SourceFrame) -> Record:
        folder = profile if frame.eye is None else EYES_FOLDER
        file = Path(folder) / f"{frame.name}.{self._job.format}"
        try:
            color, grid, record = self.filtered(profile, frame)
            start_s = time.perf_counter()
            metadata = picture_metadata(
                self._job.made_by,
                self._identity(profile, frame),
                pupil_diameter_mm=record["pupil_mm"],
                focus_dpt=record["focus_dpt"],
                more=self._more(profile, frame),
            )
            write = partial(
                write_image,
                image=color,
                png_level=PNG_LEVEL,
                grid=grid,
                metadata=metadata,
            )
            written = write_whole(self._place(file), write)
        except FAILURES as error:
            return _failed(profile, frame, error)
        record["ms"]["write"] = _ms_since(start_s)
        return {**record, "file": file.as_posix(), **written}

    def _identity(self, profile: str, frame: SourceFrame) -> dict[str, str]:
        if frame.eye is None:
            return profile_identity(profile, self._job.profiles[profile])
        return {"name": profile, "sha256": frame.eye.profile.digest}

    def _more(self, profile: str, frame: SourceFrame) -> Record:
        """Return facts for the metadata of a result whose image has facts."""
        if not frame.facts:
            return {}
        job, form = self._job, frame.depth_form
        distance_dpt = form.distance_dpt if isinstance(form, Constant) else None
        return {
            **frame.facts,
            "distance_m": 1.0 / distance_dpt if distance_dpt else None,
            "distance_dpt": distance_dpt,
            "sample": job.profiles[profile].get("sample"),
            "display_nm": job.settings.display_nm,
            "render_tolerance": job.render_tolerance,
        }

    def _segment(
        self, unit: Unit, segment: Path, is_wanted: Callable[[], bool]
    ) -> Iterator[Record]:
        """Write a video segment; yield its records when it is complete."""
        from clients.batch.video_writing import VIDEO_KINDS, write_segment

        records: list[Record] = []
        ratio = 1.0

        def images() -> Iterator[tuple[int, NDArray[np.uint8]]]:
            nonlocal ratio
            shape = None
            for number, frame in enumerate(unit.frames):
                if not is_wanted():
                    raise Cancelled
                cpu_s = time.process_time()
                try:
                    image, grid, record = self.filtered(unit.profile, frame)
                    shape = shape or image.shape
                    if image.shape != shape:
                        raise BadFrame("its size differs")
                except FAILURES as error:
                    record = _failed(unit.profile, frame, error)
                else:
                    ratio = grid.pixel_aspect_ratio
                    yield number, image  # encoded before the next line runs
                records.append(record | {"cpu_ms": _cpu_ms_since(cpu_s)})

        def write(path: Path) -> None:
            write_segment(
                path,
                images(),
                kind=VIDEO_KINDS[self._job.format],
                rate_hz=self._job.rate_hz,
                pixel_aspect_ratio=lambda: ratio,
            )
            path.touch()  # exists even without frames

        try:
            place = self._place(segment)
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
                record = {**record, "file": segment.as_posix(), **written}
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

    def filtered(
        self, profile: str, frame: SourceFrame
    ) -> tuple[NDArray[Any], PixelGrid, Record]:
        """Return a filtered frame, the place of its pixels, and its record."""
        if frame.fault is not None:
            raise BadFrame(frame.fault)
        start_s = time.perf_counter()
        color, depth, inputs = self._read(frame)
        if (problem := color.grid.difference(depth.grid)) is not None:
            raise BadFrame(
                f"'{frame.depth}': {problem[0]}; allowed: the size of '{frame.color}', "
                f"{problem[1]}"
            )
        view = RgbdView(color.pixels, depth.pixels, frame.optics.tangents(color.grid))
        states = self._job.states if frame.eye is None else frame.eye.states
        pupil_mm, focus_dpt = states.of(frame.name, depth.pixels)
        read_ms, start_s = _ms_since(start_s), time.perf_counter()
        built_s = self.build_s
        seen = self._prepared(profile, frame, view.camera).filter(
            view,
            pupil_diameter_mm=pupil_mm,
            focus_dpt=focus_dpt,
            gaze_deg=None if frame.eye is None else frame.eye.gaze_deg,
            output=self._job.output,
            render_tolerance=self._job.render_tolerance,
        )
        record: Record = {
            "kind": "frame",
            "profile": profile,
            "frame": frame.name,
            "ok": True,
            "pupil_mm": seen.pupil_diameter_mm,
            "focus_dpt": seen.focus_dpt,
            **{name: seen.counts[name] for name in COUNTS},
            "notes": [
                *(*color.notes, *depth.notes, *seen.notes),
                *_margin_notes(frame, seen.pupil_diameter_mm, seen.focus_dpt),
            ],
            "inputs": inputs,
            "source": frame.described(),
            "ms": {"read": read_ms, "filter": _ms_since(start_s)},
        }
        if self.build_s > built_s:
            record["ms"]["build"] = 1e3 * (self.build_s - built_s)
        if frame.eye is not None:
            record["refraction"] = self._refraction(frame.eye, seen.pupil_diameter_mm)
        if self._eye_notes is not None:
            record["eye_notes"], self._eye_notes = [*self._eye_notes], None
        return seen.color, color.grid, record

    def _refraction(self, eye: FrameEye, pupil_mm: float) -> dict[str, float] | None:
        """Return the power vector of the eye of a frame."""
        if self._relaxed is None or self._relaxed[0] != eye.name:
            profile, age_years = eye.profile, self._job.settings.age_years
            if age_years is not None:
                profile = replace(profile, age_years=age_years)
            self._relaxed = eye.name, RelaxedEye(profile)
        return self._relaxed[1].power_vector(pupil_mm)

    def open(self, *, has_own_eyes: bool) -> EyeFilter:
        """Return the filter, which is opened by the first call.

        Parameters
        ----------
        has_own_eyes : bool
            Whether frames have eyes of their own: an eye of few images takes less time
            without a process that builds eyes.

        Raises
        ------
        EngineUnusable
        """
        try:
            self._open = self._open or EyeFilter(
                engine=self._job.engine, worker=not has_own_eyes
            )
        except FilterError as error:
            raise EngineUnusable(str(error)) from None
        return self._open

    def _prepared(self, profile: str, frame: SourceFrame, camera: Camera) -> EyeFilter:
        """Return the filter, prepared for a profile and for exactly a camera.

        With an eye prepared for similar cameras, images would depend on which camera
        came first.
        """
        eye, found = frame.eye, self.open(has_own_eyes=frame.eye is not None)
        if self._key != (profile, camera):
            self._key = None
            for _ in range(ATTEMPTS):
                self._failure = None
                body = self._job.profiles[profile] if eye is None else eye.profile
                settings = self._job.settings
                found.set_profile(body, settings=settings, views=camera)
                try:
                    ready = found.wait()
                    self.build_s += ready.build_ms / 1e3
                    self._eye_notes = ready.notes
                except FilterError as error:
                    self._failure = error
                if not isinstance(self._failure, WorkerCrashed):  # for lack of memory
                    break
            self._key = profile, camera
        if self._failure is not None:
            raise self._failure
        return found

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
        if isinstance(frame.depth_form, Constant):
            return color, frame.depth_form.like(color), inputs
        assert frame.depth is not None
        if frame.depth_index is None:
            content = content_of(frame.depth)
            return color, frame.depth_form.read(frame.depth, content), inputs
        stored = self._reader(frame.depth).integers(frame.depth_index)
        assert isinstance(frame.depth_form, Scaled)  # as in all videos
        depth_m, notes = depth_of(stored, frame.depth_form.depth_scale_m)
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
        "files": [path.name for path in (frame.color, frame.depth) if path],
    }


def _margin_notes(
    frame: SourceFrame, pupil_mm: float, focus_dpt: float
) -> tuple[str, ...]:
    """Note if blur reaches from beyond the picture into what it shows.

    The radius is that of the geometric blur of defocus, without other aberrations.
    """
    margin_arcmin = frame.facts.get("margin_arcmin")
    if margin_arcmin is None or not isinstance(frame.depth_form, Constant):
        return ()
    defocus_dpt = abs(focus_dpt - frame.depth_form.distance_dpt)
    radius_arcmin = 0.5 * pupil_mm * defocus_dpt * ARCMIN_PER_MRAD
    if radius_arcmin <= margin_arcmin:
        return ()
    return (
        f"blur of radius {radius_arcmin:.3g} arcmin exceeds the margin of "
        f"{margin_arcmin:.3g} arcmin around the stimulus: light from outside the "
        "picture is missing; use a larger picture",
    )


def _ms_since(start_s: float) -> float:
    return round(1e3 * (time.perf_counter() - start_s), 2)


def _cpu_ms_since(start_s: float) -> float:
    """Return the CPU time of this process, which builds only eyes of single frames."""
    return round(1e3 * (time.process_time() - start_s), 2)
