"""Command line of `ocufilter headset`, parsed and checked."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clients.arguments import read_object, read_profile
from clients.headset.controls import HELP
from clients.headset.runtime import EYES, Eye
from clients.natural_eye import USUAL_AGE_YEARS, USUAL_WHITE_CD_M2
from filter_service import FilterSettings


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
        "a function of yours, which is given the OpenGL context and gives what "
        "renders: an object whose pictures(views, size_px) returns an RgbdPicture for "
        "each view, see clients/headset/scenery.py",
    )
    scene.add_argument(
        "--supersampling", type=int, default=2, help="samples per pixel and axis"
    )
    eyes = parser.add_argument_group("the eyes")
    what = "a preset's name, JSON, or a .json, .abp or .csv file"
    eyes.add_argument(
        "--profile", default="myopia", help=f"of both eyes: {what} (default: myopia)"
    )
    eyes.add_argument("--left", metavar="PROFILE", help="of the left eye, instead")
    eyes.add_argument("--right", metavar="PROFILE", help="of the right eye, instead")
    eyes.add_argument(
        "--age",
        type=float,
        default=USUAL_AGE_YEARS,
        metavar="YEARS",
        help=f"of the person (default: {USUAL_AGE_YEARS:g})",
    )
    eyes.add_argument(
        "--pupil-mm",
        type=float,
        metavar="MM",
        help="a fixed pupil, instead of one that follows the light",
    )
    eyes.add_argument(
        "--white-cd-m2",
        type=float,
        default=USUAL_WHITE_CD_M2,
        metavar="L",
        help="luminance of the display's white, which the pupil goes by "
        f"(default: {USUAL_WHITE_CD_M2:g})",
    )
    eyes.add_argument(
        "--gaze-range",
        default=None,
        metavar="H,V",
        help="how far eyes turn, in deg: default 15,10 with a tracker, else 0,0; a "
        "larger range takes longer to prepare",
    )
    eyes.add_argument(
        "--settings",
        default="{}",
        metavar="JSON",
        help='of the filter, as {"tolerance": "loose"}',
    )
    where = parser.add_argument_group("where frames are filtered")
    where.add_argument(
        "--service",
        metavar="ENDPOINT",
        help="a running service, as tcp://127.0.0.1:5577; else in this process",
    )
    where.add_argument(
        "--key", type=Path, metavar="FILE", help="the client's key file, for --service"
    )
    where.add_argument(
        "--simulated",
        action="store_true",
        help="no headset: a head that looks around, and pictures for --out",
    )
    where.add_argument(
        "--size", metavar="WxH", help="with --simulated: of each eye (default: 448x504)"
    )
    where.add_argument(
        "--rate-hz",
        type=float,
        help="with --simulated: frames a second (default: 72)",
    )
    where.add_argument(
        "--scale", type=float, help="of the headset's own picture size, 0.1 to 2"
    )
    where.add_argument(
        "--validate", action="store_true", help="load OpenXR's core validation layer"
    )
    end = parser.add_argument_group("until when")
    end.add_argument("--frames", type=int, metavar="N", help="filtered ones")
    end.add_argument("--seconds", type=float, help="from the first filtered frame on")
    end.add_argument(
        "--out", type=Path, metavar="DIR", help="for the last filtered pictures"
    )
    end.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(argv)
    _settle_where(parser, options)
    return options


def _settle_where(parser: argparse.ArgumentParser, options: argparse.Namespace) -> None:
    """Reject options that do not apply to the runtime, and fill in defaults."""
    defaults = {"size": "448x504", "rate_hz": 72.0, "scale": 1.0, "validate": False}
    elsewhere = ("scale", "validate") if options.simulated else ("size", "rate_hz")
    for name in elsewhere:
        if getattr(options, name) not in (None, False):
            which = "is for a headset" if options.simulated else "needs --simulated"
            parser.error(f"--{name.replace('_', '-')} {which}")
    for name, value in defaults.items():
        if getattr(options, name) is None:
            setattr(options, name, value)


def settings_of(options: argparse.Namespace) -> FilterSettings:
    """Return the filter's settings.

    Raises
    ------
    ValueError
        The message names the option or the setting.
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
