"""`ocufilter best-lens`: the spectacles or contact lens that are best for a scene."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from clients.commands.correct_image import write_linear
from clients.commands.filter_image import (
    DISTANCE_LIMITS_M,
    FOCUS_LIMITS_DPT,
    PUPIL_LIMITS_MM,
    Color,
    Depth,
    DepthKindOption,
    DepthScale,
    FocalPx,
    FovDeg,
    Intrinsics,
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
    from filter_service.correcting import BestLens, LensScene, LensTrial
    from filter_service.rgbd_view import RgbdView

MAX_DISTANCES, MAX_PUPILS = 8, 4
VERTEX_LIMITS_MM, CORRIDOR_LIMITS_MM = (0.0, 25.0), (8.0, 24.0)
GAZE_LIMITS_DEG = (-60.0, 60.0)


@with_setting_options()
def find_best_lens(
    color: Color,
    profile: Annotated[
        str,
        typer.Option(
            metavar="P", help="Eye without the lens: preset name, file, or JSON."
        ),
    ],
    target_eye: Annotated[
        str | None,
        typer.Option(
            metavar="P",
            help="Eye through which the scene should be seen; by default the scene "
            "itself is the target.",
        ),
    ] = None,
    depth: Depth = None,
    distance_m: Annotated[
        list[float] | None,
        typer.Option(
            help="Distance of the entire image, instead of --depth; inf is infinity.  "
            "Given several times, the lens is best for all of them."
        ),
    ] = None,
    weight: Annotated[
        list[float] | None,
        typer.Option(help="Weight of each distance; by default all count alike."),
    ] = None,
    head_gaze_v_deg: Annotated[
        list[float] | None,
        typer.Option(
            help="Direction of each distance relative to the head, upward, through a "
            "progressive lens; by default straight ahead."
        ),
    ] = None,
    fov_deg: FovDeg = None,
    focal_px: FocalPx = None,
    intrinsics: Intrinsics = None,
    pupil_mm: Annotated[
        list[float] | None,
        typer.Option(help="Entrance pupil, mm; several count alike.  [default: 4]"),
    ] = None,
    focus_dpt: Annotated[
        float | None,
        typer.Option(
            help="Focus distance, dpt; by default the eye focuses each distance."
        ),
    ] = None,
    lens: Annotated[
        Literal["spectacles", "contact_lens", "progressive"],
        typer.Option(help="Kind of the lens; the addition is found as well."),
    ] = "spectacles",
    vertex_mm: Annotated[
        float, typer.Option(help="Distance of spectacles from the cornea, mm.")
    ] = 12.0,
    corridor_mm: Annotated[
        float, typer.Option(help="Corridor of a progressive lens, mm.")
    ] = 14.0,
    cylinder: Annotated[
        bool, typer.Option(help="Whether the lens may have a cylinder.")
    ] = True,
    measure: Annotated[
        Literal["luminance", "retina", "sensitivity"],
        typer.Option(
            help="Differences of luminance by contrast sensitivity; of all colors "
            "alike; or of all colors by contrast sensitivity."
        ),
    ] = "luminance",
    max_lenses: Annotated[
        int, typer.Option(min=30, max=1000, help="Most lenses to try.")
    ] = 120,
    seen_before: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write what the eye sees without the lens."
        ),
    ] = None,
    seen_after: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write what it sees with the lens."),
    ] = None,
    depth_kind: DepthKindOption = "planar",
    depth_scale: DepthScale = None,
    json_output: Json = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Find the lens with which an eye sees a scene best.

    ocufilter best-lens --color page.png --distance-m inf --fov-deg 4
    --profile keratoconus --pupil-mm 5

    One lens for far and near, of an eye that does not accommodate:

    ocufilter best-lens --color page.png --distance-m inf --distance-m 0.4 --fov-deg 4
    --profile '{"kind": "prescription", "sphere_dpt": -1, "age_years": 60}'
    """
    pupils_mm = pupil_mm or [4.0]
    distances_m = distance_m or []
    _check_count("--pupil-mm", pupils_mm, MAX_PUPILS)
    _check_count("--distance-m", distances_m, MAX_DISTANCES)
    for option, values, limits in (
        ("--pupil-mm", pupils_mm, PUPIL_LIMITS_MM),
        ("--distance-m", distances_m, DISTANCE_LIMITS_M),
        ("--head-gaze-v-deg", head_gaze_v_deg or [], GAZE_LIMITS_DEG),
        ("--vertex-mm", [vertex_mm], VERTEX_LIMITS_MM),
        ("--corridor-mm", [corridor_mm], CORRIDOR_LIMITS_MM),
        ("--focus-dpt", [] if focus_dpt is None else [focus_dpt], FOCUS_LIMITS_DPT),
    ):
        for value in values:
            check_range(option, value, limits)
    check_one_of({"--depth": depth, "--distance-m": distance_m})
    check_one_of(
        {"--fov-deg": fov_deg, "--focal-px": focal_px, "--intrinsics": intrinsics}
    )
    n_distances = len(distances_m) or 1
    for option, given in (("--weight", weight), ("--head-gaze-v-deg", head_gaze_v_deg)):
        if given is not None and len(given) != n_distances:
            raise ValueError(
                f"{option} is given {len(given)} times; allowed: {n_distances}, as "
                "often as --distance-m"
            )

    from estimator.profiles.files import load_profile
    from filter_service.correcting import best_lens
    from filter_service.correcting.lens_scene import WEIGHT_LIMITS
    from filter_service.filtering.shared_builder import open_inline_builder
    from filter_service.image_files import check_output

    for value in weight or []:
        check_range("--weight", value, WEIGHT_LIMITS)
    outputs = {"seen-before": seen_before, "seen-after": seen_after}
    for option, path in outputs.items():
        if path is not None:
            check_output(path, option=option)
    eye = load_profile(profile)
    target = None if target_eye is None else load_profile(target_eye)
    view, grid, notes = read_view(
        color,
        depth,
        distance_m=distances_m[0] if distances_m else None,
        tangents_of=partial(image_tangents, fov_deg, focal_px, intrinsics),
        depth_kind=depth_kind,
        depth_scale=depth_scale,
    )
    scenes = _scenes(
        view,
        distances_m,
        pupils_mm,
        weights=weight or [1.0] * n_distances,
        gazes_v_deg=head_gaze_v_deg or [0.0] * n_distances,
        focus_dpt=focus_dpt,
    )
    body: dict[str, Any] = {"kind": lens}
    if lens != "contact_lens":
        body["vertex_mm"] = vertex_mm
    if lens == "progressive":
        body["corridor_mm"] = corridor_mm
    with (
        progress_bar("searching", quiet=json_output) as progress,
        ExitStack() as closing,
    ):
        found = best_lens(
            eye,
            scenes,
            lens=body,
            target_eye=target,
            measure=measure,
            has_cylinder=cylinder,
            max_evaluations=max_lenses,
            settings=settings,
            builder=open_inline_builder(closing, engine="native"),
            on_progress=progress,
        )
    for path, image in ((seen_before, found.before), (seen_after, found.after)):
        if path is not None:
            write_linear(path, image, grid)
    notes += found.notes
    if json_output:
        print_json(_summary(found, notes))
    else:
        _report(found, notes)


def _check_count(option: str, values: list[float], most: int) -> None:
    if len(values) > most:
        raise ValueError(f"{option} is given {len(values)} times; allowed: 1 to {most}")


def _scenes(
    view: "RgbdView",
    distances_m: list[float],
    pupils_mm: list[float],
    *,
    weights: list[float],
    gazes_v_deg: list[float],
    focus_dpt: float | None,
) -> list["LensScene"]:
    """Return a scene for each distance and pupil."""
    from dataclasses import replace

    import numpy as np

    from filter_service.correcting import LensScene

    views = [
        replace(view, depth_m=np.full_like(view.depth_m, value_m))
        for value_m in distances_m
    ] or [view]
    return [
        LensScene(
            view=each,
            pupil_diameter_mm=pupil_mm,
            focus_dpt=focus_dpt,
            weight_ratio=weight,
            gaze_deg=(0.0, gaze_v_deg),
        )
        for each, weight, gaze_v_deg in zip(views, weights, gazes_v_deg, strict=True)
        for pupil_mm in pupils_mm
    ]


def _trial(trial: "LensTrial") -> dict[str, float]:
    lens = trial.prescription
    return {
        "sphere_dpt": lens.sphere_dpt,
        "cylinder_dpt": lens.cylinder_dpt,
        "axis_deg": lens.axis_deg,
        "add_dpt": trial.add_dpt,
        "error_db": trial.error_db,
    }


def _summary(found: "BestLens", notes: list[str]) -> dict[str, Any]:
    return {
        "vertex_mm": found.best.prescription.vertex_mm,
        "best": _trial(found.best),
        "rounded": _trial(found.rounded),
        "start": _trial(found.start),
        "correction": found.correction,
        "rounded_correction": found.rounded_correction,
        "error_before_db": found.error_before_db,
        "gain_db": found.gain_db,
        "gain_over_start_db": found.gain_over_start_db,
        "rounding_loss_db": found.rounding_loss_db,
        "trials": [_trial(trial) for trial in found.trials],
        "has_converged": found.has_converged,
        "search_s": found.search_s,
        "notes": notes,
    }


def _text(trial: "LensTrial") -> str:
    from estimator.optics.prescription import format_prescription

    text = format_prescription(trial.prescription)
    return f"{text} add {trial.add_dpt:.2f}" if trial.add_dpt else text


def _report(found: "BestLens", notes: list[str]) -> None:
    for note in notes:
        print_line(f"note: {note}")
    vertex_mm = found.best.prescription.vertex_mm
    place = f"{vertex_mm:g} mm before the cornea" if vertex_mm else "at the cornea"
    print_line(
        f"best lens {_text(found.best)}, {place}: error lower by {found.gain_db:.1f} "
        "dB than without it"
    )
    print_line(
        f"rounded {_text(found.rounded)}: error higher by "
        f"{found.rounding_loss_db:.2f} dB"
    )
    print_line(
        f"highest visual Strehl ratio {_text(found.start)}: error higher by "
        f"{found.gain_over_start_db:.2f} dB"
    )
    converged = "" if found.has_converged else ", not converged"
    print_line(f"{len(found.trials)} lenses, {found.search_s:.1f} s{converged}")
