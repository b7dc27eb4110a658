"""Options of `ocufilter batch`, and the batch that they describe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clients.batch.eyes import (
    COLUMNS,
    LIMITS,
    MAX_DRAWN,
    SYNTEYES,
    Drawn,
    EyeRow,
    is_table_of_eyes,
    read_eyes,
    settings_of_rows,
    with_rows,
)
from clients.batch.layouts import list_frames, optics_of
from clients.batch.run import Batch
from clients.batch.source import Constant, SourceFrame, States, read_states
from clients.batch.views import Views
from clients.batch.work import (
    FORMATS,
    LINEAR_FORMATS,
    VIDEO_FORMATS,
    Format,
    Job,
    batch_settings,
)
from clients.commands.options import read_object
from clients.commands.state_options import listed_numbers
from clients.provenance import folder_name, profile_name
from estimator import (
    PEOPLE_LIMITS,
    InvalidFile,
    drawn_profiles,
    load_profile,
    parse_profile,
    profile_body,
    thread_count,
)
from filter_service import FilterSettings
from filter_service.command_line import check_range
from filter_service.settings import MAX_RENDER_TOLERANCE

Layout = Literal["auto", "tum", "nyu", "middlebury", "pairs", "video"]
FPS_LIMITS_HZ = (0.1, 1000.0)
MAX_SAMPLE = 999_999
"""Largest number of a drawn person."""


@dataclass(frozen=True, kw_only=True)
class ImageSetOptions:
    """Options of commands that filter sets of images through several eyes."""

    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Output folder.")
    ]
    pupil_mm: Annotated[
        str,
        typer.Option(
            metavar="MM[,MM...]",
            help="Entrance pupil, mm.  With several, each frame is filtered through "
            "each pupil.",
        ),
    ] = "4"
    people: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Filter through N persons drawn from the population for each profile: "
            "the higher orders of prescriptions, and the periphery.",
        ),
    ] = None
    first_person: Annotated[
        int,
        typer.Option(
            metavar="K",
            help="Number of the first drawn person; a number is always the same "
            "person.",
        ),
    ] = 0
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
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite", help="Delete the output of another job in the folder."
        ),
    ] = False
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


@dataclass(frozen=True, kw_only=True)
class BatchOptions(ImageSetOptions):
    """Options of `ocufilter batch`."""

    source: Annotated[
        Path,
        typer.Argument(metavar="INPUT", help="Folder or video."),
    ]
    profile: Annotated[
        list[str] | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="P",
            help="Preset name, a .json, .abp, .csv or .zmx file, or JSON; repeatable.  "
            "NAME=P sets the name of its folder.  Required without --eyes, "
            "--sample-eyes and --bank.",
        ),
    ] = None
    eyes: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Table with one row per image or glob, and the columns image, "
            f"{', '.join(COLUMNS[1:])}; columns and cells may be missing.",
        ),
    ] = None
    sample_eyes: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Filter each image through one of N persons, drawn for each profile "
            "as by --people; without --profile, from SyntEyes.",
        ),
    ] = None
    bank: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Filter each image through one of the eyes of a bank, see "
            "`ocufilter bank`.",
        ),
    ] = None
    seed: Annotated[
        int, typer.Option(metavar="S", help="Seed of --sample-eyes and --bank.")
    ] = 0
    sample_pupil_mm: Annotated[
        str | None,
        typer.Option(
            metavar="LOW,HIGH",
            help="Range from which the pupil of each image is drawn, mm, instead of "
            "--pupil-mm.",
        ),
    ] = None
    sample_focus_dpt: Annotated[
        str | None,
        typer.Option(
            metavar="LOW,HIGH",
            help="Range from which the focus of each image is drawn, dpt, instead of "
            "--focus-dpt.",
        ),
    ] = None
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
    distance_m: Annotated[
        str | None,
        typer.Option(
            metavar="M[,M...]",
            help="Distance of all pixels, m, instead of depth files; inf is infinity.  "
            "With several, each frame is filtered at each distance.",
        ),
    ] = None
    focus_dpt: Annotated[
        str,
        typer.Option(
            metavar="DPT|center[,...]",
            help="Focus distance, dpt, or the depth at the center of each frame; 0 is "
            "infinity.  With several, each frame is filtered at each focus.",
        ),
    ] = "0"
    states: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Table with one row per frame and the columns frame, pupil_mm and "
            "focus_dpt; with profile, each frame has an eye of its own, as by --eyes.",
        ),
    ] = None
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
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Estimate time and cost, then stop.")
    ] = False
    price_per_core_hour: Annotated[
        float | None, typer.Option(metavar="X", help="Price for --dry-run.")
    ] = None
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
    check_options(
        options,
        limit=(1, float("inf")),
        fps=FPS_LIMITS_HZ,
        price_per_core_hour=(0.0, float("inf")),
        depth_scale=(1e-9, 1e9),
        sample_eyes=(1, MAX_DRAWN),
    )
    _check_format(options)
    way = _way_of_eyes(options)
    views = Views.of(options.distance_m, options.pupil_mm, options.focus_dpt)
    rows = _rows_of(options)
    constant = Constant(views.distances_dpt[0]) if views.distances_dpt else None
    if constant is None and rows and all("distance_m" in row.values for row in rows):
        constant = Constant(0.0)  # which each row replaces
    layout, frames = list_frames(
        options.source,
        options.layout,
        options.depth,
        optics_of(options.fov_deg, options.intrinsics),
        options.depth_scale,
        constant,
    )
    if views.count > 1:
        _check_several(options, way)
    common: dict[str, Any] = {
        "format": options.format,
        "half": options.half,
        "engine": options.engine,
        "render_tolerance": options.render_tolerance,
    }
    if way is not None:
        _check_own_eyes(options, way)
        frames, settings, details = _with_own_eyes(options, views, rows, frames)
        states = States(views.pupils_mm[0], views.foci_dpt[0])
        job = Job(profiles={}, settings=settings, states=states, **common)
        frames = frames[: options.limit]
        return Batch(job, layout, options.source, frames, options.out, details)
    frames = frames[: options.limit]
    if options.fps is not None:
        frames = [replace(frame, time_s=None) for frame in frames]
    frames, states = views.of_frames(frames)
    if options.states is not None:
        states = _listed(options.states, states, [frame.name for frame in frames])
    profiles = profiles_of(options, options.profile or ())
    given = read_object("--settings", options.settings)
    job = Job(
        profiles=profiles,
        settings=batch_settings(given, states, views.distances_dpt),
        states=states,
        rate_hz=_rate_hz(options, frames),
        **common,
    )
    return Batch(job, layout, options.source, frames, options.out)


def _way_of_eyes(options: BatchOptions) -> str | None:
    """Return the option that gives each image its own eye, or None.

    Raises
    ------
    ValueError
        If options exclude each other, or none gives an eye.
    """
    ways = [
        f"--{name.replace('_', '-')}"
        for name in ("eyes", "sample_eyes", "bank")
        if getattr(options, name) is not None
    ]
    if options.states is not None:
        if not options.states.is_file():
            raise ValueError(f"--states '{options.states}': no such file")
        ways += ["--states"] if is_table_of_eyes(options.states) else []
    if len(ways) > 1:
        raise ValueError(f"{' and '.join(ways)} are given; allowed: one of them")
    if not ways and not options.profile:
        raise ValueError(
            "--profile is not given; allowed: --profile, --eyes, --sample-eyes or "
            "--bank"
        )
    way = ways[0] if ways else None
    is_drawn = way in ("--sample-eyes", "--bank")
    for name in ("sample_pupil_mm", "sample_focus_dpt"):
        if getattr(options, name) is not None and not is_drawn:
            raise ValueError(
                f"--{name.replace('_', '-')} is given; allowed with --sample-eyes or "
                "--bank"
            )
    return way


def _check_own_eyes(options: BatchOptions, way: str) -> None:
    """Check that other options fit frames that have eyes of their own."""
    excluded = {
        "people": options.people is not None,
        "states": options.states is not None and way != "--states",
        "profile": bool(options.profile) and way == "--bank",
        "settings": options.settings != "{}" and way == "--bank",
    }
    for name, is_given in excluded.items():
        if is_given:
            raise ValueError(f"{way} and --{name} are given; allowed: one of them")
    if options.format in VIDEO_FORMATS:
        allowed = ", ".join(name for name in FORMATS if name not in VIDEO_FORMATS)
        raise ValueError(
            f"--format is {options.format}, with {way}; allowed: {allowed}"
        )


def _rows_of(options: BatchOptions) -> list[EyeRow]:
    """Return the rows of a table of eyes, if there is one."""
    path, name = options.eyes, "eyes"
    if path is None and options.states is not None and is_table_of_eyes(options.states):
        path, name = options.states, "states"
    if path is None:
        return []
    if not path.is_file():
        raise ValueError(f"--{name} '{path}': no such file")
    return read_eyes(path, option=name, named=read_profiles(options.profile or ()))


def _with_own_eyes(
    options: BatchOptions,
    views: Views,
    rows: Sequence[EyeRow],
    frames: Sequence[SourceFrame],
) -> tuple[list[SourceFrame], FilterSettings, dict[str, Any]]:
    """Return frames with their eyes, settings, and what determines the eyes."""
    given = read_object("--settings", options.settings)
    usual = States(views.pupils_mm[0], views.foci_dpt[0])
    distance_dpt = views.distances_dpt[0] if views.distances_dpt else None
    if rows:
        path = options.eyes or options.states
        assert path is not None
        settings = settings_of_rows(given, rows, usual, distance_dpt)
        found = with_rows(
            frames,
            rows,
            usual,
            gaze_deg=settings.gaze_deg,
            path=path,
            source=options.source,
            option="states" if options.eyes is None else "eyes",
        )
        return found, settings, {}
    if distance_dpt is not None and usual.focus_dpt is None:
        usual = replace(usual, focus_dpt=distance_dpt)
    pupils_mm = _drawn_range("--sample-pupil-mm", options.sample_pupil_mm, "pupil_mm")
    foci_dpt = _drawn_range("--sample-focus-dpt", options.sample_focus_dpt, "focus_dpt")
    if foci_dpt is None and usual.focus_dpt is not None:
        foci_dpt = usual.focus_dpt, usual.focus_dpt
    count = options.sample_eyes or 0
    _check_last_person("--sample-eyes", count, options.first_person)
    drawn = Drawn.of(
        options.bank,
        read_profiles(options.profile or ()) or SYNTEYES,
        count,
        options.first_person,
        seed=options.seed,
        pupil_range_mm=pupils_mm or (usual.pupil_mm, usual.pupil_mm),
        focus_range_dpt=foci_dpt,
    )
    settings = drawn.settings(given, distance_dpt)
    return drawn.of_frames(frames), settings, {"drawn": drawn.described}


def _drawn_range(
    option: str, text: str | None, column: str
) -> tuple[float, float] | None:
    if text is None:
        return None
    values = listed_numbers(option, text, LIMITS[column])
    if len(values) != 2 or values[0] > values[1]:
        raise ValueError(f"{option} is '{text:.60}'; allowed: LOW,HIGH")
    return values[0], values[1]


def workers_and_threads(options: ImageSetOptions) -> tuple[int, int]:
    """Return the number of processes, and of threads in each.

    One process per core filters more frames than one process with as many threads
    (`ocufilter bench batch`), because all work on a frame, including the serial parts,
    then overlaps with work on other frames.
    """
    n_cores = thread_count()
    n_workers = options.workers or (1 if options.engine == "gl" else n_cores)
    return n_workers, options.threads or max(1, n_cores // n_workers)


def check_options(options: ImageSetOptions, **limits: tuple[float, float]) -> None:
    """Check the numbers of options, and that the output is not a file.

    Parameters
    ----------
    **limits
        Limits of options besides those of `ImageSetOptions`.

    Raises
    ------
    ValueError
        If a number is out of range.  The message names the option.
    """
    limits = {
        "people": PEOPLE_LIMITS,
        "first_person": (0, MAX_SAMPLE),
        "render_tolerance": (0.0, MAX_RENDER_TOLERANCE),
        "workers": (1, 1024),
        "threads": (1, 256),
        **limits,
    }
    for name, (low, high) in limits.items():
        value = getattr(options, name)
        if value is not None:
            check_range(f"--{name.replace('_', '-')}", value, (low, high))
    if options.out.exists() and not options.out.is_dir():
        raise ValueError(f"--out '{options.out}' is a file; allowed: a folder")


def _check_format(options: BatchOptions) -> None:
    if options.format in VIDEO_FORMATS:
        import clients.batch.video_writing  # noqa: F401  (raises if it is not installed)
    if options.half and options.format not in LINEAR_FORMATS:
        raise ValueError("--half: allowed with --format npy or exr")


def _check_several(options: BatchOptions, way: str | None) -> None:
    """Check that frames may be filtered in several states."""
    several = "several distances, pupils or foci"
    if way not in (None, "--states"):
        raise ValueError(f"{way} and {several} are given; allowed: one of them")
    if options.states is not None:
        raise ValueError(f"--states and {several} are given; allowed: one of them")
    if options.format in VIDEO_FORMATS:
        allowed = ", ".join(name for name in FORMATS if name not in VIDEO_FORMATS)
        raise ValueError(
            f"--format is {options.format}, with {several}; allowed: {allowed}"
        )


def _listed(path: Path, states: States, names: Sequence[str]) -> States:
    """Return states with the values of a table."""
    states = replace(states, listed=read_states(path, names))
    states.check(names)
    return states


def profiles_of(
    options: ImageSetOptions, texts: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Return profiles by the names of their folders, with drawn persons if asked for.

    Raises
    ------
    ValueError
        As `read_profiles` and `drawn_people`.
    """
    profiles = read_profiles(texts)
    if options.people is None:
        return profiles
    return drawn_people(profiles, options.people, options.first_person)


def _check_last_person(option: str, count: int, first: int) -> None:
    if first + count - 1 > MAX_SAMPLE:
        raise ValueError(
            f"--first-person is {first} with {option} {count}; allowed: up to "
            f"{MAX_SAMPLE - count + 1}"
        )


def drawn_people(
    profiles: Mapping[str, Mapping[str, Any]], count: int, first: int
) -> dict[str, dict[str, Any]]:
    """Return profiles of persons drawn from the population, ``count`` for each profile.

    Their names end in their numbers, from ``first`` on.

    Raises
    ------
    ValueError
        If persons with a profile do not differ.
    """
    _check_last_person("--people", count, first)
    last = first + count - 1
    digits = len(str(last))
    found: dict[str, dict[str, Any]] = {}
    for name, body in profiles.items():
        drawn_profiles(parse_profile(body), count)  # raises if they do not differ
        for number in range(first, last + 1):
            found[f"{name}_{number:0{digits}d}"] = {**body, "sample": number}
    clash = found.keys() & profiles.keys()
    if clash or len(found) < count * len(profiles):
        raise ValueError(
            f"--people: names of profiles such as '{min(clash or found)}' are not "
            "unique; allowed: NAME=PROFILE with other names"
        )
    return found


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
