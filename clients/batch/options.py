"""Command line of `ocufilter batch`, parsed and checked."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from clients.arguments import read_object
from clients.batch.job import (
    FORMATS,
    LINEAR_FORMATS,
    VIDEO_FORMATS,
    Job,
    batch_settings,
)
from clients.batch.layouts import LAYOUTS, LayoutOptions, list_frames, optics_of
from clients.batch.run import Batch
from clients.batch.source import SourceFrame
from clients.batch.states import CENTER, States, read_states
from clients.option_values import a_number, check_range, likely_number
from estimator import InvalidFile, load_profile, profile_body, thread_count
from filter_service.settings import (
    MAX_PUPIL_MM,
    MAX_RENDER_TOLERANCE,
    MAX_VERGENCE_DPT,
    MIN_PUPIL_MM,
)

DESCRIPTION = """\
Filter folders and videos of color and depth on all cores, each frame through each
profile.  Run the same command again to continue an interrupted batch.

  ocufilter batch rgbd_dataset_freiburg1_desk -p myopia -p keratoconus -o seen
  ocufilter batch room/ -p me.json --fov-deg 50 --focus-dpt center -o room_seen
  ocufilter batch walk.mp4 --depth walk_depth.mkv --fov-deg 60 -p myopia \\
      --format h264 -o walk_seen
"""

LAYOUT_HELP = """\
layouts, detected from the content of the folder:
  tum         TUM RGB-D: rgb/, depth/ and their lists; depth / 5000, driver's camera
  nyu         NYU depth v2: N_colors.png with N_depth.png, rgb_N.jpg with
              sync_depth_N.png (mm), or raw dumps r-*.ppm with d-*.pgm
  middlebury  im0.png, disp0.pfm, calib.txt of one scene or of a folder of scenes
  pairs       color/ and depth/, or NAME_color with NAME_depth; depth as 16-bit PNG,
              float TIFF, NPY, EXR or PFM; requires --fov-deg or --intrinsics
  video       a color video, with depth as a 16-bit gray video or a folder of images

results: OUT/PROFILE/FRAME.png or OUT/PROFILE.mkv; a line for each frame in
OUT/manifest.jsonl, and a summary in OUT/manifest.json.  Exit codes: 0 success, 1 some
frames failed, 2 invalid input.
"""

FPS_LIMITS_HZ = (0.1, 1000.0)
_NAME = re.compile(r"[^\w.+-]+")


def arguments_of(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the parsed command line."""
    parser = argparse.ArgumentParser(
        prog="ocufilter batch",
        description=DESCRIPTION,
        epilog=LAYOUT_HELP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("input", type=Path, metavar="INPUT", help="folder or video")
    parser.add_argument(
        *("-o", "--out"), type=Path, required=True, metavar="DIR", help="output folder"
    )
    parser.add_argument(
        *("-p", "--profile"),
        action="append",
        required=True,
        metavar="P",
        help="preset name, a .json, .abp, .csv or .zmx file, or JSON; repeatable; "
        "NAME=P sets the name of its folder",
    )
    _add_source(parser.add_argument_group("input"))
    _add_eye(parser.add_argument_group("eye and filter"))
    _add_results(parser.add_argument_group("output"))
    _add_machines(parser.add_argument_group("workers"))
    return parser.parse_args(argv)


def _add_source(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--layout", default="auto", choices=LAYOUTS, help="default: detected"
    )
    group.add_argument(
        "--depth", type=Path, metavar="PATH", help="folder or video of depth"
    )
    group.add_argument(
        "--depth-scale", type=a_number, metavar="M", help="meters per unit of depth"
    )
    group.add_argument("--fov-deg", type=a_number, help="vertical field of view, deg")
    group.add_argument("--intrinsics", metavar="FX,FY,CX,CY", help="camera in px")
    group.add_argument(
        "--limit", type=int, metavar="N", help="use the first N frames only"
    )


def _add_eye(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--pupil-mm",
        type=a_number,
        default=4.0,
        help="entrance pupil, mm (default: 4)",
    )
    group.add_argument(
        "--focus-dpt",
        default="0",
        metavar="DPT|center",
        help="focus distance, or the depth at the center of each frame (default: 0, "
        "infinity)",
    )
    group.add_argument(
        "--states",
        type=Path,
        metavar="CSV",
        help="a line for each frame, with the columns frame, pupil_mm and focus_dpt",
    )
    group.add_argument(
        "--settings",
        default="{}",
        metavar="JSON",
        help='settings such as {"mode": "quality", "object_range_dpt": [0, 5]}',
    )
    group.add_argument(
        "--render-tolerance",
        type=a_number,
        default=1.0,
        help="rendering error relative to the default; 0 is exact (default: 1)",
    )


def _add_results(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--format",
        default="png",
        choices=FORMATS,
        help="png: sRGB; npy, exr: linear light; ffv1: lossless video; h264: video",
    )
    group.add_argument(
        "--half", action="store_true", help="write half floats to npy or exr"
    )
    group.add_argument(
        "--fps",
        type=a_number,
        help="frame rate of videos (default: the times of the input video, or 30)",
    )
    group.add_argument(
        "--overwrite",
        action="store_true",
        help="delete the output of another job in the folder",
    )
    group.add_argument(
        "--dry-run",
        action="store_true",
        help="estimate time and cost, and stop",
    )
    group.add_argument(
        "--price-per-core-hour",
        type=a_number,
        metavar="X",
        help="price for --dry-run",
    )
    group.add_argument("--json", action="store_true", help="print one JSON object")


def _add_machines(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--workers", type=int, help="number of processes (default: one per core)"
    )
    group.add_argument(
        "--threads", type=int, help="threads per worker (default: cores / workers)"
    )
    group.add_argument(
        "--engine",
        default="native",
        choices=("native", "gl"),
        help="native: CPU, with the same results on all machines; gl: GPU, with one "
        "worker by default",
    )
    group.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="use a Ray cluster that shares INPUT and OUT: auto, an address, or local "
        "(requires the extra batch-ray)",
    )


def batch_of(options: argparse.Namespace) -> Batch:
    """Return the batch that the command line describes.

    Raises
    ------
    ValueError
        If an option is invalid.  The message names the option, the value and the range.
    """
    _check(options)
    layout_options = LayoutOptions(
        options.depth,
        optics_of(options.fov_deg, options.intrinsics),
        options.depth_scale,
    )
    layout, frames = list_frames(options.input, options.layout, layout_options)
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
    return Batch(job, layout, options.input, frames, options.out)


def workers_and_threads(options: argparse.Namespace) -> tuple[int, int]:
    """Return the number of processes, and of threads in each.

    One process per core filters more frames than one process with as many threads
    (`ocufilter bench batch`), because all work on a frame, including the serial parts,
    then overlaps with work on other frames.
    """
    n_cores = thread_count()
    n_workers = options.workers or (1 if options.engine == "gl" else n_cores)
    return n_workers, options.threads or max(1, n_cores // n_workers)


def _check(options: argparse.Namespace) -> None:
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


def _states(options: argparse.Namespace, names: Sequence[str]) -> States:
    focus_dpt: float | None = None
    if options.focus_dpt != CENTER:
        try:
            focus_dpt = float(options.focus_dpt)
        except ValueError:
            focus_dpt = float("nan")
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
        if what.lstrip().startswith("{"):  # JSON
            own_name = str(body.get("name", "profile"))
        else:
            own_name = what if body.get("kind") == "preset" else Path(what).stem
        name = name or own_name
        name = _NAME.sub("_", name).lstrip(".")
        if not name or name in found:
            raise ValueError(
                f"--profile '{text}': the name '{name}' is empty or already used; "
                "allowed: NAME=PROFILE with another name"
            )
        found[name] = body
    return found


def _rate_hz(options: argparse.Namespace, frames: Sequence[SourceFrame]) -> float:
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
