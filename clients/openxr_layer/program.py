"""See another OpenXR program, unmodified, through simulated eyes.

    ocufilter layer run --left myopia --right keratoconus -- hello_xr -g OpenGL
    ocufilter layer set --left emmetropia
    ocufilter layer status

`run` starts the program with an OpenXR API layer, which copies each frame, has it
filtered by this process, and shows the result in place of the program's own frame. When
there is no result, the program's own frames are shown.

`install` makes the layer known to all programs of this user, such as those that a game
launcher starts. XR_ENABLE_API_LAYERS=XR_APILAYER_ocufilter_eye enables it for one of
them, --implicit for all. Frames are filtered while `ocufilter layer serve` runs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from clients.arguments import read_profile
from clients.headset.options import (
    add_eye_arguments,
    add_service_arguments,
    profiles_of,
    settings_of,
)
from clients.headset.runtime import EYES
from clients.openxr_layer import manifest
from clients.openxr_layer.helper import USUAL_AGE_MS, Eyes, HelperOptions, LayerHelper
from clients.openxr_layer.wire import SOCKET_VARIABLE, ask, socket_path
from clients.option_values import a_number
from estimator import ProfileError, parse_profile
from estimator.bounded_files import printable
from filter_service import FilterSettings
from filter_service.atomic_files import replace_atomically
from filter_service.errors import FilterError

CHECK_S = 0.25
"""Period at which profile files and the program are looked at."""

STOP_S = 5.0
MAX_WAIT_MS = 600_000


def say(line: str) -> None:
    """Print a message for the user to stderr."""
    print(f"layer: {printable(line)}", file=sys.stderr, flush=True)


# Command line


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ocufilter layer",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    run = actions.add_parser("run", help="run a program with the layer")
    serve = actions.add_parser(
        "serve", help="filter the frames of programs with the layer"
    )
    for each in (run, serve):
        add_eye_arguments(each)
        _add_helper_arguments(each)
    run.add_argument(
        "program", nargs=argparse.REMAINDER, metavar="-- PROGRAM ...", help="after --"
    )
    change = actions.add_parser("set", help="change the eyes of a running helper")
    for eye in ("profile", *EYES):
        which = "both eyes" if eye == "profile" else f"the {eye} eye"
        change.add_argument(f"--{eye}", metavar="PROFILE", help=f"profile of {which}")
    _add_socket(change)
    install = actions.add_parser("install", help="make the layer known to the loader")
    install.add_argument(
        "--implicit",
        action="store_true",
        help="load it into all OpenXR programs of this user, unless the variable "
        f"{manifest.OFF_VARIABLE} is set",
    )
    actions.add_parser("remove", help="undo install")
    status = actions.add_parser("status", help="report what is installed and running")
    status.add_argument("--json", action="store_true", help="print one JSON object")
    _add_socket(status)
    return parser


def _add_helper_arguments(parser: argparse.ArgumentParser) -> None:
    where = parser.add_argument_group("where and how frames are filtered")
    add_service_arguments(where)
    where.add_argument(
        "--flat-dpt",
        type=a_number,
        default=1.0,
        metavar="D",
        help="distance of everything in programs that submit no depth, 1/m; 0 is "
        "infinity (default: 1)",
    )
    where.add_argument(
        "--wait-ms",
        type=int,
        default=0,
        metavar="MS",
        help="longest wait of the program for the result of each frame (default: 0, "
        "which shows the newest result)",
    )
    where.add_argument(
        "--max-age-ms",
        type=int,
        default=USUAL_AGE_MS,
        metavar="MS",
        help="age up to which a filtered frame is shown; then the program's own is "
        f"(default: {USUAL_AGE_MS})",
    )
    where.add_argument(
        "--split", action="store_true", help="leave the left half unfiltered"
    )
    _add_socket(where)
    where.add_argument(
        "--json", action="store_true", help="print one JSON object at the end"
    )


def _add_socket(parser: Any) -> None:
    parser.add_argument(
        "--socket",
        type=Path,
        default=socket_path(),
        metavar="PATH",
        help=f"socket of the helper (default: ${SOCKET_VARIABLE}, or %(default)s)",
    )


def _checked(options: argparse.Namespace) -> tuple[HelperOptions, FilterSettings]:
    """Check the options before the engine is loaded."""
    if not 0.0 <= options.flat_dpt <= 20.0:
        raise ValueError(f"--flat-dpt is {options.flat_dpt}; allowed: 0 to 20")
    if not 0 <= options.wait_ms <= MAX_WAIT_MS:
        raise ValueError(f"--wait-ms is {options.wait_ms}; allowed: 0 to {MAX_WAIT_MS}")
    if not 1 <= options.max_age_ms <= MAX_WAIT_MS:
        raise ValueError(
            f"--max-age-ms is {options.max_age_ms}; allowed: 1 to {MAX_WAIT_MS}"
        )
    profiles_of(options)
    return (
        HelperOptions(
            options.wait_ms, options.max_age_ms, options.flat_dpt, options.split
        ),
        settings_of(options),
    )


# The helper


@contextlib.contextmanager
def _helper(options: argparse.Namespace) -> Iterator[tuple[LayerHelper, Eyes]]:
    """Return the helper, which listens, and its eyes."""
    helper_options, settings = _checked(options)
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
        eyes = Eyes(options, seeing, look, say)
        helper = LayerHelper(
            seeing, look, say, helper_options, eyes.change, options.socket
        )
        helper.on_gaze = eyes.prepare_for_gaze
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


def _serve(options: argparse.Namespace) -> int:
    ending = _Ending()
    with _helper(options) as (helper, eyes):
        say(f"listening at {options.socket}")
        while not ending.signal:
            helper.run_once(CHECK_S)
            eyes.reread()
        _print_report(helper, options)
    return 0


def _run(options: argparse.Namespace) -> int:
    command = options.program[1:] if options.program[:1] == ["--"] else options.program
    if not command:
        raise ValueError("there is no program; put it after --")
    _checked(options)
    library = manifest.library()
    ending = _Ending()
    with _helper(options) as (helper, eyes), tempfile.TemporaryDirectory() as folder:
        (Path(folder) / f"{manifest.NAME}.json").write_text(
            manifest.manifest("explicit")
        )
        environment = manifest.layered_environment(Path(folder)) | {
            SOCKET_VARIABLE: str(options.socket.resolve())
        }
        program = subprocess.Popen(command, env=environment)
        asked_s = 0.0
        while program.poll() is None:
            helper.run_once(CHECK_S)
            eyes.reread()
            if ending.signal and not asked_s:
                program.send_signal(ending.signal)
                asked_s = time.monotonic()
            elif asked_s and time.monotonic() - asked_s > STOP_S:
                program.kill()
        _print_report(helper, options)
    if helper.n_frames == 0 and not ending.signal:
        say(
            f"no frame arrived: {command[0]} did not load the layer {library}, or has "
            "not submitted frames that can be filtered"
        )
    code = program.returncode
    return 128 - code if code < 0 else code


def _print_report(helper: LayerHelper, options: argparse.Namespace) -> None:
    report = helper.report()
    if options.json:
        sys.stdout.write(json.dumps(report) + "\n")
        return
    say(
        f"{report['filtered']} frames filtered; {report['shown_filtered']} of "
        f"{report['submitted']} frames shown filtered, {report['fallback']} shown "
        "unfiltered after the first of them"
    )
    for name, values in report["stages_ms"].items():
        words = ", ".join(f"{p} {value:g}" for p, value in values.items())
        say(f"  {name.removesuffix('_ms'):10s} {words} ms")


# Other actions


def _set(options: argparse.Namespace) -> int:
    wanted: dict[str, str] = {}
    for eye in EYES:
        text = getattr(options, eye)
        text = options.profile if text is None else text
        if text is not None:
            is_path = Path(text).exists() and not text.lstrip().startswith("{")
            try:
                parse_profile(read_profile(text, f"--{eye}"))
            except ProfileError as error:
                raise ValueError(f"--{eye}: {error}") from None
            wanted[eye] = str(Path(text).resolve()) if is_path else text
    if not wanted:
        raise ValueError("there is no profile; use --profile, --left or --right")
    ask(options.socket, wanted)
    return 0


def _install(options: argparse.Namespace) -> int:
    kind: manifest.Kind = "implicit" if options.implicit else "explicit"
    text = manifest.manifest(kind)
    _remove_all()
    path = manifest.manifest_path(kind)
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_atomically(path, lambda part: part.write_text(text))
    say(f"wrote {path}")
    if options.implicit:
        say(f"all OpenXR programs load it, except with {manifest.OFF_VARIABLE}=1")
    else:
        say(f"to enable it for a program: XR_ENABLE_API_LAYERS={manifest.NAME}")
    say("frames are filtered while `ocufilter layer serve` runs")
    return 0


def _installed() -> list[Path]:
    kinds: tuple[manifest.Kind, ...] = ("explicit", "implicit")
    return [path for path in map(manifest.manifest_path, kinds) if path.exists()]


def _remove_all() -> list[Path]:
    found = _installed()
    for path in found:
        path.unlink()
    return found


def _remove() -> int:
    paths = _remove_all()
    for path in paths:
        say(f"removed {path}")
    if not paths:
        say("the layer was not installed")
    return 0


def _status(options: argparse.Namespace) -> int:
    found: dict[str, Any] = {
        "layer": None,
        "error": None,
        "installed": [],
        "helper": None,
    }
    try:
        found["layer"] = str(manifest.library())
    except manifest.NoLayer as error:
        found["error"] = str(error)
    found["installed"] = [str(path) for path in _installed()]
    with contextlib.suppress(OSError):
        found["helper"] = ask(options.socket, {})
    if options.json:
        sys.stdout.write(json.dumps(found) + "\n")
    else:
        helper = found["helper"]
        lines = [
            f"layer: {found['layer'] or found['error']}",
            f"installed: {', '.join(found['installed']) or 'no'}",
            f"helper: {'none' if helper is None else 'running'} at {options.socket}",
        ]
        if helper is not None:
            lines.append(f"program: {helper['program'] or 'none'}")
            lines.append(f"frames filtered: {helper['filtered']}")
        sys.stdout.write("\n".join(lines) + "\n")
    return 0 if found["layer"] else 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    options = _parser().parse_args(argv)
    try:
        if options.action == "run":
            return _run(options)
        if options.action == "serve":
            return _serve(options)
        if options.action == "set":
            return _set(options)
        if options.action == "install":
            return _install(options)
        if options.action == "remove":
            return _remove()
        return _status(options)
    except ValueError as error:
        say(str(error))
        return 2
    except (FilterError, manifest.NoLayer, OSError) as error:
        say(str(error))
        return 1


if __name__ == "__main__":
    sys.exit(main())
