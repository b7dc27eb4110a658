"""`ocufilter filter`: one RGB-D image through one eye, without a server."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from filter_service.commands.console import (
    Json,
    check_range,
    print_json,
    progress_bar,
    say,
)
from filter_service.commands.plan_text import plan_summary, say_plan
from filter_service.wire.profiles import DEFAULT_ACCURACY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from estimator.profiles import EyeProfile
    from filter_service.commands.one_image import FilteredImage
    from filter_service.rendering.frame import View

PUPIL_LIMITS_MM = (0.5, 9.0)
FOCUS_LIMITS_DPT = (0.0, 20.0)
FOV_LIMITS_DEG = (1.0, 150.0)
GAZE_LIMITS_DEG = (-60.0, 60.0)


class Mode(StrEnum):
    """Which directions have a PSF of their own."""

    ON_AXIS = "on-axis"
    QUALITY = "quality"
    DYNAMIC = "dynamic"


class Grid(StrEnum):
    """Where the PSFs between which others are blended lie."""

    PLANNED = "planned"
    PAPER = "paper"


class Tolerance(StrEnum):
    """What blending between planned PSFs may cost."""

    LOOSE = "loose"
    NORMAL = "normal"
    FINE = "fine"


class Accumulation(StrEnum):
    """How fragments of one pixel add up."""

    COVERAGE = "coverage"
    PAPER = "paper"


class EyeModel(StrEnum):
    """Where the wavefronts come from."""

    TRACED = "traced"
    WAVEFRONT = "wavefront"


class Accuracy(StrEnum):
    """What of a traced eye may come from trained networks."""

    FAST = "fast"
    BALANCED = "balanced"
    EXACT = "exact"


BY_DEFAULT = Accuracy(DEFAULT_ACCURACY)


class DepthKind(StrEnum):
    """What the depth file measures."""

    PLANAR = "planar"
    RADIAL = "radial"


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
    mode: Annotated[
        Mode,
        typer.Option(
            help="on-axis: one direction for the whole image; quality and dynamic: "
            "PSFs that follow the visual field, over a finer and a coarser grid."
        ),
    ] = Mode.ON_AXIS,
    grid: Annotated[
        Grid,
        typer.Option(help="planned: PSFs where this eye needs them; paper: its grid."),
    ] = Grid.PLANNED,
    tolerance: Annotated[
        Tolerance,
        typer.Option(help="Interpolation of a planned grid at about 43, 49 or 55 dB."),
    ] = Tolerance.NORMAL,
    gaze_h_deg: Annotated[
        float, typer.Option(help="Gaze from the image's axis to the right, deg.")
    ] = 0.0,
    gaze_v_deg: Annotated[float, typer.Option(help="The same upwards, deg.")] = 0.0,
    accumulation: Annotated[
        Accumulation,
        typer.Option(help="coverage conserves light; paper is the published rule."),
    ] = Accumulation.COVERAGE,
    eye_model: Annotated[
        EyeModel,
        typer.Option(
            help="wavefront: the measurement by formula, up to its own pupil; traced: "
            "an estimated eye, ray-traced at any pupil and focus."
        ),
    ] = EyeModel.WAVEFRONT,
    accuracy: Annotated[
        Accuracy,
        typer.Option(
            help="Of a traced eye.  fast: networks; balanced: a refined eye, networks "
            "where they save time; exact: everything ray-traced."
        ),
    ] = BY_DEFAULT,
    depth_kind: Annotated[
        DepthKind, typer.Option(help="planar: view-space z; radial: distance.")
    ] = DepthKind.PLANAR,
    depth_scale: Annotated[
        float | None,
        typer.Option(help="Metres per unit of the depth file [integers: 0.001]."),
    ] = None,
    no_diffraction: Annotated[
        bool, typer.Option("--no-diffraction", help="Geometrical optics only.")
    ] = False,
    no_chromatic: Annotated[
        bool, typer.Option("--no-chromatic", help="Focus all colours alike.")
    ] = False,
    lateral_color: Annotated[
        bool,
        typer.Option(
            "--lateral-color",
            help="Displace red and blue against green off the axis; a traced eye only.",
        ),
    ] = False,
    no_merge: Annotated[
        bool, typer.Option("--no-merge", help="Keep every pixel a fragment.")
    ] = False,
    half: Annotated[
        bool, typer.Option("--half", help="Half floats in the .npy or .exr.")
    ] = False,
    plan: Annotated[
        bool,
        typer.Option("--plan", help="Say which PSFs would be computed, and stop."),
    ] = False,
    json_output: Json = False,
) -> None:
    """Filter one image with depth through one eye; no server is needed.

    ocufilter filter --color room.png --depth room.npy --fov-deg 50
    --profile myopia --pupil-mm 5 -o blurred.png
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_range("--fov-deg", fov_deg, FOV_LIMITS_DEG)
    check_range("--gaze-h-deg", gaze_h_deg, GAZE_LIMITS_DEG)
    check_range("--gaze-v-deg", gaze_v_deg, GAZE_LIMITS_DEG)

    from estimator.profile_files import load_profile
    from filter_service.commands import image_files, one_image

    image_files.check_output(out)
    eye = load_profile(profile)
    view = _read_view(
        color,
        depth,
        fov_deg=fov_deg,
        depth_kind=depth_kind.value,
        depth_scale=depth_scale,
        hidden_paths=(hidden_color, hidden_depth),
    )
    linear = out.suffix.lower() in image_files.LINEAR_SUFFIXES
    if half and not linear:
        raise ValueError("--half: allowed with an output of .npy or .exr")
    settings = one_image.ImageSettings(
        pupil_diameter_mm=pupil_mm,
        focus_dpt=focus_dpt,
        accumulation=accumulation.value,
        diffraction=not no_diffraction,
        chromatic=not no_chromatic,
        lateral_color=lateral_color,
        merge=not no_merge,
        output=("linear16" if half else "linear") if linear else "srgb8",
        eye_model=eye_model.value,
        accuracy=accuracy.value,
        mode=mode.value,
        grid=grid.value,
        tolerance=tolerance.value,
        gaze_deg=(gaze_h_deg, gaze_v_deg),
    )
    if plan:
        say_plan(one_image.plan_one_image(view, eye, settings), json_output=json_output)
        return
    with progress_bar("PSFs", quiet=json_output) as progress:
        filtered = one_image.filter_one_image(view, eye, settings, progress=progress)
    image_files.write_image(out, filtered.rendered.color)
    summary = _summary(filtered, out=out, eye=eye)
    if json_output:
        print_json(summary)
    else:
        _report(summary)


def _read_view(
    color_path: Path,
    depth_path: Path,
    *,
    fov_deg: float,
    depth_kind: str,
    depth_scale: float | None,
    hidden_paths: tuple[Path | None, Path | None] = (None, None),
) -> "View":
    from filter_service.commands.image_files import read_color, read_depth
    from filter_service.commands.one_image import symmetric_tangents
    from filter_service.rendering.frame import View

    color = read_color(color_path)
    depth_m = read_depth(depth_path, depth_scale=depth_scale)
    height_px, width_px = color.shape[:2]
    _check_size("depth", depth_path, depth_m, color)
    hidden_color, hidden_depth_m = _read_hidden(
        *hidden_paths, color=color, depth_scale=depth_scale
    )
    tangents = symmetric_tangents(
        width_px=width_px, height_px=height_px, vertical_fov_deg=fov_deg
    )
    return View(
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
    from filter_service.commands.image_files import read_color, read_depth

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
        "object_range_dpt": list(filtered.grid.object_range_dpt),
        "missing_depth_count": int(rendered.missing_depth_count),
        "clamped_depth_count": int(rendered.clamped_depth_count),
        "bad_color_count": int(rendered.bad_color_count),
        "overflow_count": int(rendered.overflow_count),
        "build_ms": filtered.build_ms,
        "start_ms": filtered.start_ms,
        "render_ms": filtered.render_ms,
        "stage_times_ms": dict(rendered.stage_times_ms),
        "gl_renderer": filtered.gl_renderer,
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
        f"focus {summary['focus_dpt']:.3g} dpt; "
        f"PSFs {summary['build_ms']:.0f} ms, start {summary['start_ms']:.0f} ms, "
        f"frame {summary['render_ms']:.0f} ms on {summary['gl_renderer']}"
    )
