"""Command line of `ocufilter headset`, parsed and checked."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clients.arguments import read_object, read_profile
from clients.headset.runtime import EYES, Eye
from clients.headset.viewer import HELP
from clients.natural_eye import USUAL_AGE_YEARS, USUAL_WHITE_CD_M2
from clients.option_values import a_number
from filter_service import FilterSettings

TRACKED_RANGE_DEG = (15.0, 10.0)
"""Range of gaze with an eye tracker, unless the user gives one."""


def arguments_of(argv: Sequence[str] | None, description: str) -> argparse.Namespace:
    """Return the parsed command line."""
    parser = argparse.ArgumentParser(
        prog="ocufilter headset",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=HELP,
    )
    scene = parser.add_argument_group("the scene")
    scene.add_argument(
        "--scene",
        default="courtyard",
        metavar="NAME|FILE|MODULE:FUNCTION",
        help="courtyard, primitives, or a .glb or .gltf file (default: courtyard); or "
        "a function that receives the OpenGL context and returns a renderer, an object "
        "whose method pictures(views, size_px) returns an RgbdPicture for each view "
        "(see clients/headset/scenery.py)",
    )
    scene.add_argument(
        "--supersampling", type=int, default=2, help="samples per pixel along each axis"
    )
    add_eye_arguments(parser)
    where = parser.add_argument_group("where frames are filtered")
    add_service_arguments(where)
    where.add_argument(
        "--textures",
        choices=("auto", "yes", "no"),
        default="auto",
        help="filter in textures of the viewer's OpenGL context, without copies: auto "
        "on a hardware GPU (default: auto)",
    )
    where.add_argument(
        "--simulated",
        action="store_true",
        help="simulate a headset and a person who looks around; see --out",
    )
    where.add_argument(
        "--size",
        metavar="WxH",
        help="with --simulated: image size of each eye (default: 448x504)",
    )
    where.add_argument(
        "--rate-hz",
        type=a_number,
        help="with --simulated: frame rate (default: 72)",
    )
    where.add_argument(
        "--scale",
        type=a_number,
        help="image size relative to the headset's, 0.1 to 2 (default: 1)",
    )
    where.add_argument(
        "--validate", action="store_true", help="load OpenXR's core validation layer"
    )
    end = parser.add_argument_group("when to stop, and results")
    end.add_argument(
        "--frames", type=int, metavar="N", help="stop after N filtered frames"
    )
    end.add_argument(
        "--seconds",
        type=a_number,
        help="stop this long after the first filtered frame",
    )
    end.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the last filtered images"
    )
    end.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(argv)
    _settle_where(parser, options)
    return options


def add_eye_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of both eyes, which `settings_of` and `profiles_of` read."""
    eyes = parser.add_argument_group("the eyes")
    what = "preset name, JSON, or a .json, .abp, .csv or .zmx file"
    eyes.add_argument(
        "--profile",
        default="myopia",
        help=f"profile of both eyes: {what} (default: myopia)",
    )
    eyes.add_argument("--left", metavar="PROFILE", help="profile of the left eye")
    eyes.add_argument("--right", metavar="PROFILE", help="profile of the right eye")
    eyes.add_argument(
        "--age",
        type=a_number,
        default=USUAL_AGE_YEARS,
        metavar="YEARS",
        help=f"age of the person (default: {USUAL_AGE_YEARS:g})",
    )
    eyes.add_argument(
        "--pupil-mm",
        type=a_number,
        metavar="MM",
        help="fixed pupil diameter (default: the pupil follows the light)",
    )
    eyes.add_argument(
        "--focus-dpt",
        type=a_number,
        metavar="D",
        help="fixed focus (default: focus follows the viewed distance)",
    )
    eyes.add_argument(
        "--white-cd-m2",
        type=a_number,
        default=USUAL_WHITE_CD_M2,
        metavar="L",
        help="luminance of the display's white, which drives the pupil "
        f"(default: {USUAL_WHITE_CD_M2:g})",
    )
    eyes.add_argument(
        "--gaze-range",
        default=None,
        metavar="H,V",
        help="range of gaze, deg (default: 15,10 with a tracker, otherwise 0,0); a "
        "larger range takes longer to prepare",
    )
    eyes.add_argument(
        "--settings",
        default="{}",
        metavar="JSON",
        help='settings of the filter, such as {"tolerance": "loose"}',
    )


def add_service_arguments(where: argparse._ArgumentGroup) -> None:
    """Add the options of a service that filters the frames."""
    where.add_argument(
        "--service",
        metavar="ENDPOINT",
        help="filter in a running service, such as tcp://127.0.0.1:5577 (default: in "
        "this process)",
    )
    where.add_argument(
        "--key", type=Path, metavar="FILE", help="key file of the client, for --service"
    )


def _settle_where(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Reject options that do not apply to the runtime, and fill in defaults."""
    defaults = {"size": "448x504", "rate_hz": 72.0, "scale": 1.0, "validate": False}
    elsewhere = ("scale", "validate") if options.simulated else ("size", "rate_hz")
    for name in elsewhere:
        if getattr(options, name) not in (None, False):
            which = (
                "requires a headset" if options.simulated else "requires --simulated"
            )
            parser.error(f"--{name.replace('_', '-')} {which}")
    for name, value in defaults.items():
        if getattr(options, name) is None:
            setattr(options, name, value)


def settings_of(options: argparse.Namespace) -> FilterSettings:
    """Return the settings of the filter.

    Raises
    ------
    ValueError
        If a value is invalid.  The message names the option or the setting.
    """
    given = read_object("--settings", options.settings)
    if options.gaze_range is not None:
        parts = options.gaze_range.split(",")
        try:
            given["gaze_range_deg"] = tuple(map(float, parts))
        except ValueError:
            raise ValueError(
                f"--gaze-range is {options.gaze_range!r}; allowed: H,V in deg"
            ) from None
    try:
        return FilterSettings(**given)
    except TypeError as error:
        raise ValueError(f"--settings: {error}") from None


def profiles_of(options: argparse.Namespace) -> dict[Eye, Mapping[str, Any]]:
    """Return the profile of each eye."""
    return {
        eye: (
            read_profile(options.profile)
            if getattr(options, eye) is None
            else read_profile(getattr(options, eye), f"--{eye}")
        )
        for eye in EYES
    }


def check_limits(options: argparse.Namespace) -> None:
    """Check the limits, and create the output folder."""
    if not 0.1 <= options.scale <= 2.0:
        raise ValueError(f"--scale is {options.scale}; allowed: 0.1 to 2")
    for name in ("frames", "seconds"):
        value = getattr(options, name)
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"--{name} is {value}; allowed: above 0")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
