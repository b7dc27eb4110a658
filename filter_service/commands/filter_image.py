"""`ocufilter filter`: one RGB-D image through one eye, without a server."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from filter_service.camera import tangents_from_fov
from filter_service.commands.console import (
    Json,
    check_range,
    print_json,
    progress_bar,
    say,
)
from filter_service.commands.plan_text import plan_summary, say_plan
from filter_service.commands.setting_options import with_setting_options
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
    from filter_service.filtering.one_image import FilteredImage
    from filter_service.rgbd_view import RgbdView

PUPIL_LIMITS_MM = (MIN_PUPIL_MM, MAX_PUPIL_MM)
FOCUS_LIMITS_DPT = (0.0, MAX_VERGENCE_DPT)
FOV_LIMITS_DEG = (1.0, 150.0)


@with_setting_options(mode="on-axis", eye_model="wavefront")
def filter_image(
    color: Annotated[
        Path,
        typer.Option(
            metavar="IMG",
            help="PNG, JPEG (sRGB), .npy (uint8 sRGB or float linear) or .exr; linear "
            "light may be above 1 and below 0.",
        ),
    ],
    depth: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Metres: .npy, 32-bit float TIFF, .exr; or a 16-bit PNG with "
            "--depth-scale.  inf is infinity; 0, negative and NaN are missing.",
        ),
    ],
    fov_deg: Annotated[float, typer.Option(help="Vertical field of view, deg.")],
    profile: Annotated[
        str,
        typer.Option(
            metavar="P", help="A preset name, or a .json, .abp or .csv profile."
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help=".png (sRGB), or .npy or .exr (linear floats)."
        ),
    ],
    hidden_color: Annotated[
        Path | None,
        typer.Option(
            metavar="IMG",
            help="What the camera sees hides this; of the size and kind of --color.",
        ),
    ] = None,
    hidden_depth: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Its depth, as --depth; 0, negative and NaN: nothing is hidden here.",
        ),
    ] = None,
    pupil_mm: Annotated[float, typer.Option(help="Entrance pupil, mm.")] = 4.0,
    focus_dpt: Annotated[
        float, typer.Option(help="Focus distance, dpt; 0 is infinity.")
    ] = 0.0,
    accumulation: Annotated[
        Accumulation,
        typer.Option(help="coverage conserves light; paper is the published rule."),
    ] = "coverage",
    depth_kind: Annotated[
        DepthKind, typer.Option(help="planar: view-space z; radial: distance.")
    ] = "planar",
    depth_scale: Annotated[
        float | None,
        typer.Option(help="Metres per unit of the depth file [integers: 0.001]."),
    ] = None,
    no_merge: Annotated[
        bool, typer.Option("--no-merge", help="Keep every pixel a fragment.")
    ] = False,
    render_tolerance: Annotated[
        float,
        typer.Option(help="Errors of rendering against the usual, 0 to 8: 0 is exact."),
    ] = 1.0,
    engine: Annotated[
        Engine,
        typer.Option(
            help="gl: a GPU's shaders; native: compiled loops; auto: gl on a GPU."
        ),
    ] = "auto",
    half: Annotated[
        bool, typer.Option("--half", help="Half floats in the .npy or .exr.")
    ] = False,
    plan: Annotated[
        bool,
        typer.Option("--plan", help="Say which PSFs would be computed, and stop."),
    ] = False,
    json_output: Json = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Filter one image with depth through one eye; no server is needed.

    ocufilter filter --color room.png --depth room.npy --fov-deg 50
    --profile myopia --pupil-mm 5 -o blurred.png
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_range("--fov-deg", fov_deg, FOV_LIMITS_DEG)
    check_range("--render-tolerance", render_tolerance, (0.0, MAX_RENDER_TOLERANCE))

    from estimator.profiles.files import load_profile
    from filter_service import image_files
    from filter_service.filtering import one_image

    image_files.check_output(out)
    output = _output(out, half=half)
    eye = load_profile(profile)
    view = _read_view(
        color,
        depth,
        fov_deg=fov_deg,
        depth_kind=depth_kind,
        depth_scale=depth_scale,
        hidden_paths=(hidden_color, hidden_depth),
    )
    spec = one_image.image_spec(
        view, pupil_diameter_mm=pupil_mm, focus_dpt=focus_dpt, settings=settings
    )
    if plan:
        say_plan(one_image.plan_one_image(spec, eye), json_output=json_output)
        return
    with progress_bar("PSFs", quiet=json_output) as progress:
        filtered = one_image.filter_one_image(
            view,
            eye,
            spec,
            accumulation=accumulation,
            merge=not no_merge,
            render_tolerance=render_tolerance,
            engine=engine,
            output=output,
            progress=progress,
        )
    image_files.write_image(out, filtered.rendered.color)
    summary = _summary(filtered, out=out, eye=eye)
    if json_output:
        print_json(summary)
    else:
        _report(summary)


def _output(out: Path, *, half: bool) -> Output:
    """Light as a file of this name holds it."""
    from filter_service.image_files import LINEAR_SUFFIXES

    linear = out.suffix.lower() in LINEAR_SUFFIXES
    if half and not linear:
        raise ValueError("--half: allowed with an output of .npy or .exr")
    return ("linear16" if half else "linear") if linear else "srgb8"


def _read_view(
    color_path: Path,
    depth_path: Path,
    *,
    fov_deg: float,
    depth_kind: DepthKind,
    depth_scale: float | None,
    hidden_paths: tuple[Path | None, Path | None] = (None, None),
) -> "RgbdView":
    from filter_service.image_files import read_color, read_depth
    from filter_service.rgbd_view import RgbdView

    color = read_color(color_path)
    depth_m = read_depth(depth_path, depth_scale=depth_scale)
    height_px, width_px = color.shape[:2]
    _check_size("depth", depth_path, depth_m, color)
    hidden_color, hidden_depth_m = _read_hidden(
        *hidden_paths, color=color, depth_scale=depth_scale
    )
    tangents = tangents_from_fov(fov_deg, width_px, height_px)
    return RgbdView(
        color=color,
        depth_m=depth_m,
        tangents=tangents,
        depth_kind=depth_kind,
        hidden_color=hidden_color,
        hidden_depth_m=hidden_depth_m,
    )


def _read_hidden(
    color_path: Path | None,
    depth_path: Path | None,
    *,
    color: "NDArray",
    depth_scale: float | None,
) -> tuple["NDArray | None", "NDArray | None"]:
    """Colour and depth of the hidden layer; None for both where there is none."""
    from filter_service.image_files import read_color, read_depth

    if color_path is None and depth_path is None:
        return None, None
    if color_path is None or depth_path is None:
        lacking = "--hidden-color" if color_path is None else "--hidden-depth"
        raise ValueError(f"{lacking}: not given; allowed: both files or neither")
    hidden = read_color(color_path, option="hidden-color")
    _check_size("hidden-color", color_path, hidden, color)
    if hidden.dtype != color.dtype:
        raise ValueError(
            f"--hidden-color '{color_path}': {hidden.dtype}; "
            f"allowed: as the colour image, {color.dtype}"
        )
    depth_m = read_depth(depth_path, depth_scale=depth_scale, option="hidden-depth")
    _check_size("hidden-depth", depth_path, depth_m, color)
    return hidden, depth_m


def _check_size(option: str, path: Path, image: "NDArray", color: "NDArray") -> None:
    if image.shape[:2] != color.shape[:2]:
        raise ValueError(
            f"--{option} '{path}': {image.shape[1]}x{image.shape[0]} px; allowed: "
            f"the size of the colour image, {color.shape[1]}x{color.shape[0]}"
        )


def _summary(filtered: "FilteredImage", *, out: Path, eye: "EyeProfile") -> dict:
    rendered = filtered.rendered
    height_px, width_px = rendered.color.shape[:2]
    return {
        "out": str(out),
        "width_px": width_px,
        "height_px": height_px,
        "profile": eye.name,
        "pupil_diameter_mm": rendered.pupil_diameter_mm,
        "focus_dpt": rendered.focus_dpt,
        "object_range_dpt": list(filtered.spec.object_range_dpt),
        "missing_depth_count": int(rendered.missing_depth_count),
        "clamped_depth_count": int(rendered.clamped_depth_count),
        "bad_color_count": int(rendered.bad_color_count),
        "overflow_count": int(rendered.overflow_count),
        "build_ms": filtered.build_ms,
        "start_ms": filtered.start_ms,
        "render_ms": filtered.render_ms,
        "stage_times_ms": dict(rendered.stage_times_ms),
        "engine": filtered.engine,
        "renderer": filtered.renderer,
        "plan": plan_summary(filtered.plan),
        "notes": [*filtered.eye_notes, *rendered.notes],
    }


def _report(summary: dict) -> None:
    for note in summary["notes"]:
        say(f"note: {note}")
    for kind in ("missing", "clamped"):
        if count := summary[f"{kind}_depth_count"]:
            say(f"note: {count} pixels with {kind} depth")
    say(
        f"{summary['out']}: {summary['width_px']}x{summary['height_px']} through "
        f"{summary['profile']}, pupil {summary['pupil_diameter_mm']:g} mm, "
        f"focus {round(summary['focus_dpt'], 3) + 0.0:.3g} dpt; "
        f"PSFs {summary['build_ms']:.0f} ms, start {summary['start_ms']:.0f} ms, "
        f"frame {summary['render_ms']:.0f} ms on {summary['renderer']}"
    )
