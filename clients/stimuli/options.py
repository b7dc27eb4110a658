"""Options of `ocufilter stimuli`: what is drawn, on which display, and who sees it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from clients.batch.options import ImageSetOptions, check_options
from clients.batch.source import CENTER
from clients.batch.views import Views
from clients.commands.options import read_size_px
from clients.commands.state_options import listed_numbers
from clients.stimuli.display import (
    PIXEL_LIMITS_ARCMIN,
    SCREEN_LIMITS_MM,
    SCREEN_LIMITS_PX,
    WHITE_LIMITS_NIT,
    Display,
)


def _numbers(metavar: str, text: str) -> typer.models.OptionInfo:
    return typer.Option(metavar=f"{metavar}[,...]", help=text)


@dataclass(frozen=True, kw_only=True)
class StimuliOptions(ImageSetOptions):
    """Options of `ocufilter stimuli`."""

    letters: Annotated[
        str | None,
        typer.Option(metavar="CDHKNORSVZ", help="Sloan letters, one picture each."),
    ] = None
    landolt_c: Annotated[
        str | None,
        _numbers("DEG", "Landolt C with gaps in these directions; 0 is right, 90 up."),
    ] = None
    tumbling_e: Annotated[
        str | None, _numbers("DEG", "Tumbling E with bars in these directions.")
    ] = None
    height_arcmin: Annotated[
        str | None, _numbers("ARCMIN", "Heights of letters, C and E.")
    ] = None
    letter_contrast: Annotated[
        str, _numbers("X", "Weber contrast of letters and text; -1 is black.")
    ] = "-1"
    background_light: Annotated[
        float, typer.Option(help="Light around letters and text; 1 is white.")
    ] = 1.0
    grating_cpd: Annotated[
        str | None, _numbers("CPD", "Sinusoidal gratings, cycles per degree.")
    ] = None
    square_cpd: Annotated[
        str | None, _numbers("CPD", "Square-wave gratings, cycles per degree.")
    ] = None
    gabor_cpd: Annotated[str | None, _numbers("CPD", "Gabors, cycles per degree.")] = (
        None
    )
    gabor_sd_arcmin: Annotated[
        float, typer.Option(help="Standard deviation of the envelope of Gabors.")
    ] = 10.0
    edge: Annotated[bool, typer.Option("--edge", help="Straight edges.")] = False
    orientation_deg: Annotated[
        str,
        _numbers(
            "DEG",
            "Directions in which gratings and edges vary: 0 for vertical bars, 90 for "
            "horizontal ones, as in `ocufilter mtf`.",
        ),
    ] = "0"
    phase_deg: Annotated[
        str,
        _numbers(
            "DEG", "Phase of gratings; 0 is the peak of a bright bar in the middle."
        ),
    ] = "0"
    contrast: Annotated[
        str, _numbers("X", "Michelson contrast of gratings, Gabors and edges.")
    ] = "0.5"
    mean_light: Annotated[
        float,
        typer.Option(help="Mean light of gratings, Gabors, edges, noise; 1 is white."),
    ] = 0.5
    text: Annotated[str | None, typer.Option(help="Text to read.")] = None
    x_height_arcmin: Annotated[
        str | None, _numbers("ARCMIN", "Heights of the x of text.")
    ] = None
    font: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Font of text, .ttf or .otf.")
    ] = None
    noise: Annotated[
        str | None, _numbers("SEED", "Noise with a 1/f amplitude spectrum.")
    ] = None
    noise_rms: Annotated[
        float, typer.Option(help="Standard deviation of noise relative to its mean.")
    ] = 0.2
    noise_exponent: Annotated[
        float, typer.Option(help="Exponent of the amplitude spectrum of noise.")
    ] = 1.0
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Size of the pictures, px.")
    ] = "256x256"
    pixel_arcmin: Annotated[
        float | None, typer.Option(help="Visual angle of a pixel, arcmin.")
    ] = None
    screen_width_mm: Annotated[
        float | None,
        typer.Option(help="Width of the screen, from which pixels follow."),
    ] = None
    screen_width_px: Annotated[
        int | None, typer.Option(help="Pixels across the screen.")
    ] = None
    white_nit: Annotated[
        float | None, typer.Option(help="Luminance of white, cd/m2.")
    ] = None
    distance_m: Annotated[
        str | None,
        typer.Option(metavar="M[,M...]", help="Distance of the display; inf is far."),
    ] = None
    profile: Annotated[
        list[str] | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="P",
            help="Eye that sees the stimuli: preset name, file or JSON; repeatable.  "
            "NAME=P sets the name of its folder.",
        ),
    ] = None
    focus_dpt: Annotated[
        str,
        typer.Option(
            metavar="DPT|center[,...]",
            help="Focus distance, dpt; center is that of the display.",
        ),
    ] = CENTER
    render_tolerance: Annotated[
        float,
        typer.Option(
            help="Rendering error relative to that of other commands; 0 is exact, so "
            "that contrasts can be measured; 1 is faster."
        ),
    ] = 0.0
    format: Annotated[
        Literal["png", "npy", "exr"],
        typer.Option(help="png: 8-bit sRGB; npy, exr: linear light."),
    ] = "png"


def check(options: StimuliOptions) -> None:
    """Check the numbers of options that have no other check.

    Raises
    ------
    ValueError
        If one is out of range, or options are missing or contradict each other.
    """
    check_options(
        options,
        pixel_arcmin=PIXEL_LIMITS_ARCMIN,
        screen_width_mm=SCREEN_LIMITS_MM,
        screen_width_px=SCREEN_LIMITS_PX,
        white_nit=WHITE_LIMITS_NIT,
    )
    if (options.screen_width_mm is None) != (options.screen_width_px is None):
        raise ValueError(
            "--screen-width-mm and --screen-width-px: one of them is given; allowed: "
            "both, or --pixel-arcmin"
        )
    if options.screen_width_mm is None and options.pixel_arcmin is None:
        raise ValueError(
            "--pixel-arcmin is not given; allowed: it, or --screen-width-mm, "
            "--screen-width-px and --distance-m"
        )
    if options.distance_m is None:
        for name in ("screen_width_mm", "profile"):
            if getattr(options, name):
                option = name.replace("_", "-")
                raise ValueError(f"--distance-m is not given, but --{option} needs it")
    if not options.profile and options.people is not None:
        raise ValueError("--profile is not given, but --people needs it")


def displays_of(options: StimuliOptions, views: Views) -> dict[float | None, Display]:
    """Return the display at each distance, dpt; None stands for all distances.

    Raises
    ------
    ValueError
        If pixels of the screen have another size than is given.
    """
    size = dict(zip(("width_px", "height_px"), read_size_px(options.size), strict=True))
    if options.screen_width_mm is None:
        assert options.pixel_arcmin is not None
        display = Display(
            **size, pixel_arcmin=options.pixel_arcmin, white_nit=options.white_nit
        )
        return {None: display}
    if 0.0 in views.distances_dpt:
        raise ValueError(
            "--distance-m is inf with --screen-width-mm; allowed: a finite distance, "
            "or --pixel-arcmin"
        )
    assert options.screen_width_px is not None
    return {
        distance_dpt: Display.of_screen(
            **size,
            screen_width_mm=options.screen_width_mm,
            screen_width_px=options.screen_width_px,
            distance_m=1.0 / distance_dpt,
            pixel_arcmin=options.pixel_arcmin,
            white_nit=options.white_nit,
        )
        for distance_dpt in views.distances_dpt
    }


def numbers(name: str, text: str | None) -> tuple[float, ...]:
    """Return the numbers of an option, which stimuli check; none if it is not given."""
    if text is None:
        return ()
    option = f"--{name.replace('_', '-')}"
    return tuple(listed_numbers(option, text, (-1e6, 1e6), is_distinct=True))
