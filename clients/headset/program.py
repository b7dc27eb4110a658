"""`ocufilter headset`: view a scene through other people's eyes."""

from __future__ import annotations

import importlib
import logging
import math
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import typer

from clients.commands.options import read_size_px, with_options
from clients.headset.options import (
    EyeOptions,
    Eyes,
    profiles_of,
    settings_of,
)
from clients.headset.runtime import NoRuntime, Runtime, ShownView, upright
from clients.headset.stereo_filter import LocalFilter, ServiceFilter, StereoFilter
from clients.headset.stereo_gaze import StereoGaze
from clients.headset.viewer import HELP, Controls, TerminalKeys, Viewer, ViewerLog
from estimator.bounded_files import printable
from filter_service import FilterSettings, is_software_renderer
from filter_service.atomic_files import replace_atomically
from filter_service.command_line import (
    CommandFailed,
    Json,
    check_range,
    install_command,
    print_json,
    print_line,
)

if TYPE_CHECKING:
    import moderngl

    from clients.scenes.geometry import Array, Scene

WARM_UP_S = 60.0
"""Longest wait for the first filtered frame; `--seconds` counts from that frame."""

CORE_VALIDATION = "XR_APILAYER_LUNARG_core_validation"


@dataclass(frozen=True, kw_only=True)
class HeadsetOptions(EyeOptions):
    """Options of the command line."""

    scene: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE|MODULE:FUNCTION",
            help="courtyard, primitives, or a .glb or .gltf file; or a function that "
            "receives the OpenGL context and returns a renderer, an object whose "
            "method pictures(views, size_px) returns an RgbdPicture for each view (see "
            "clients/headset/scenery.py).",
        ),
    ] = "courtyard"
    supersampling: Annotated[
        int, typer.Option(help="Samples per pixel along each axis.")
    ] = 2
    textures: Annotated[
        Literal["auto", "yes", "no"],
        typer.Option(
            help="Filter in textures of the viewer's OpenGL context, without copies; "
            "auto: on a hardware GPU."
        ),
    ] = "auto"
    simulated: Annotated[
        bool,
        typer.Option(
            "--simulated",
            help="Simulate a headset and a person who looks around; see --out.",
        ),
    ] = False
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="With --simulated: image size of each eye in px; by default 448x504.",
        ),
    ] = None
    rate_hz: Annotated[
        float | None,
        typer.Option(help="With --simulated: frame rate; by default 72."),
    ] = None
    scale: Annotated[
        float | None,
        typer.Option(
            help="Image size relative to the headset's, 0.1 to 2; by default 1."
        ),
    ] = None
    validate: Annotated[
        bool,
        typer.Option("--validate", help="Load OpenXR's core validation layer."),
    ] = False
    frames: Annotated[
        int | None,
        typer.Option(metavar="N", help="Stop after N filtered frames."),
    ] = None
    seconds: Annotated[
        float | None,
        typer.Option(help="Stop this long after the first filtered frame."),
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the last filtered images."),
    ] = None

    def check(self) -> None:
        """Check the limits, and that the options apply to the runtime.

        Raises
        ------
        ValueError
            If a value is invalid.  The message names the option.
        """
        elsewhere = ("scale", "validate") if self.simulated else ("size", "rate_hz")
        for name in elsewhere:
            if getattr(self, name) not in (None, False):
                where = "a headset" if self.simulated else "--simulated"
                raise ValueError(f"--{name.replace('_', '-')} requires {where}")
        if self.scale is not None:
            check_range("--scale", self.scale, (0.1, 2.0))
        for name in ("frames", "seconds"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"--{name} is {value}; allowed: above 0")


def say(line: str) -> None:
    """Print a message for the user to stderr; stdout is for results."""
    print(f"headset: {printable(line)}", file=sys.stderr, flush=True)


def scenery_of(options: HeadsetOptions, context: moderngl.Context) -> Any:
    """Return the renderer of both eyes' images: the built-in one or the user's.

    Raises
    ------
    ValueError
        If there is no such scene, file or function.
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
        except Exception as error:  # in the user's own code
            raise ValueError(
                f"--scene {options.scene}: {type(error).__name__}: {error}"
            ) from error
    from clients.headset.scenery import SceneScenery

    scene, stand = scene_of(options.scene)
    return SceneScenery(context, scene, stand, supersampling=options.supersampling)


def scene_of(name: str) -> tuple[Scene, Array]:
    """Return a built-in scene or the scene of a file, and the viewer's pose in it."""
    from clients.headset.gltf_scene import load_gltf
    from clients.headset.scenery import viewpoint
    from clients.scenes.catalog import build_scene

    is_file = Path(name).suffix.lower() in (".glb", ".gltf")
    scene = load_gltf(name) if is_file else build_scene(name)
    return scene, upright(viewpoint(scene))


def run(options: HeadsetOptions) -> dict[str, Any]:
    """Show the scene until the user or a limit ends it; return a report."""
    options.check()
    settings = settings_of(options)
    profiles_of(options)  # which may be wrong
    size_px = read_size_px(options.size or "448x504")
    look = StereoGaze(
        age_years=options.age,
        pupil_diameter_mm=options.pupil_mm,
        white_cd_m2=options.white_cd_m2,
        gaze_range_deg=settings.gaze_range_deg,
        focus_dpt=options.focus_dpt,
    )
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    pictures = _Pictures()
    with ExitStack() as stack:
        context = _context(options, stack)
        scenery = scenery_of(options, context)
        stack.callback(getattr(scenery, "close", lambda: None))
        seeing = _seeing(options, settings, context, stack)
        eyes = Eyes(options, settings, seeing, look, say)
        controls = Controls(eyes.profiles, eyes.change, say)
        viewer = Viewer(
            lambda: _runtime(options, context, size_px, pictures),
            scenery,
            seeing,
            look,
            controls,
            read_keys=stack.enter_context(TerminalKeys()).pressed,
            say=say,
            on_session=lambda runtime: eyes.begin(tracks_eyes=runtime.tracks_eyes),
        )
        took_s = _view(viewer, controls, options)
        if options.out is not None:
            pictures.write(options.out, context)
        return _report(options, viewer.log, took_s, seeing)


def _view(viewer: Viewer, controls: Controls, options: HeadsetOptions) -> float:
    """Show frames until a limit, the user or a signal ends the viewer.

    Returns
    -------
    float
        Time since the first filtered frame, s.
    """
    if sys.stdin is not None and sys.stdin.isatty():
        say(HELP)
    started_s = time.monotonic()

    def end(*_: object) -> None:
        # An exception would be lost if C code called this handler.
        controls.is_over = True
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(
                number, signal.default_int_handler
            )  # a second signal ends at once

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    try:
        viewer.run(
            max_frames=options.frames, limit_s=options.seconds, warm_up_s=WARM_UP_S
        )
    except KeyboardInterrupt:
        controls.is_over = True
    if controls.is_over:
        say("ended")
    return time.monotonic() - (viewer.log.first_filtered_s or started_s)


def _runtime(
    options: HeadsetOptions,
    context: Any,
    size_px: tuple[int, int],
    pictures: _Pictures,
) -> Runtime:
    """Return the headset's runtime, or the simulated one."""
    if not options.simulated:
        return _open_xr(context, options)
    from clients.headset.runtime import SimulatedRuntime

    def finish() -> None:
        with context:
            context.finish()

    return SimulatedRuntime(
        size_px, rate_hz=options.rate_hz or 72.0, on_shown=pictures.keep, finish=finish
    )


def _openxr(name: str) -> Any:
    """Import and return a module that needs pyopenxr."""
    # Without a runtime, the loader repeats messages on stderr; we print one.
    os.environ.setdefault("XR_LOADER_DEBUG", "none")
    try:
        return importlib.import_module(f"clients.headset.{name}")
    except ModuleNotFoundError:
        raise ValueError(
            f"pyopenxr is not installed: {install_command('headset')}; or use "
            "--simulated, which requires no headset"
        ) from None


def _context(options: HeadsetOptions, stack: ExitStack) -> Any:
    """Return the OpenGL context for all drawing."""
    if not options.simulated:
        return stack.enter_context(_openxr("openxr_gl").open_context())
    from clients.scenes.scene_view import open_context

    context = open_context(430)
    stack.callback(context.release)
    return context


def _open_xr(context: moderngl.Context, options: HeadsetOptions) -> Runtime:
    layers = [CORE_VALIDATION] if options.validate else []
    runtime = _openxr("openxr_runtime").OpenXrRuntime(
        context, layers=layers, scale=options.scale or 1.0
    )
    for note in runtime.notes:
        say(note)
    return runtime


def _seeing(
    options: HeadsetOptions,
    settings: FilterSettings,
    context: moderngl.Context,
    stack: ExitStack,
) -> StereoFilter:
    """Return the filter of both eyes, which the stack closes."""
    if options.service is not None:
        seeing = ServiceFilter(options.service, settings, say, key_file=options.key)
        stack.callback(seeing.close)  # also if no service answers
        if options.frames is not None or options.seconds is not None:
            seeing.wait_for_service()  # a run that counts frames requires one
        return seeing
    with context:
        renderer = str(context.info["GL_RENDERER"])
    # On a software renderer, the compiled loops are faster, and copies cost less.
    wanted = options.textures == "yes"
    if options.textures == "auto":
        wanted = not is_software_renderer(renderer)
    local = LocalFilter(settings, say, context if wanted else None)
    stack.callback(local.close)
    return local


class _Pictures:
    """The last filtered images shown."""

    def __init__(self) -> None:
        self._shown: Sequence[ShownView] = ()

    def keep(self, due: object, shown: Sequence[ShownView]) -> None:
        """Keep the views shown if they are filtered."""
        if shown and all(view.plain is not None for view in shown):
            self._shown = shown

    def write(self, folder: Path, context: moderngl.Context | None = None) -> None:
        """Write one PNG per eye into an existing folder."""
        from PIL import Image

        from clients.scenes.scene_view import read_texture

        if not self._shown:
            say(f"no frame was filtered, so nothing is written to {folder}")
        for shown in self._shown:
            path = folder / f"{shown.view.eye}.png"
            color = shown.color
            if not isinstance(color, np.ndarray):
                with context or nullcontext():
                    color = read_texture(color)[..., :3]
            replace_atomically(path, Image.fromarray(color).save)
            say(f"wrote {path}")


def _report(
    options: HeadsetOptions, log: ViewerLog, took_s: float, seeing: StereoFilter
) -> dict[str, Any]:
    report = {
        "where": options.service or "in this process",
        "seconds": round(took_s, 3),
        **log.summary(),
    }
    if isinstance(seeing, ServiceFilter):
        report["dropped"] = seeing.n_dropped
    return report


def _lines(report: Mapping[str, Any]) -> str:
    lines = [
        f"{report['filtered']} frames filtered in {report['seconds']:.1f} s "
        f"({report['where']}), {report['repeated']} shown again, "
        f"{report['plain']} shown unfiltered, {report['not_rendered']} not rendered, "
        f"{report['incomplete']} filtered with an incomplete eye"
    ]
    for name, values in report["stages_ms"].items():
        words = ", ".join(f"{p} {value:g}" for p, value in values.items())
        lines.append(f"  {name.removesuffix('_ms'):10s} {words} ms")
    for note in report["notes"]:
        lines.append(f"  {note['frames']} frames: {note['example']}")
    return "\n".join(lines)


@with_options
def headset(options: HeadsetOptions, json_output: Json = False) -> None:
    """Show a scene in an OpenXR headset, each eye through its own profile.

    ocufilter headset --left myopia --right keratoconus

    ocufilter headset --scene kitchen.glb --service tcp://127.0.0.1:5577

    ocufilter headset --simulated --seconds 10 --out out/headset

    Each eye is filtered through its own profile, pupil, focus and gaze, in this process
    or by a running service.  The headset's eye tracker, if it has one, provides the
    gaze.  Focus follows the point of fixation, and pupils adapt to the light of the
    scene.

    Keys in the terminal: 1 to 6 give both eyes a preset, l and r the next preset to the
    left or right eye; f turns the filter on or off, s shows the left half unfiltered,
    and q quits.
    """
    logging.basicConfig(format="headset: %(message)s", level=logging.INFO)
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # pyopenxr imports it
    try:
        report = run(options)
    except (NoRuntime, RuntimeError) as error:
        raise CommandFailed(str(error)) from error
    if json_output:
        print_json(report)
    else:
        print_line(_lines(report))
    if not report["filtered"]:
        raise CommandFailed("no frame was filtered")
