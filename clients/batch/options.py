"""Options of `ocufilter batch`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clients.batch.eye_table import COLUMNS
from clients.batch.profiles import MAX_SAMPLE, drawn_people, read_profiles
from clients.batch.work import (
    Format,
)
from estimator import (
    PEOPLE_LIMITS,
    thread_count,
)
from filter_service.command_line import check_range
from filter_service.settings import MAX_RENDER_TOLERANCE

Layout = Literal["auto", "tum", "nyu", "middlebury", "pairs", "video"]
FPS_LIMITS_HZ = (0.1, 1000.0)


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


def workers_and_threads(options: ImageSetOptions) -> tuple[int, int]:
    """Return the number of processes, and of threads in each.

    One process per core filters more frames than one process with as many threads,
    because all work on a frame, including the serial parts, then overlaps with work on
    other frames: 16 and 24 ms per frame of 480x270 on two cores of an AMD EPYC.
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
