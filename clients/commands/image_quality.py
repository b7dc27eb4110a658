"""`ocufilter mtf`, `acuity`, `refraction`, `through-focus`, and lists of `psf`."""

from __future__ import annotations

import csv
import math
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from clients.acuity_text import Notation, acuity_text
from clients.commands.options import with_options
from clients.commands.state_options import (
    EyeNames,
    StateOptions,
    ViewOptions,
    listed_numbers,
    named_eyes,
)
from filter_service.command_line import Json, check_range, print_json, print_line

if TYPE_CHECKING:
    from estimator import LabeledArray

Csv = Annotated[
    bool, typer.Option("--csv", help="Print comma-separated values, one state a line.")
]
Plot = Annotated[Path | None, typer.Option(metavar="OUT.png", help="Plot the curves.")]
WhiteLight = Annotated[
    bool,
    typer.Option(
        "--white-light", help="White light instead of one wavelength; up to 60 cpd."
    ),
]

FREQUENCIES = "0:60:5"
DEFOCUS = "-2:2:0.25"
FREQUENCY_LIMITS_CPD = (0.0, 1000.0)
ORIENTATION_LIMITS_DEG = (-360.0, 360.0)
DEFOCUS_LIMITS_DPT = (-20.0, 20.0)
VERTEX_LIMITS_MM = (0.0, 50.0)

SHOWN_RATIO = 0.99
"""Light that figures of PSFs show at least, of each PSF; the last 1 % is much wider."""


@dataclass(frozen=True)
class MtfOptions(StateOptions):
    """Options of `ocufilter mtf`."""

    frequency_cpd: Annotated[
        str, typer.Option(metavar="LIST", help="Frequencies, cycles per degree.")
    ] = FREQUENCIES
    orientation_deg: Annotated[
        str | None,
        typer.Option(
            metavar="LIST",
            help="Directions in which gratings vary, as in `ocufilter stimuli`: 0 for "
            "vertical bars, 90 for horizontal ones; the mean of all if not given.",
        ),
    ] = None
    white_light: WhiteLight = False
    stiles_crawford: Annotated[
        bool,
        typer.Option("--stiles-crawford", help="Apply the Stiles-Crawford effect."),
    ] = False
    straylight: Annotated[
        bool,
        typer.Option("--straylight", help="Add the light that the media scatter."),
    ] = False


@dataclass(frozen=True)
class ThroughFocusOptions(StateOptions):
    """Options of `ocufilter through-focus`."""

    defocus_dpt: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Vergence added in the pupil, dpt; positive is nearer.",
        ),
    ] = DEFOCUS
    frequency_cpd: Annotated[
        float, typer.Option(help="Frequency of the modulation, cycles per degree.")
    ] = 15.0


@dataclass(frozen=True)
class RefractionOptions(ViewOptions):
    """Options of `ocufilter refraction`."""

    focus_dpt: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="Focus, dpt; relaxed if not given."),
    ] = None
    method: Annotated[
        Literal["least_squares", "visual_strehl"],
        typer.Option(
            help="least_squares: the lens that makes the wavefront flattest; "
            "visual_strehl: the lens with the highest visual Strehl ratio."
        ),
    ] = "least_squares"
    vertex_mm: Annotated[
        float, typer.Option(help="Distance of the lens from the cornea, mm.")
    ] = 0.0


@with_options
def mtf(
    eyes: EyeNames,
    options: MtfOptions,
    as_csv: Csv = False,
    plot: Plot = None,
    json_output: Json = False,
) -> None:
    """Print the modulation transfer function of an eye.

    All combinations of the lists are computed.  A LIST is numbers separated by commas,
    or first:last:step.

    ocufilter mtf emmetropia --pupil-mm 3,4,5 --csv
    """
    orientations = None
    if options.orientation_deg is not None:
        orientations = listed_numbers(
            "--orientation-deg", options.orientation_deg, ORIENTATION_LIMITS_DEG
        )
    arguments = {
        **options.states(),
        "frequency_cpd": listed_numbers(
            "--frequency-cpd", options.frequency_cpd, FREQUENCY_LIMITS_CPD
        ),
        "orientation_deg": orientations,
        "white_light": options.white_light,
        "stiles_crawford": options.stiles_crawford,
        "straylight": options.straylight,
    }
    _check(plot)
    title, found = _of_eyes(eyes, "mtf", arguments)
    report(title, found, as_csv=as_csv, plot=plot, json_output=json_output)


@with_options
def acuity(
    eyes: EyeNames,
    options: StateOptions,
    notation: Annotated[
        Notation | None,
        typer.Option(
            help="Add a column with the acuity as 20/40 (feet), 6/12 (meters), 0.50 "
            "(decimal) or logMAR."
        ),
    ] = None,
    as_csv: Csv = False,
    plot: Plot = None,
    json_output: Json = False,
) -> None:
    """Print visual acuity in white light and the visual Strehl ratio.

    log_mar is the acuity of an observer who reads letters through the optics with the
    nerves of the fovea.  Off the axis, retina_log_mar, the limit by the density of
    retinal cells, may be worse.  The visual Strehl ratio (VSOTF) is that of the
    wavelength.  All combinations of the lists are computed.  A LIST is numbers
    separated by commas, or first:last:step.

    ocufilter acuity myopia --pupil-mm 3,5 --object-dpt 0:6:1
    """
    states = options.states()
    _check(plot)
    title, found = _of_eyes(eyes, "acuity", states)
    report(
        title,
        found,
        as_csv=as_csv,
        plot=plot,
        json_output=json_output,
        notation=notation,
    )


@with_options
def refraction(
    eyes: EyeNames,
    options: RefractionOptions,
    as_csv: Csv = False,
    json_output: Json = False,
) -> None:
    """Print the refraction: the lens that corrects an eye for infinity.

    Sphere, minus cylinder and axis are as the examiner writes them, for a lens at
    --vertex-mm.  M, J0 and J45 are the power vector in that plane, in the eye's frame:
    J45 has the opposite sign in the examiner's.  A correction in the profile is worn:
    the result is what it lacks.  All combinations of the lists are computed.  A LIST is
    numbers separated by commas, or first:last:step.

    ocufilter refraction keratoconus --pupil-mm 3,5
    """
    arguments = {
        **options.states(),
        "method": options.method,
        "vertex_mm": options.vertex_mm,
    }
    check_range("--vertex-mm", options.vertex_mm, VERTEX_LIMITS_MM)
    title, found = _of_eyes(eyes, "refraction", arguments)
    report(title, found, as_csv=as_csv, json_output=json_output)


@with_options
def through_focus(
    eyes: EyeNames,
    options: ThroughFocusOptions,
    as_csv: Csv = False,
    plot: Plot = None,
    json_output: Json = False,
) -> None:
    """Print acuity, visual Strehl ratio and modulation by defocus.

    The defocus is added to the distance --object-dpt.  All combinations of the lists
    are computed, at 0.2 to 0.5 s each.  A LIST is numbers separated by commas, or
    first:last:step.

    ocufilter through-focus emmetropia --pupil-mm 3 --defocus-dpt=-1,0,1
    """
    arguments = {
        **options.states(),
        "defocus_dpt": listed_numbers(
            "--defocus-dpt", options.defocus_dpt, DEFOCUS_LIMITS_DPT
        ),
        "frequency_cpd": listed_numbers(
            "--frequency-cpd", str(options.frequency_cpd), FREQUENCY_LIMITS_CPD
        )[0],
    }
    _check(plot)
    title, found = _of_eyes(eyes, "through_focus", arguments)
    report(title, found, as_csv=as_csv, plot=plot, json_output=json_output)


def _of_eyes(
    texts: list[str], method: str, arguments: dict[str, Any]
) -> tuple[str, LabeledArray]:
    """Return a title, and the result of a method of one or several eyes."""
    from estimator import Eye
    from estimator.image_quality.labeled_array import stacked

    eyes = named_eyes(texts)
    found = {
        name: getattr(Eye(source), method)(**arguments) for name, source in eyes.items()
    }
    if len(found) == 1:
        return next(iter(found.items()))
    return ", ".join(found), stacked("eye", found)


def print_psfs(
    eye: str,
    states: dict[str, Any],
    out: Path | None,
    *,
    pixel_arcmin: float,
    radius_arcmin: float | None,
    stiles_crawford: bool,
    as_csv: bool,
    json_output: bool,
) -> None:
    """Print a line for each PSF; write all of them."""
    import numpy as np

    from estimator import Eye, LabeledArray
    from filter_service.atomic_files import replace_atomically
    from filter_service.image_files import write_image
    from filter_service.psfs.picture import half_light_radius_px

    found = Eye(eye).psf(
        pixel_arcmin=pixel_arcmin,
        radius_arcmin=radius_arcmin,
        stiles_crawford=stiles_crawford,
        **states,
    )
    if out is not None and out.suffix.lower() == ".npy":
        replace_atomically(out, lambda part: write_image(part, found.values))
    elif out is not None:
        shown = found if radius_arcmin is not None else _within_light(found)
        figure = shown.plot()
        replace_atomically(out, lambda part: figure.savefig(part, format="png"))
    kernels = found.values.reshape(-1, *found.shape[-2:])
    facts = [
        (half_light_radius_px(kernel) * pixel_arcmin, float(kernel.max()))
        for kernel in kernels
    ]
    axes = ("y_arcmin", "x_arcmin")
    table = LabeledArray(
        np.array(facts).reshape(*found.shape[:-2], 2),
        (*found.dims[:-2], "quantity"),
        {
            **{name: of for name, of in found.coords.items() if name not in axes},
            "pixel_arcmin": np.array(pixel_arcmin),
            "radius_arcmin": found.coords["x_arcmin"][-1],
            "quantity": np.array(["half_light_radius_arcmin", "peak_ratio"]),
        },
        "psf",
        notes=found.notes,
    )
    report(eye, table, as_csv=as_csv, json_output=json_output)
    if out is not None and not as_csv and not json_output:
        print_line(f"wrote {found.name} [{', '.join(found.dims)}] to {out}")


def _within_light(found: LabeledArray) -> LabeledArray:
    """Return PSFs cropped to the pixels that contain `SHOWN_RATIO` of the light."""
    from filter_service.psfs.picture import light_radius_px

    kernels = found.values.reshape(-1, *found.shape[-2:])
    needed_px = max(light_radius_px(kernel, SHOWN_RATIO) for kernel in kernels)
    middle_px = found.shape[-1] // 2
    radius_px = min(math.ceil(needed_px), middle_px)
    kept = slice(middle_px - radius_px, middle_px + radius_px + 1)
    axes = ("y_arcmin", "x_arcmin")
    return replace(
        found,
        values=found.values[..., kept, kept],
        coords={k: v[kept] if k in axes else v for k, v in found.coords.items()},
    )


def _check(plot: Path | None) -> None:
    from filter_service.image_files import check_output

    if plot is not None:
        check_output(plot, (".png",))


def report(
    eye: str,
    found: LabeledArray,
    *,
    as_csv: bool,
    json_output: bool,
    plot: Path | None = None,
    notation: Notation | None = None,
) -> None:
    """Print an array as a table, CSV or JSON, and write its plot.

    Parameters
    ----------
    notation : {"decimal", "feet", "meters", "log_mar"}, optional
        Notation of ``log_mar`` in a column of its own.
    """
    columns, rows = [*found.columns()], [[*row] for row in found.rows()]
    if notation is not None:
        place = columns.index("log_mar")
        columns.append("acuity")
        for row in rows:
            row.append(_acuity(row[place], notation))
    if plot is not None:
        from filter_service.atomic_files import replace_atomically

        write = partial(found.plot().savefig, dpi=110, format="png")
        replace_atomically(plot, write, is_private=True)
    if json_output:
        named = [dict(zip(columns, map(_finite, row), strict=True)) for row in rows]
        print_json({"eye": eye, "rows": named, "notes": list(found.notes)})
    elif as_csv:
        for note in found.notes:
            print(f"note: {note}", file=sys.stderr)
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
    else:
        _print_table(eye, found, columns, rows)


def _acuity(log_mar: float, notation: Notation) -> str:
    return acuity_text(log_mar, notation) if math.isfinite(log_mar) else ""


def _finite(value: Any) -> Any:
    """Return a value as JSON allows it: None for NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float | int) else str(value)


def _print_table(
    eye: str, found: LabeledArray, columns: list[str], rows: list[list[Any]]
) -> None:
    """Print the columns that vary; the others are in the line before."""
    for note in found.notes:
        print_line(f"note: {note}")
    fixed = [
        f"{name} {_text(values.item())}"
        for name, values in found.coords.items()
        if values.ndim == 0
    ]
    print_line(f"{eye}: {', '.join(fixed)}")
    shown = [
        k
        for k, name in enumerate(columns)
        if name not in found.coords or found.coords[name].ndim
    ]
    texts = [[columns[k] for k in shown]]
    texts += [[_cell(row[k]) for k in shown] for row in rows]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    for line in texts:
        cells = zip(line, widths, strict=True)
        print_line("  ".join(f"{cell:>{width}}" for cell, width in cells))


def _cell(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.4g}"
