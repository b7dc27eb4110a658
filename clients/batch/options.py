"""Options of `ocufilter batch`, and the batch that they describe."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clients.batch.layouts import list_frames, optics_of
from clients.batch.run import Batch
from clients.batch.source import CENTER, SourceFrame, States, number_or_nan, read_states
from clients.batch.work import (
    LINEAR_FORMATS,
    VIDEO_FORMATS,
    Format,
    Job,
    batch_settings,
)
from clients.commands.options import read_object
from clients.provenance import folder_name, profile_name
from estimator import InvalidFile, load_profile, profile_body, thread_count
from filter_service.command_line import check_range, likely_number
from filter_service.settings import (
    MAX_PUPIL_MM,
    MAX_RENDER_TOLERANCE,
    MAX_VERGENCE_DPT,
    MIN_PUPIL_MM,
)

Layout = Literal["auto", "tum", "nyu", "middlebury", "pairs", "video"]
FPS_LIMITS_HZ = (0.1, 1000.0)


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """Options of the command line."""

    source: Annotated[
        Path,
        typer.Argument(metavar="INPUT", help="Folder or video."),
    ]
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Output folder.")
    ]
    profile: Annotated[
        list[str],
        typer.Option(
            "--profile",
            "-p",
            metavar="P",
            help="Preset name, a .json, .abp, .csv or .zmx file, or JSON; repeatable.  "
            "NAME=P sets the name of its folder.",
        ),
    ]
    layout: Annotated[
        Layout,
        typer.Option(help="Layout of a folder; auto detects it from the content."),
    ] = "auto"
    depth: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Folder or video of depth."),
    ] = None
    depth_scale: Annotated[
        float | None,
        typer.Option(metavar="M", help="Meters per unit of depth."),
    ] = None
    fov_deg: Annotated[
        float | None, typer.Option(help="Vertical field of view, deg.")
    ] = None
    intrinsics: Annotated[
        str | None,
        typer.Option(metavar="FX,FY,CX,CY", help="Camera matrix in px."),
    ] = None
    limit: Annotated[
        int | None, typer.Option(metavar="N", help="Use only the first N frames.")
    ] = None
    pupil_mm: Annotated[float, typer.Option(help="Entrance pupil, mm.")] = 4.0
    focus_dpt: Annotated[
        str,
        typer.Option(
            metavar="DPT|center",
            help="Focus distance, dpt, or the depth at the center of each frame; 0 is "
            "infinity.",
        ),
    ] = "0"
    states: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Table with one row per frame and the columns frame, pupil_mm and "
            "focus_dpt.",
        ),
    ] = None
    settings: Annotated[
        str,
        typer.Option(
            metavar="JSON",
            help='Settings such as {"mode": "quality", "object_range_dpt": [0, 5]}.',
        ),
    ] = "{}"
    render_tolerance: Annotated[
        float,
        typer.Option(
            help="Rendering error relative to the default; 0 is exact but slow."
        ),
    ] = 1.0
    format: Annotated[
        Format,
        typer.Option(
            help="png: sRGB; npy, exr: linear light; ffv1: lossless video; h264: video."
        ),
    ] = "png"
    half: Annotated[
        bool, typer.Option("--half", help="Write half floats to npy or exr.")
    ] = False
    fps: Annotated[
        float | None,
        typer.Option(
            help="Frame rate of videos; by default the times of the input video, or 30."
        ),
    ] = None
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite", help="Delete the output of another job in the folder."
        ),
    ] = False
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Estimate time and cost, then stop.")
    ] = False
    price_per_core_hour: Annotated[
        float | None, typer.Option(metavar="X", help="Price for --dry-run.")
    ] = None
    workers: Annotated[
        int | None, typer.Option(help="Number of processes; by default one per core.")
    ] = None
    threads: Annotated[
        int | None,
        typer.Option(help="Threads per worker; by default cores / workers."),
    ] = None
    engine: Annotated[
        Literal["native", "gl"],
        typer.Option(
            help="native: CPU, with the same results on all machines; gl: GPU, with "
            "one worker by default."
        ),
    ] = "native"
    ray: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Ray cluster that shares INPUT and OUT: auto, an address, or local; "
            "requires the extra batch-ray.",
        ),
    ] = None


def batch_of(options: BatchOptions) -> Batch:
    """Return the batch that the command line describes.

    Raises
    ------
    ValueError
        If an option is invalid.  The message names the option, the value and the range.
    """
    _check(options)
    layout, frames = list_frames(
        options.source,
        options.layout,
        options.depth,
        optics_of(options.fov_deg, options.intrinsics),
        options.depth_scale,
    )
    frames = frames[: options.limit]
    if options.fps is not None:
        frames = [replace(frame, time_s=None) for frame in frames]
    states = _states(options, [frame.name for frame in frames])
    job = Job(
        profiles=read_profiles(options.profile),
        settings=batch_settings(read_object("--settings", options.settings), states),
        states=states,
        format=options.format,
        half=options.half,
        engine=options.engine,
        render_tolerance=options.render_tolerance,
        rate_hz=_rate_hz(options, frames),
    )
    return Batch(job, layout, options.source, frames, options.out)


def workers_and_threads(options: BatchOptions) -> tuple[int, int]:
    """Return the number of processes, and of threads in each.

    One process per core filters more frames than one process with as many threads
    (`ocufilter bench batch`), because all work on a frame, including the serial parts,
    then overlaps with work on other frames.
    """
    n_cores = thread_count()
    n_workers = options.workers or (1 if options.engine == "gl" else n_cores)
    return n_workers, options.threads or max(1, n_cores // n_workers)


def _check(options: BatchOptions) -> None:
    limits: Mapping[str, tuple[float, float]] = {
        "pupil_mm": (MIN_PUPIL_MM, MAX_PUPIL_MM),
        "render_tolerance": (0.0, MAX_RENDER_TOLERANCE),
        "limit": (1, float("inf")),
        "fps": FPS_LIMITS_HZ,
        "workers": (1, 1024),
        "threads": (1, 256),
        "price_per_core_hour": (0.0, float("inf")),
        "depth_scale": (1e-9, 1e9),
    }
    for name, (low, high) in limits.items():
        value = getattr(options, name)
        if value is not None:
            check_range(f"--{name.replace('_', '-')}", value, (low, high))
    if options.format in VIDEO_FORMATS:
        import clients.batch.video_writing  # noqa: F401  (raises if it is not installed)
    if options.half and options.format not in LINEAR_FORMATS:
        raise ValueError("--half: allowed with --format npy or exr")
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"--out '{options.out}' is a file; allowed: a folder")


def _states(options: BatchOptions, names: Sequence[str]) -> States:
    focus_dpt: float | None = None
    if options.focus_dpt != CENTER:
        focus_dpt = number_or_nan(options.focus_dpt)
        if not 0.0 <= focus_dpt <= MAX_VERGENCE_DPT:
            hint = f"; allowed: 0 to {MAX_VERGENCE_DPT:g}"
            if math.isnan(focus_dpt):
                hint = likely_number(options.focus_dpt)
            raise ValueError(
                f"--focus-dpt is '{options.focus_dpt:.60}'{hint}, or {CENTER}"
            )
    listed = None
    if options.states is not None:
        if not options.states.is_file():
            raise ValueError(f"--states '{options.states}': no such file")
        listed = read_states(options.states, names)
    states = States(options.pupil_mm, focus_dpt, listed)
    states.check(names)
    return states


def read_profiles(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return profiles by the names of their folders.

    Raises
    ------
    ValueError
        If a profile is invalid or two have the same name.
    """
    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        name, _, what = text.rpartition("=")
        body = profile_body(what)
        load_profile(what)  # raises if the profile is invalid
        name = folder_name(name) or profile_name(what, body)
        if not name or name in found:
            raise ValueError(
                f"--profile '{text}': the name '{name}' is empty or already used; "
                "allowed: NAME=PROFILE with another name"
            )
        found[name] = body
    return found


def _rate_hz(options: BatchOptions, frames: Sequence[SourceFrame]) -> float:
    if options.fps is not None:
        return float(options.fps)
    if frames[0].color_index is None:
        return 30.0
    from clients.batch.video_reading import frames_per_second

    rate_hz = frames_per_second(frames[0].color)
    low_hz, high_hz = FPS_LIMITS_HZ
    if not low_hz <= rate_hz <= high_hz:
        allowed = f"{low_hz:g} to {high_hz:g}, or --fps"
        raise InvalidFile(frames[0].color, f"{rate_hz:g} frames per second", allowed)
    return rate_hz
