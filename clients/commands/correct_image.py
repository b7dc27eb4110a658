"""`ocufilter correct`: solve for the picture that a viewer sees as it was meant."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from clients.commands.filter_image import (
    DISTANCE_LIMITS_M,
    FOCUS_LIMITS_DPT,
    PUPIL_LIMITS_MM,
    Color,
    Depth,
    DepthKindOption,
    DepthScale,
    DistanceM,
    FocalPx,
    FocusDpt,
    FovDeg,
    Intrinsics,
    PupilMm,
    check_one_of,
    image_tangents,
    read_view,
)
from clients.commands.options import with_setting_options
from filter_service.command_line import (
    Json,
    check_range,
    print_json,
    print_line,
    progress_bar,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from filter_service.camera import PixelGrid
    from filter_service.correcting import Correction


@with_setting_options()
def correct_image(
    color: Color,
    viewer: Annotated[
        list[str],
        typer.Option(
            metavar="P",
            help="Eye of the viewer: preset name, file, or JSON.  Given twice, both "
            "eyes look at the same picture.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Picture: .png (sRGB), .npy or .exr (linear floats)."
        ),
    ],
    target_eye: Annotated[
        str | None,
        typer.Option(
            metavar="P",
            help="Eye through which the viewer should see the scene; by default the "
            "viewer should see the scene itself.",
        ),
    ] = None,
    depth: Depth = None,
    distance_m: DistanceM = None,
    display_distance_m: Annotated[
        float | None,
        typer.Option(
            help="Distance of the display from the viewer, m; by default the picture "
            "is displayed at the depth of the scene."
        ),
    ] = None,
    fov_deg: FovDeg = None,
    focal_px: FocalPx = None,
    intrinsics: Intrinsics = None,
    pupil_mm: PupilMm = 4.0,
    focus_dpt: FocusDpt = 0.0,
    pupil_range_mm: Annotated[
        float,
        typer.Option(help="Also solve for pupils this much smaller and larger, mm."),
    ] = 0.0,
    focus_range_dpt: Annotated[
        float,
        typer.Option(help="Also solve for foci this much farther and nearer, dpt."),
    ] = 0.0,
    contrast: Annotated[
        float,
        typer.Option(
            help="Contrast of the target, 0.01 to 1.  A display cannot go below black: "
            "less contrast leaves room for the correction."
        ),
    ] = 1.0,
    brightness: Annotated[
        float | None,
        typer.Option(
            help="Mean of the target, linear light, 0 to 1; by default that of the "
            "scene."
        ),
    ] = None,
    metric: Annotated[
        Literal["retina", "sensitivity"],
        typer.Option(
            help="Differences on the retina count alike, or by contrast sensitivity."
        ),
    ] = "retina",
    solve_tolerance: Annotated[
        float,
        typer.Option(help="Remaining error at which the solution stops, 0 to 1."),
    ] = 0.01,
    max_iterations: Annotated[
        int, typer.Option(min=1, max=100_000, help="Largest number of iterations.")
    ] = 200,
    seen_before: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write what the viewer sees without correction."
        ),
    ] = None,
    seen_after: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write what the viewer sees with it."),
    ] = None,
    depth_kind: DepthKindOption = "planar",
    depth_scale: DepthScale = None,
    json_output: Json = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Solve for the picture that a viewer sees as it was meant, without glasses.

    ocufilter correct --color page.png --distance-m inf --fov-deg 4
    --viewer myopia --contrast 0.5 -o corrected.png

    With a second eye, the viewer sees the scene as that eye does:

    ocufilter correct --color photo.jpg --distance-m inf --fov-deg 20
    --viewer '{"kind": "prescription", "sphere_dpt": -1}' --target-eye keratoconus
    -o corrected.png
    """
    from filter_service.correcting.correction import (
        BRIGHTNESS_LIMITS,
        CONTRAST_LIMITS,
        RANGE_LIMITS,
    )
    from filter_service.correcting.solver import TOLERANCE_LIMITS

    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_range("--pupil-range-mm", pupil_range_mm, RANGE_LIMITS)
    for value_mm in (pupil_mm - pupil_range_mm, pupil_mm + pupil_range_mm):
        check_range("--pupil-mm with --pupil-range-mm", value_mm, PUPIL_LIMITS_MM)
    check_range("--focus-range-dpt", focus_range_dpt, RANGE_LIMITS)
    check_range("--contrast", contrast, CONTRAST_LIMITS)
    check_range("--solve-tolerance", solve_tolerance, TOLERANCE_LIMITS)
    if brightness is not None:
        check_range("--brightness", brightness, BRIGHTNESS_LIMITS)
    check_one_of({"--depth": depth, "--distance-m": distance_m})
    for option, value_m in (
        ("--distance-m", distance_m),
        ("--display-distance-m", display_distance_m),
    ):
        if value_m is not None:
            check_range(option, value_m, DISTANCE_LIMITS_M)
    check_one_of(
        {"--fov-deg": fov_deg, "--focal-px": focal_px, "--intrinsics": intrinsics}
    )
    if len(viewer) > 2:
        raise ValueError(f"--viewer is given {len(viewer)} times; allowed: 1 or 2")

    from estimator.profiles.files import load_profile
    from filter_service.correcting import correct
    from filter_service.filtering.shared_builder import open_inline_builder
    from filter_service.image_files import check_output

    outputs = {"out": out, "seen-before": seen_before, "seen-after": seen_after}
    for option, path in outputs.items():
        if path is not None:
            check_output(path, option=option)
    eyes = [load_profile(text) for text in viewer]
    target = None if target_eye is None else load_profile(target_eye)
    view, grid, notes = read_view(
        color,
        depth,
        distance_m=distance_m,
        tangents_of=partial(image_tangents, fov_deg, focal_px, intrinsics),
        depth_kind=depth_kind,
        depth_scale=depth_scale,
    )
    with (
        progress_bar("correcting", quiet=json_output) as progress,
        ExitStack() as closing,
    ):
        found = correct(
            view,
            eyes,
            pupil_diameter_mm=pupil_mm,
            focus_dpt=focus_dpt,
            target_eye=target,
            display_distance_m=display_distance_m,
            contrast=contrast,
            brightness=brightness,
            metric=metric,
            pupil_range_mm=pupil_range_mm,
            focus_range_dpt=focus_range_dpt,
            tolerance=solve_tolerance,
            max_iterations=max_iterations,
            settings=settings,
            builder=open_inline_builder(closing, engine="native"),
            on_progress=progress,
        )
    for path, image in (
        (out, found.color),
        (seen_before, found.before),
        (seen_after, found.after),
    ):
        if path is not None:
            write_linear(path, image, grid)
    summary = _summary(found, out, [*notes, *found.notes])
    if json_output:
        print_json(summary)
    else:
        _report(summary)


def write_linear(path: Path, linear: "NDArray[Any]", grid: "PixelGrid") -> None:
    """Write linear light, as 8-bit sRGB to a PNG file."""
    from filter_service.atomic_files import replace_atomically
    from filter_service.color_encoding import srgb8_of
    from filter_service.image_files import LINEAR_SUFFIXES, write_image

    is_linear = path.suffix.lower() in LINEAR_SUFFIXES
    image = linear if is_linear else srgb8_of(linear)
    replace_atomically(path, lambda part: write_image(part, image, grid=grid))


def _summary(found: "Correction", out: Path, notes: list[str]) -> dict[str, Any]:
    height_px, width_px = found.color.shape[:2]
    return {
        "out": str(out),
        "width_px": width_px,
        "height_px": height_px,
        "psnr_before_db": found.psnr_before_db,
        "psnr_after_db": found.psnr_after_db,
        "contrast_given_up_ratio": found.contrast_given_up_ratio,
        "seen_before_ratio": found.seen_before_ratio,
        "seen_after_ratio": found.seen_after_ratio,
        "iteration_count": found.iteration_count,
        "has_converged": found.has_converged,
        "errors": list(found.errors),
        "lower_bound": found.lower_bound,
        "solve_s": found.solve_s,
        "notes": notes,
    }


def _report(summary: dict[str, Any]) -> None:
    for note in summary["notes"]:
        print_line(f"note: {note}")
    print_line(
        f"PSNR on the retina {summary['psnr_before_db']:.1f} dB before and "
        f"{summary['psnr_after_db']:.1f} dB after correction; "
        f"{summary['iteration_count']} iterations, {summary['solve_s']:.1f} s"
    )
    print_line(
        f"contrast given up in the target: "
        f"{100.0 * summary['contrast_given_up_ratio']:.0f} %; of the contrast meant at "
        f"first, the viewer sees {100.0 * summary['seen_before_ratio']:.0f} % before "
        f"and {100.0 * summary['seen_after_ratio']:.0f} % after correction"
    )
    print_line(f"{summary['out']}: {summary['width_px']}x{summary['height_px']}")
