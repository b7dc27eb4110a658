"""See a scene through two people's eyes, or one's, in an OpenXR headset.

    ocufilter headset --left myopia --right keratoconus
    ocufilter headset --scene kitchen.glb --service tcp://127.0.0.1:5577
    ocufilter headset --simulated --seconds 10 --out out/headset

Each eye is filtered through its own profile, pupil, focus and gaze: in this process, or
through a running service.  Gaze comes from the headset's eye tracker where it has one;
focus follows what is looked at, and pupils the light of the scene, as people's do.
"""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import math
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from clients.extra import HEADSET_INSTALL
from clients.headset.built_scene import SceneNotBuilt, built_scene
from clients.headset.controls import HELP, Controls
from clients.headset.look import StereoLook
from clients.headset.poses import upright
from clients.headset.runtime import EYES, NoRuntime, Runtime
from clients.headset.seeing import Seeing, SeeingByService, SeeingHere
from clients.headset.viewer import Viewer, ViewerLog
from clients.natural import USUAL_AGE_YEARS, USUAL_WHITE_CD_M2
from clients.profile_arguments import read_profile
from filter_service import FilterSettings
from filter_service.errors import FilterError

TRACKED_RANGE_DEG = (15.0, 10.0)
CORE_VALIDATION = "XR_APILAYER_LUNARG_core_validation"


def say(line: str) -> None:
    """Tell the user something, beside what a program reads from stdout."""
    print(f"headset: {line}", file=sys.stderr, flush=True)


def arguments_of(argv: Sequence[str] | None) -> argparse.Namespace:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="ocufilter headset",
        description=__doc__,
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
    what = "a preset's name, JSON, or a .json file"
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
    where = parser.add_argument_group("where it is filtered and shown")
    where.add_argument(
        "--service",
        metavar="ENDPOINT",
        help="a running service, as tcp://127.0.0.1:5577; else in this process",
    )
    where.add_argument(
        "--simulated",
        action="store_true",
        help="no headset: a head that looks around, and pictures for --out",
    )
    where.add_argument(
        "--size", default="448x504", metavar="WxH", help="with --simulated: of each eye"
    )
    where.add_argument(
        "--rate-hz", type=float, default=72.0, help="with --simulated: frames a second"
    )
    where.add_argument(
        "--scale",
        type=float,
        default=1.0,
        help="of the headset's own picture size, 0.1 to 2",
    )
    where.add_argument(
        "--validate", action="store_true", help="load OpenXR's core validation layer"
    )
    end = parser.add_argument_group("until when")
    end.add_argument("--frames", type=int, metavar="N", help="filtered ones")
    end.add_argument("--seconds", type=float)
    end.add_argument("--out", type=Path, metavar="DIR", help="for the last pictures")
    end.add_argument("--json", action="store_true", help="print one JSON object")
    return parser.parse_args(argv)


def settings_of(options: argparse.Namespace) -> FilterSettings:
    """Return the filter's settings.

    Raises
    ------
    ValueError
        Names the option or the setting.
    """
    try:
        given = json.loads(options.settings)
    except ValueError as error:
        raise ValueError(f"--settings is no JSON: {error}") from None
    if not isinstance(given, dict):
        raise ValueError(f"--settings is {given!r}; allowed: a JSON object")
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


def gaze_range_of(
    options: argparse.Namespace, settings: FilterSettings, runtime: Runtime
) -> tuple[float, float]:
    """Return how far eyes turn: as was asked for, else as far as is tracked."""
    is_told = options.gaze_range is not None or any(settings.gaze_range_deg)
    if runtime.tracks_eyes and not is_told:
        return TRACKED_RANGE_DEG
    return settings.gaze_range_deg


def profiles_of(options: argparse.Namespace) -> dict[Any, Mapping[str, Any]]:
    """Return the profile of each eye."""
    return {
        eye: (
            read_profile(options.profile)
            if getattr(options, eye) is None
            else read_profile(getattr(options, eye), f"--{eye}")
        )
        for eye in EYES
    }


def scenery_of(options: argparse.Namespace, context) -> Any:
    """Return what renders both eyes' pictures: ours, or the user's.

    Raises
    ------
    ValueError
        There is no such scene, file or function.
    """
    module, colon, function = options.scene.partition(":")
    if colon and not Path(options.scene).exists():
        sys.path.insert(0, "")
        try:
            make = getattr(importlib.import_module(module), function)
        except (ImportError, AttributeError) as error:
            raise ValueError(f"--scene {options.scene}: {error}") from None
        try:
            with context:
                return make(context)
        except Exception as error:  # it is the user's own
            raise ValueError(
                f"--scene {options.scene}: {type(error).__name__}: {error}"
            ) from error
    from clients.headset.scenery import SceneScenery

    scene, stand = scene_of(options.scene)
    return SceneScenery(context, scene, stand, supersampling=options.supersampling)


def scene_of(name: str):
    """Return a scene of ours by its name, or that of a file; and where to stand."""
    from clients.headset.gltf_scene import load_gltf
    from clients.headset.viewpoint import viewpoint

    is_file = Path(name).suffix.lower() in (".glb", ".gltf")
    scene = load_gltf(name) if is_file else built_scene(name)
    return scene, upright(viewpoint(scene))


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Show the scene until the end; return what became of the frames."""
    from clients.headset.keys import TerminalKeys

    settings, profiles = settings_of(options), profiles_of(options)
    for name, low, high in (("scale", 0.1, 2.0),):
        if not low <= getattr(options, name) <= high:
            raise ValueError(
                f"--{name} is {getattr(options, name)}; allowed: {low:g} to {high:g}"
            )
    look = StereoLook(
        age_years=options.age,
        pupil_diameter_mm=options.pupil_mm,
        white_cd_m2=options.white_cd_m2,
        gaze_range_deg=settings.gaze_range_deg,
    )
    size_px = _size(options.size)
    _check_limits(options)
    with ExitStack() as stack:
        context = _context(options, stack)
        scenery = scenery_of(options, context)
        stack.callback(getattr(scenery, "close", lambda: None))
        seeing = _seeing(options, settings)
        stack.callback(seeing.close)
        keeper = _Pictures()
        keys = stack.enter_context(TerminalKeys())

        def change(eye, profile) -> None:
            look.change(eye)
            seeing.change(eye, profile)
            say(f"{eye} eye: {profile.get('name', profile.get('kind'))}")

        controls = Controls(dict(profiles), change, say)

        def on_session(runtime: Runtime) -> None:
            """Begin with the eyes once it is known how far they turn."""
            reach_deg = gaze_range_of(options, settings, runtime)
            if controls.is_begun and reach_deg == look.gaze_range_deg:
                return
            controls.is_begun = True
            look.gaze_range_deg = reach_deg
            seeing.settings = settings.changed(gaze_range_deg=reach_deg)
            for eye, profile in controls.profiles.items():
                change(eye, profile)

        def open_runtime() -> Runtime:
            if options.simulated:
                from clients.headset.simulated_runtime import SimulatedRuntime

                return SimulatedRuntime(
                    size_px, rate_hz=options.rate_hz, on_shown=keeper.keep
                )
            return _open_xr(context, options)

        viewer = Viewer(
            open_runtime,
            scenery,
            seeing,
            look,
            controls,
            read_keys=keys.pressed,
            say=say,
            on_session=on_session,
        )
        if sys.stdin is not None and sys.stdin.isatty():
            say(HELP)
        started_s = time.monotonic()
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            viewer.run(max_frames=options.frames, limit_s=options.seconds)
        except KeyboardInterrupt:
            say("ended")
        log = viewer.log
        took_s = time.monotonic() - started_s
        if options.out is not None:
            keeper.write(options.out)
        return _report(options, log, took_s, seeing)


def _openxr(name: str) -> Any:
    """Return a module that needs pyopenxr."""
    # The loader says much on stderr while there is no runtime; we say it once.
    os.environ.setdefault("XR_LOADER_DEBUG", "none")
    try:
        return importlib.import_module(f"clients.headset.{name}")
    except ModuleNotFoundError:
        raise ValueError(
            f"pyopenxr is not installed: {HEADSET_INSTALL}; or see what a headset "
            "would show with --simulated"
        ) from None


def _context(options: argparse.Namespace, stack: ExitStack) -> Any:
    """Return the OpenGL context that everything is drawn in."""
    if not options.simulated:
        return stack.enter_context(_openxr("openxr_gl").open_context())
    import moderngl

    context = moderngl.create_context(standalone=True, backend="egl", require=430)
    stack.callback(context.release)
    return context


def _open_xr(context, options: argparse.Namespace) -> Runtime:
    layers = [CORE_VALIDATION] if options.validate else []
    runtime = _openxr("openxr_runtime").OpenXrRuntime(
        context, layers=layers, scale=options.scale
    )
    for note in runtime.notes:
        say(note)
    return runtime


def _seeing(options: argparse.Namespace, settings: FilterSettings) -> Seeing:
    if options.service is not None:
        return SeeingByService(options.service, settings, say)
    return SeeingHere(settings, say)


def _check_limits(options: argparse.Namespace) -> None:
    """Refuse limits that are none, and a folder that cannot be written to."""
    for name in ("frames", "seconds"):
        value = getattr(options, name)
        if value is not None and not 0 < value < math.inf:
            raise ValueError(f"--{name} is {value}; allowed: above 0")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)


def _size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdigit() and int(p) >= 16 for p in parts):
        raise ValueError(f"--size is {text!r}; allowed: WIDTHxHEIGHT, 16 px or more")
    return int(parts[0]), int(parts[1])


class _Pictures:
    """The last pictures that were shown."""

    def __init__(self) -> None:
        self._shown: Sequence[Any] = ()

    def keep(self, due, shown) -> None:
        """Keep what is shown."""
        self._shown = shown or self._shown

    def write(self, folder: Path) -> None:
        """Write one PNG of each eye."""
        from PIL import Image

        folder.mkdir(parents=True, exist_ok=True)
        for shown in self._shown:
            path = folder / f"{shown.view.eye}.png"
            Image.fromarray(shown.color).save(path)
            say(f"wrote {path}")


def _report(
    options: argparse.Namespace, log: ViewerLog, took_s: float, seeing: Seeing
) -> dict[str, Any]:
    report = {
        "where": options.service or "in this process",
        "seconds": round(took_s, 3),
        **log.summary(),
    }
    if isinstance(seeing, SeeingByService):
        report["dropped"] = seeing.n_dropped
    return report


def _lines(report: Mapping[str, Any]) -> str:
    lines = [
        f"{report['filtered']} frames filtered in {report['seconds']:.1f} s "
        f"({report['where']}), {report['repeated']} shown again, "
        f"{report['plain']} plain, {report['not_rendered']} not rendered, "
        f"{report['incomplete']} through an eye that was not whole yet"
    ]
    for name, values in report["stages_ms"].items():
        words = ", ".join(f"{p} {value:g}" for p, value in values.items())
        lines.append(f"  {name.removesuffix('_ms'):10s} {words} ms")
    for note in report["notes"]:
        lines.append(f"  {note['frames']} frames: {note['example']}")
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; return its exit code."""
    options = arguments_of(argv)
    logging.basicConfig(format="headset: %(message)s", level=logging.INFO)
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # pyopenxr imports it
    try:
        report = run(options)
    except KeyboardInterrupt:  # before there was anything to show
        return 130
    except ValueError as error:
        print(f"headset: {error}", file=sys.stderr)
        return 2
    except (FilterError, NoRuntime, SceneNotBuilt, OSError, RuntimeError) as error:
        print(f"headset: {error}", file=sys.stderr)
        return 1
    sys.stdout.write((json.dumps(report) if options.json else _lines(report)) + "\n")
    if not report["filtered"]:
        print("headset: no frame was filtered", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
