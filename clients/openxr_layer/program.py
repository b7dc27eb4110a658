"""`ocufilter layer`: see another OpenXR program, unmodified, through simulated eyes."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clients.commands.options import read_profile, with_options
from clients.headset.options import profiles_of, settings_of
from clients.openxr_layer.helper import (
    LayerHelper,
    LayerOptions,
    Socket,
    WatchedEyes,
)
from clients.openxr_layer.wire import SOCKET_VARIABLE, ask, socket_path
from estimator import ProfileError, parse_profile
from estimator.bounded_files import printable
from filter_service.atomic_files import replace_atomically
from filter_service.command_line import (
    EXIT_FAILURE,
    CommandFailed,
    Json,
    print_json,
    print_line,
    typer_app,
)

CHECK_S = 0.25
"""Interval of the checks of profile files and of the program."""

STOP_S = 5.0
LAYER_NAME = "XR_APILAYER_ocufilter_eye"
OFF_VARIABLE = "DISABLE_XR_APILAYER_OCUFILTER_EYE"
LIBRARY_VARIABLE = "OCUFILTER_LAYER_LIBRARY"
ENTRY_POINT = "xrNegotiateLoaderApiLayerInterface"
HEADERS = "libopenxr-dev libgl-dev libegl-dev libvulkan-dev libx11-dev"

Kind = Literal["explicit", "implicit"]


def say(line: str) -> None:
    """Print a message for the user to stderr."""
    print(f"layer: {printable(line)}", file=sys.stderr, flush=True)


layer = typer_app(
    help="""See another OpenXR program, unmodified, through simulated eyes.

    `run` starts the program with an OpenXR API layer, which copies each frame,
    sends it to this process, and shows the result in place of the program's own frame.
    If there is no result, the program's own frames are shown.

    ocufilter layer run --left myopia --right keratoconus -- hello_xr -g OpenGL

    `install` registers the layer for all programs of this user, such as those that a
    game launcher starts.  XR_ENABLE_API_LAYERS=XR_APILAYER_ocufilter_eye enables it for
    one of them, --implicit for all.  Frames are filtered while `ocufilter layer serve`
    runs.""",
    no_args_is_help=True,
)


@contextlib.contextmanager
def _helper(options: LayerOptions) -> Iterator[tuple[LayerHelper, WatchedEyes]]:
    """Return the helper, which listens, and its eyes."""
    options.check()
    settings = settings_of(options)
    profiles_of(options)  # which may be wrong, before the engine is loaded
    from clients.headset.stereo_filter import LocalFilter, ServiceFilter, StereoFilter
    from clients.headset.stereo_gaze import StereoGaze

    look = StereoGaze(
        age_years=options.age,
        pupil_diameter_mm=options.pupil_mm,
        white_cd_m2=options.white_cd_m2,
        gaze_range_deg=settings.gaze_range_deg,
        focus_dpt=options.focus_dpt,
    )
    seeing: StereoFilter
    if options.service is not None:
        seeing = ServiceFilter(options.service, settings, say, key_file=options.key)
    else:
        seeing = LocalFilter(settings, say)
    with contextlib.closing(seeing):
        eyes = WatchedEyes(options, settings, seeing, look, say)
        eyes.begin(tracks_eyes=False)
        helper = LayerHelper(
            seeing, look, say, options, eyes.change_to, options.socket_file
        )
        helper.on_gaze = partial(eyes.begin, tracks_eyes=True)
        with contextlib.closing(helper):
            yield helper, eyes


class _Ending:
    """Whether a signal has asked the program to end."""

    def __init__(self) -> None:
        self.signal = 0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, _frame: object) -> None:
        self.signal = number


@layer.command()
@with_options
def serve(options: LayerOptions, json_output: Json = False) -> None:
    """Filter the frames of programs with the layer.

    Ends when it is interrupted.

    ocufilter layer serve --left myopia
    """
    ending = _Ending()
    with _helper(options) as (helper, eyes):
        say(f"listening at {options.socket_file}")
        while not ending.signal:
            helper.run_once(CHECK_S)
            eyes.reread()
        _print_report(helper, json_output)


@layer.command(context_settings={"allow_interspersed_args": False})
@with_options
def run(
    options: LayerOptions,
    program: Annotated[
        list[str] | None,
        typer.Argument(metavar="PROGRAM", help="Program and its arguments, after --."),
    ] = None,
    json_output: Json = False,
) -> None:
    """Run a program with the layer; return its exit code.

    ocufilter layer run --left myopia --right keratoconus -- hello_xr -g OpenGL
    """
    if not program:
        raise ValueError("there is no program; put it after --")
    options.check()
    settings_of(options)
    profiles_of(options)
    path = _library()
    ending = _Ending()
    with _helper(options) as (helper, eyes), tempfile.TemporaryDirectory() as folder:
        (Path(folder) / f"{LAYER_NAME}.json").write_text(manifest("explicit"))
        environment = layered_environment(Path(folder)) | {
            SOCKET_VARIABLE: str(options.socket_file.resolve())
        }
        process = subprocess.Popen(program, env=environment)
        asked_s = 0.0
        while process.poll() is None:
            helper.run_once(CHECK_S)
            eyes.reread()
            if ending.signal and not asked_s:
                process.send_signal(ending.signal)
                asked_s = time.monotonic()
            elif asked_s and time.monotonic() - asked_s > STOP_S:
                process.kill()
        _print_report(helper, json_output)
    if helper.n_frames == 0 and not ending.signal:
        say(
            f"no frame arrived: {program[0]} did not load the layer {path}, or has "
            "not submitted frames that can be filtered"
        )
    code = process.returncode
    raise typer.Exit(128 - code if code < 0 else code)


def _print_report(helper: LayerHelper, json_output: bool) -> None:
    report = helper.report()
    if json_output:
        print_json(report)
        return
    say(
        f"{report['filtered']} frames filtered; {report['shown_filtered']} of "
        f"{report['submitted']} frames shown filtered, {report['fallback']} shown "
        "unfiltered after the first of them"
    )
    for name, values in report["stages_ms"].items():
        words = ", ".join(f"{p} {value:g}" for p, value in values.items())
        say(f"  {name.removesuffix('_ms'):10s} {words} ms")


def _library() -> Path:
    """Return the layer's library.

    Raises
    ------
    CommandFailed
        If it was not built.  The message says what is missing.
    """
    try:
        return library()
    except NoLayer as error:
        raise CommandFailed(str(error)) from None


@layer.command(name="set")
def set_eyes(
    profile: Annotated[
        str | None, typer.Option(metavar="PROFILE", help="Profile of both eyes.")
    ] = None,
    left: Annotated[
        str | None, typer.Option(metavar="PROFILE", help="Profile of the left eye.")
    ] = None,
    right: Annotated[
        str | None, typer.Option(metavar="PROFILE", help="Profile of the right eye.")
    ] = None,
    socket: Socket = None,
) -> None:
    """Change the eyes of a running helper.

    ocufilter layer set --left emmetropia
    """
    wanted: dict[str, str] = {}
    for eye, own in (("left", left), ("right", right)):
        text = profile if own is None else own
        if text is not None:
            is_path = Path(text).exists() and not text.lstrip().startswith("{")
            try:
                parse_profile(read_profile(text, f"--{eye}"))
            except ProfileError as error:
                raise ValueError(f"--{eye}: {error}") from None
            wanted[eye] = str(Path(text).resolve()) if is_path else text
    if not wanted:
        raise ValueError("there is no profile; use --profile, --left or --right")
    ask(socket or socket_path(), wanted)


@layer.command()
def install(
    implicit: Annotated[
        bool,
        typer.Option(
            "--implicit",
            help="Load it into all OpenXR programs of this user, unless the variable "
            f"{OFF_VARIABLE} is set.",
        ),
    ] = False,
) -> None:
    """Register the layer with the OpenXR loader.

    ocufilter layer install --implicit
    """
    _library()
    kind: Kind = "implicit" if implicit else "explicit"
    text = manifest(kind)
    _remove_all()
    path = manifest_path(kind)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_atomically(path, lambda part: part.write_text(text))
    say(f"wrote {path}")
    if implicit:
        say(f"all OpenXR programs load it, except with {OFF_VARIABLE}=1")
    else:
        say(f"to enable it for a program: XR_ENABLE_API_LAYERS={LAYER_NAME}")
    say("frames are filtered while `ocufilter layer serve` runs")


@layer.command()
def remove() -> None:
    """Undo `install`.

    ocufilter layer remove
    """
    paths = _remove_all()
    for path in paths:
        say(f"removed {path}")
    if not paths:
        say("the layer was not installed")


@layer.command()
def status(socket: Socket = None, json_output: Json = False) -> None:
    """Print what is installed and running.

    The exit code is 0 if the layer was built.

    ocufilter layer status
    """
    socket = socket or socket_path()
    found: dict[str, Any] = {
        "layer": None,
        "error": None,
        "installed": [str(path) for path in _installed()],
        "helper": None,
    }
    try:
        found["layer"] = str(library())
    except NoLayer as error:
        found["error"] = str(error)
    with contextlib.suppress(OSError):
        found["helper"] = ask(socket, {})
    if json_output:
        print_json(found)
    else:
        helper = found["helper"]
        print_line(f"layer: {found['layer'] or found['error']}")
        print_line(f"installed: {', '.join(found['installed']) or 'no'}")
        print_line(f"helper: {'none' if helper is None else 'running'} at {socket}")
        if helper is not None:
            graphics = f", {helper['graphics']}" if helper["graphics"] else ""
            print_line(f"program: {helper['program'] or 'none'}{graphics}")
            print_line(f"frames filtered: {helper['filtered']}")
    if not found["layer"]:
        raise typer.Exit(EXIT_FAILURE)


def _installed() -> list[Path]:
    kinds: tuple[Kind, ...] = ("explicit", "implicit")
    return [path for path in map(manifest_path, kinds) if path.exists()]


def _remove_all() -> list[Path]:
    found = _installed()
    for path in found:
        path.unlink()
    return found


# Library and manifest, by which the loader of OpenXR finds the layer.  It reads
# explicit layers, which a program's environment names, and implicit ones, which it
# loads into all programs unless their environment forbids it.


class NoLayer(Exception):
    """The layer's library is missing or cannot be loaded."""


def library() -> Path:
    """Return the path of the layer's library.

    Raises
    ------
    NoLayer
        If it was not built, or cannot be loaded.
    """
    given = os.environ.get(LIBRARY_VARIABLE)
    path = Path(given) if given else Path(__file__).with_name("_layer.so")
    if not path.is_file():
        raise NoLayer(
            "the layer was not built; it requires Linux, a C compiler and the headers "
            "of OpenXR, OpenGL, Vulkan and X11 (Debian: apt install gcc "
            f"{HEADERS}); then install ocufilter again"
        )
    try:
        getattr(ctypes.CDLL(str(path)), ENTRY_POINT)
    except (OSError, AttributeError) as error:
        raise NoLayer(f"{path} is not a layer for this machine: {error}") from None
    return path.resolve()


def manifest(kind: Kind) -> str:
    """Return the manifest of the layer, JSON."""
    found = {
        "file_format_version": "1.0.0",
        "api_layer": {
            "name": LAYER_NAME,
            "library_path": str(library()),
            "api_version": "1.1",
            "implementation_version": "1",
            "description": "Shows each frame as a simulated eye would see it",
            # For runtimes without depth, where the layer removes it.
            "instance_extensions": [
                {
                    "name": "XR_KHR_composition_layer_depth",
                    "extension_version": "6",
                    "entrypoints": [],
                }
            ],
            **({"disable_environment": OFF_VARIABLE} if kind == "implicit" else {}),
        },
    }
    return json.dumps(found, indent=2) + "\n"


def folder(kind: Kind) -> Path:
    """Return the user's folder of manifests."""
    data = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local/share")
    return Path(data) / "openxr/1/api_layers" / f"{kind}.d"


def manifest_path(kind: Kind) -> Path:
    """Return the path of the installed manifest."""
    return folder(kind) / f"{LAYER_NAME}.json"


def search_path(own: Path) -> str:
    """Return a value of XR_API_LAYER_PATH with another folder.

    The variable replaces the loader's own folders, which are therefore named as well.
    """
    given = os.environ.get("XR_API_LAYER_PATH")
    if given:
        return os.pathsep.join((str(own), given))
    settings = os.environ.get("XDG_CONFIG_DIRS") or "/etc/xdg"
    data = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    system = [*settings.split(":"), "/etc", *data.split(":")]
    folders = [Path(base) / "openxr/1/api_layers/explicit.d" for base in system]
    return os.pathsep.join(map(str, (own, folder("explicit"), *folders)))


def layered_environment(own: Path) -> dict[str, str]:
    """Return the environment of a program with the layer, next to the program.

    Parameters
    ----------
    own : Path
        Folder that contains the manifest.
    """
    others = os.environ.get("XR_ENABLE_API_LAYERS")
    return {
        **os.environ,
        "XR_API_LAYER_PATH": search_path(own),
        "XR_ENABLE_API_LAYERS": os.pathsep.join(filter(None, (LAYER_NAME, others))),
    }
