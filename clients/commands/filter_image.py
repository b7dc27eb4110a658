"""`ocufilter filter`: filter one RGB-D image through one eye, without a service."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from clients.commands.options import with_setting_options
from clients.provenance import (
    code_version,
    picture_metadata,
    profile_identity,
    profile_name,
)
from filter_service.camera import read_intrinsics
from filter_service.command_line import (
    Json,
    check_range,
    print_json,
    print_line,
    progress_bar,
)
from filter_service.settings import (
    MAX_PUPIL_MM,
    MAX_RENDER_TOLERANCE,
    MAX_VERGENCE_DPT,
    MIN_PUPIL_MM,
    Accumulation,
    DepthKind,
    Engine,
    Output,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from estimator.profiles.parse import EyeProfile
    from filter_service.camera import PixelGrid, Tangents
    from filter_service.filtering.planned_frame import Filtered
    from filter_service.filtering.stream_eyes import EyeEvent
    from filter_service.image_files import ImageFile
    from filter_service.planning.nodes import CachePlan
    from filter_service.rgbd_view import RgbdView
    from filter_service.settings import FilterSettings

PUPIL_LIMITS_MM = (MIN_PUPIL_MM, MAX_PUPIL_MM)
FOCUS_LIMITS_DPT = (0.0, MAX_VERGENCE_DPT)
FOV_LIMITS_DEG = (1.0, 150.0)
FOCAL_LIMITS_PX = (1.0, 1e6)
DISTANCE_LIMITS_M = (1.0 / MAX_VERGENCE_DPT, float("inf"))


Color = Annotated[
    Path,
    typer.Option(
        metavar="IMG",
        help="PNG, JPEG, PPM, .npy (uint8 sRGB or linear floats) or .exr.  "
        "Linear light may be above 1 and below 0.",
    ),
]
Depth = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Depth: floats in meters (.npy, TIFF, .exr, .pfm), or integers in "
        "millimeters or units of --depth-scale (16-bit PNG, .pgm, TIFF, .npy).  "
        "inf is infinity; 0, negative, NaN and 16-bit 65535 are missing.",
    ),
]
DistanceM = Annotated[
    float | None,
    typer.Option(
        help="Distance of the entire image, instead of --depth; inf is infinity."
    ),
]
FovDeg = Annotated[float | None, typer.Option(help="Vertical field of view, deg.")]
FocalPx = Annotated[
    float | None, typer.Option(help="Focal length in px, instead of --fov-deg.")
]
Intrinsics = Annotated[
    str | None,
    typer.Option(
        metavar="FX,FY,CX,CY", help="Camera matrix in px, instead of --fov-deg."
    ),
]
PupilMm = Annotated[float, typer.Option(help="Entrance pupil, mm.")]
FocusDpt = Annotated[float, typer.Option(help="Focus distance, dpt; 0 is infinity.")]
DepthKindOption = Annotated[
    DepthKind,
    typer.Option(help="planar: view-space z; radial: distance from the camera."),
]
DepthScale = Annotated[
    float | None,
    typer.Option(
        help="Meters per unit of the depth file; by default 0.001 for integers."
    ),
]


@with_setting_options()
def filter_image(
    color: Color,
    profile: Annotated[
        str,
        typer.Option(
            metavar="P",
            help="Preset name, a .json, .abp, .csv or .zmx file, or JSON such as "
            '{"kind": "prescription", "sphere_dpt": -2}.',
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Output: .png (sRGB), .npy or .exr (linear floats)."
        ),
    ],
    depth: Depth = None,
    distance_m: DistanceM = None,
    fov_deg: FovDeg = None,
    focal_px: FocalPx = None,
    intrinsics: Intrinsics = None,
    hidden_color: Annotated[
        Path | None,
        typer.Option(
            metavar="IMG",
            help="Color of the surface behind the visible one, in the size and format "
            "of --color.",
        ),
    ] = None,
    hidden_depth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Depth of that surface, as for --depth; 0, negative and NaN mean that "
            "nothing is hidden.",
        ),
    ] = None,
    pupil_mm: PupilMm = 4.0,
    focus_dpt: FocusDpt = 0.0,
    accumulation: Annotated[
        Accumulation,
        typer.Option(help="coverage: conserves light; paper: the published rule."),
    ] = "coverage",
    depth_kind: DepthKindOption = "planar",
    depth_scale: DepthScale = None,
    no_merge: Annotated[
        bool, typer.Option("--no-merge", help="Do not merge similar pixels.")
    ] = False,
    render_tolerance: Annotated[
        float,
        typer.Option(
            help="Rendering error relative to the default, 0 to 8; 0 is exact, slow."
        ),
    ] = 1.0,
    engine: Annotated[
        Engine,
        typer.Option(
            help="gl: shaders; native: compiled C; auto: gl if there is a GPU."
        ),
    ] = "auto",
    half: Annotated[
        bool, typer.Option("--half", help="Write half floats to .npy or .exr.")
    ] = False,
    plan: Annotated[
        bool,
        typer.Option("--plan", help="Print which PSFs would be computed, then stop."),
    ] = False,
    json_output: Json = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Filter one image with depth through one eye, without a service.

    ocufilter filter --color room.png --depth room.npy --fov-deg 50
    --profile myopia --pupil-mm 5 -o blurred.png

    For a photograph without depth, give its distance:

    ocufilter filter --color photo.jpg --distance-m 2 --fov-deg 50
    --profile myopia -o blurred.png
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_one_of({"--depth": depth, "--distance-m": distance_m})
    if distance_m is not None:
        check_range("--distance-m", distance_m, DISTANCE_LIMITS_M)
    check_one_of(
        {"--fov-deg": fov_deg, "--focal-px": focal_px, "--intrinsics": intrinsics}
    )
    check_range("--render-tolerance", render_tolerance, (0.0, MAX_RENDER_TOLERANCE))

    from estimator.profiles.files import load_profile, profile_body
    from filter_service import image_files
    from filter_service.atomic_files import replace_atomically
    from filter_service.rendering.frame import object_range_dpt
    from filter_service.settings import FilterSettings

    image_files.check_output(out)
    output = _output(out, half=half)
    eye = load_profile(profile)
    view, grid, file_notes = read_view(
        color,
        depth,
        distance_m=distance_m,
        tangents_of=partial(image_tangents, fov_deg, focal_px, intrinsics),
        depth_kind=depth_kind,
        depth_scale=depth_scale,
        hidden_paths=(hidden_color, hidden_depth),
    )
    object_dpt = object_range_dpt(view)
    whole = FilterSettings(**settings).covering(
        pupils_mm=(pupil_mm,), foci_dpt=(focus_dpt,), objects_dpt=object_dpt
    )
    if plan:
        print_plan(_planned(eye, view, whole), json_output=json_output)
        return
    started_s = time.perf_counter()
    with (
        progress_bar("preparing", quiet=json_output) as progress,
        ExitStack() as closing,
    ):
        filtered = _filtered(
            closing,
            *(eye, view, whole, engine, progress),
            pupil_diameter_mm=pupil_mm,
            focus_dpt=focus_dpt,
            accumulation=accumulation,
            merge=not no_merge,
            render_tolerance=render_tolerance,
            output=output,
        )
    body = profile_body(profile)
    identity = profile_identity(profile_name(profile, body), body)
    metadata = picture_metadata(
        code_version(),
        identity,
        pupil_diameter_mm=filtered.seen.pupil_diameter_mm,
        focus_dpt=filtered.seen.focus_dpt,
    )
    write = partial(
        image_files.write_image, image=filtered.seen.color, grid=grid, metadata=metadata
    )
    replace_atomically(out, write)
    whole_ms = 1e3 * (time.perf_counter() - started_s)
    summary = _summary(
        filtered,
        whole,
        out=out,
        eye=eye,
        profile_sha256=identity["sha256"],
        view=view,
        object_dpt=object_dpt,
        whole_ms=whole_ms,
        file_notes=file_notes,
    )
    if json_output:
        print_json(summary)
    else:
        _report(summary)


def check_one_of(options: dict[str, object]) -> None:
    """Raise ValueError unless exactly one of several options is given."""
    given = [name for name, value in options.items() if value is not None]
    if len(given) != 1:
        found = " and ".join(given) if given else ", ".join(options)
        problem = "given together" if given else "none is given"
        raise ValueError(f"{found}: {problem}; allowed: one of {', '.join(options)}")


def image_tangents(
    fov_deg: float | None,
    focal_px: float | None,
    intrinsics: str | None,
    grid: "PixelGrid",
) -> "Tangents":
    """Return the tangents of an image's edges, from the one option that was given."""
    if fov_deg is not None:
        check_range("--fov-deg", fov_deg, FOV_LIMITS_DEG)
        return grid.fov_tangents(fov_deg)
    if focal_px is not None:
        check_range("--focal-px", focal_px, FOCAL_LIMITS_PX)
        width_px, height_px = grid.full_width_px, grid.full_height_px
        lens = (
            focal_px / grid.pixel_aspect_ratio,
            focal_px,
            (width_px - 1) / 2.0,
            (height_px - 1) / 2.0,
        )
    else:
        lens = read_intrinsics(intrinsics or "")
    return grid.intrinsics_tangents(*lens)


def _planned(
    eye: "EyeProfile", view: "RgbdView", settings: "FilterSettings"
) -> "CachePlan":
    from filter_service.planning.grid import GridSpec
    from filter_service.planning.plan import unchecked_plan
    from filter_service.psfs.eye_for_spec import eye_for_spec

    spec = GridSpec(view.camera, settings)
    return unchecked_plan(eye_for_spec(eye, spec)[0], spec)


@dataclass(frozen=True)
class _Filtered:
    """A filtered image and how it was computed."""

    seen: "Filtered"
    eye_notes: tuple[str, ...]
    engine: str
    renderer: str
    start_ms: float
    psf_count: int


def _filtered(
    closing: ExitStack,
    eye: "EyeProfile",
    view: "RgbdView",
    settings: "FilterSettings",
    engine: Engine,
    progress: Callable[[float, str], None],
    **options: Any,
) -> _Filtered:
    """Filter a view as one frame of a stream; the eye is estimated in this process."""
    from filter_service.filtering.eye_filter import EyeFilter
    from filter_service.filtering.shared_builder import open_inline_builder
    from filter_service.filtering.stream_eyes import BuildingEye, EyeReady

    def report(event: "EyeEvent") -> None:
        if isinstance(event, BuildingEye):
            progress(event.fraction, event.stage)
        elif isinstance(event, EyeReady):
            progress(1.0, "frame")

    begin_s = time.perf_counter()
    builder = open_inline_builder(closing, engine=engine)
    start_ms = 1e3 * (time.perf_counter() - begin_s)
    eye_filter = closing.enter_context(
        EyeFilter(eye, view.camera, settings, on_event=report, builder=builder)
    )
    seen = eye_filter.filter(view, whole=True, **options)
    store = eye_filter.prepared_stores[-1].store
    return _Filtered(
        seen,
        eye_filter.prepared_stores[-1].notes,
        builder.engine_name,
        builder.engine.name,
        start_ms,
        store.computed_count,
    )


def _output(out: Path, *, half: bool) -> Output:
    """Return the output format for a file name."""
    from filter_service.image_files import LINEAR_SUFFIXES

    linear = out.suffix.lower() in LINEAR_SUFFIXES
    if half and not linear:
        raise ValueError("--half: allowed with .npy and .exr output")
    return ("linear16" if half else "linear") if linear else "srgb8"


def read_view(
    color_path: Path,
    depth_path: Path | None,
    *,
    distance_m: float | None,
    tangents_of: Callable[["PixelGrid"], "Tangents"],
    depth_kind: DepthKind,
    depth_scale: float | None,
    hidden_paths: tuple[Path | None, Path | None] = (None, None),
) -> tuple["RgbdView", "PixelGrid", list[str]]:
    """Return the view, the place of its pixels, and notes on the files."""
    import numpy as np

    from filter_service.image_files import read_color_file, read_depth_file
    from filter_service.rgbd_view import RgbdView

    color = read_color_file(color_path)
    notes = [*color.notes]
    if depth_path is None:
        depth_m = np.full(color.pixels.shape[:2], distance_m, np.float32)
    else:
        depth = read_depth_file(depth_path, depth_scale=depth_scale)
        _check_place("depth", depth_path, depth, color)
        depth_m = depth.pixels
        notes += depth.notes
    hidden_color, hidden_depth_m = _read_hidden(
        *hidden_paths, color=color, depth_scale=depth_scale, notes=notes
    )
    view = RgbdView(
        color=color.pixels,
        depth_m=depth_m,
        tangents=tangents_of(color.grid),
        depth_kind=depth_kind,
        hidden_color=hidden_color,
        hidden_depth_m=hidden_depth_m,
    )
    return view, color.grid, notes


def _read_hidden(
    color_path: Path | None,
    depth_path: Path | None,
    *,
    color: "ImageFile",
    depth_scale: float | None,
    notes: list[str],
) -> tuple["NDArray[Any] | None", "NDArray[Any] | None"]:
    """Return color and depth of the hidden layer, or None for both; add notes."""
    from filter_service.image_files import read_color_file, read_depth_file

    if color_path is None and depth_path is None:
        return None, None
    if color_path is None or depth_path is None:
        missing = "--hidden-color" if color_path is None else "--hidden-depth"
        raise ValueError(f"{missing} is not given; allowed: both files or neither")
    hidden = read_color_file(color_path, option="hidden-color")
    _check_place("hidden-color", color_path, hidden, color)
    if hidden.pixels.dtype != color.pixels.dtype:
        raise ValueError(
            f"--hidden-color '{color_path}': {hidden.pixels.dtype}; "
            f"allowed: {color.pixels.dtype}, as the color image"
        )
    depth = read_depth_file(depth_path, depth_scale=depth_scale, option="hidden-depth")
    _check_place("hidden-depth", depth_path, depth, color)
    notes += [*hidden.notes, *depth.notes]
    return hidden.pixels, depth.pixels


def _check_place(
    option: str, path: Path, image: "ImageFile", color: "ImageFile"
) -> None:
    if (problem := color.grid.difference(image.grid)) is None:
        return
    found, wanted = problem
    text = (
        f"--{option} '{path}': {found}; allowed: the size of the color image, {wanted}"
    )
    if image.pixels.shape[:2] == color.pixels.shape[1::-1]:
        text += " (photographs are rotated upright according to their EXIF data)"
    raise ValueError(text)


def _summary(
    filtered: _Filtered,
    settings: "FilterSettings",
    *,
    out: Path,
    eye: "EyeProfile",
    profile_sha256: str,
    view: "RgbdView",
    object_dpt: tuple[float, float],
    whole_ms: float,
    file_notes: list[str],
) -> dict[str, Any]:
    seen = filtered.seen
    height_px, width_px = seen.color.shape[:2]
    render_ms = sum(seen.stage_times_ms.values())
    return {
        "out": str(out),
        "made_by": code_version(),
        "width_px": width_px,
        "height_px": height_px,
        "profile": eye.name,
        "profile_sha256": profile_sha256,
        "pupil_diameter_mm": seen.pupil_diameter_mm,
        "focus_dpt": seen.focus_dpt,
        **seen.counts,
        "start_ms": filtered.start_ms,
        "build_ms": whole_ms - filtered.start_ms - render_ms,
        "render_ms": render_ms,
        "stage_times_ms": dict(seen.stage_times_ms),
        "psf_count": filtered.psf_count,
        "object_range_dpt": list(object_dpt),
        "depth": _describe_depth(view.depth_m, seen.missing_depth_count),
        "engine": filtered.engine,
        "renderer": filtered.renderer,
        "settings": vars(settings),
        "notes": [*file_notes, *filtered.eye_notes, *seen.notes],
    }


def _describe_depth(depth_m: "NDArray[Any]", missing_count: int) -> str:
    """Return the depth range and the percentage of filled pixels, as text."""
    from filter_service.rgbd_view import MIN_DEPTH_M

    known_m = depth_m[depth_m >= MIN_DEPTH_M]
    if not known_m.size:
        return "no depth; infinity is assumed"
    low, high = (
        f"{value_m:.3g} m" if value_m < float("inf") else "infinity"
        for value_m in (known_m.min(), known_m.max())
    )
    text = f"depth {low} to {high}" if low != high else f"depth {low}"
    if not missing_count:
        return text
    share = 100.0 * missing_count / depth_m.size
    return f"{text}, {share:.2g} % missing, filled from neighbors"


def _report(summary: dict[str, Any]) -> None:
    for note in summary["notes"]:
        print_line(f"note: {note}")
    if count := summary["clamped_depth_count"]:
        print_line(
            f"note: {count} pixels are nearer or farther than the prepared distances"
        )
    print_line(summary["depth"])
    settings = summary["settings"]
    ranges = ", ".join(
        f"{name} {settings[key][0]:g} to {settings[key][1]:.3g} {unit}"
        for name, key, unit in (
            ("pupil", "pupil_range_mm", "mm"),
            ("focus", "focus_range_dpt", "dpt"),
            ("objects", "object_range_dpt", "dpt"),
        )
    )
    print_line(
        f"pipeline {settings['pipeline']}, mode {settings['mode']}, grid "
        f"{settings['grid']}, tolerance {settings['tolerance']}, eye model "
        f"{settings['eye_model']}; {ranges}"
    )
    print_line(
        f"{summary['out']}: {summary['width_px']}x{summary['height_px']} through "
        f"{summary['profile']}, pupil {summary['pupil_diameter_mm']:g} mm, "
        f"focus {round(summary['focus_dpt'], 3) + 0.0:.3g} dpt; "
        f"eye {summary['build_ms']:.0f} ms, frame with {summary['psf_count']} PSFs "
        f"{summary['render_ms']:.0f} ms on {summary['renderer']}"
    )


AXIS_NAMES = {"h": "azimuth", "v": "elevation"}


def plan_summary(plan: "CachePlan") -> dict[str, Any]:
    """Return a plan's nodes and prediction in JSON-compatible types."""
    predicted, defocus = plan.prediction, plan.nodes.defocus
    return {
        "h_deg": plan.h_deg.tolist(),
        "v_deg": plan.v_deg.tolist(),
        "pupils_mm": plan.pupils_mm.tolist(),
        "accommodations_dpt": plan.accommodations_dpt.tolist(),
        "defocus_range_dpt": [
            float(defocus.values_dpt.min()),
            float(defocus.values_dpt.max()),
        ],
        "defocus_counts": [
            int(defocus.counts.min()),
            int(defocus.counts.max()),
        ],
        **vars(predicted),
    }


def print_plan(plan: "CachePlan", *, json_output: bool) -> None:
    """Print a plan as text or as JSON."""
    summary = plan_summary(plan)
    if json_output:
        print_json(summary)
        return
    low_dpt, high_dpt = summary["defocus_range_dpt"]
    fewest, most = summary["defocus_counts"]
    count_text = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    print_line(_axis("azimuths", summary["h_deg"], "deg"))
    print_line(_axis("elevations", summary["v_deg"], "deg"))
    print_line(_axis("pupils", summary["pupils_mm"], "mm"))
    print_line(_axis("accommodations", summary["accommodations_dpt"], "dpt"))
    print_line(f"{count_text} defoci from {low_dpt:.2f} to {high_dpt:.2f} dpt at each")
    parts = ", ".join(
        f"{AXIS_NAMES.get(axis, axis)} {db:.0f}"
        for axis, db in summary["error_db_by_axis"].items()
    )
    print_line(
        f"{summary['psf_count']} PSFs, {summary['memory_mb']:.1f} MB, "
        f"{summary['build_s']:.1f} s on {summary['core_count']} cores; "
        f"interpolation at {summary['interpolation_db']:.0f} dB ({parts})"
    )


def _axis(name: str, values: list[float], unit: str) -> str:
    shown = ", ".join(f"{round(value, 2) + 0.0:g}" for value in values)
    return f"{len(values)} {name}: {shown} {unit}"
