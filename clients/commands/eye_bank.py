"""`ocufilter bank`: build a bank of prebuilt eyes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from clients.commands.options import read_object, read_size_px
from filter_service.command_line import Json, check_range, print_json, print_line

WORKERS_LIMITS = (1, 1024)
MAX_SAMPLE = 999_999
FOV_LIMITS_DEG = (0.01, 170.0)


def bank(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="New folder, or one to continue.")
    ],
    profile: Annotated[
        list[str],
        typer.Option(
            "--profile",
            "-p",
            metavar="P",
            help="Preset name, a .json, .abp, .csv or .zmx file, or JSON; repeatable.",
        ),
    ],
    fov_deg: Annotated[float, typer.Option(help="Vertical field of view, deg.")],
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Size of the images, px.")
    ] = "256x256",
    people: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Persons drawn from the population for each profile.",
        ),
    ] = None,
    first_person: Annotated[
        int, typer.Option(metavar="K", help="Number of the first drawn person.")
    ] = 0,
    settings: Annotated[
        str,
        typer.Option(
            metavar="JSON",
            help='Settings such as {"pupil_range_mm": [3, 5], "object_planes_dpt": '
            "[0.5]}; narrow ranges make small files.",
        ),
    ] = "{}",
    workers: Annotated[
        int | None, typer.Option(help="Number of processes; by default one per core.")
    ] = None,
    json_output: Json = False,
) -> None:
    """Build a bank: files with all PSFs of many eyes, for one camera.

    Programs that filter each image through another eye then need not estimate it; see
    EyeBank in the Python API.  A build that was interrupted continues when the command
    is repeated.

    ocufilter bank people -p me.json --people 200 --fov-deg 20
    """
    from clients.batch.profiles import drawn_people, read_profiles
    from filter_service import Camera, EyeBank

    check_range("--fov-deg", fov_deg, FOV_LIMITS_DEG)
    check_range("--first-person", first_person, (0, MAX_SAMPLE))
    if people is not None:
        check_range("--people", people, (2, 1000))
    if workers is not None:
        check_range("--workers", workers, WORKERS_LIMITS)
    width_px, height_px = read_size_px(size)
    profiles = read_profiles(profile)
    if people is not None:
        profiles = drawn_people(profiles, people, first_person)
    started_s = time.perf_counter()
    built = EyeBank.build(
        folder,
        list(profiles.values()),
        Camera.from_fov(fov_deg, width_px=width_px, height_px=height_px),
        read_object("--settings", settings),
        workers=workers,
    )
    found = {
        "folder": str(folder),
        "eyes": len(built),
        "size_mb": round(built.size_mb, 3),
        "seconds": round(time.perf_counter() - started_s, 1),
    }
    if json_output:
        print_json(found)
    else:
        print_line(
            f"{folder}: {found['eyes']} eyes, {found['size_mb']:.3g} MB, in "
            f"{found['seconds']:.1f} s"
        )
