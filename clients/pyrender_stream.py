"""Stream a scene through a running filter service, as a game or a viewer would.

    ocufilter serve &
    python -m clients.pyrender_stream --scene courtyard --profile keratoconus --window
    python -m clients.pyrender_stream --file chair.glb --stereo

pyrender renders files (glTF, OBJ, STL, PLY and others that trimesh loads); either
renderer renders the built-in scenes.  `clients.pyrender_renderer` streams any
`pyrender.Scene` of another program.

The program renders and sends frames without waiting for replies.  The newest frame
replaces one that waits to be sent.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.arguments import read_profile, size_px_argument
from clients.extra import PYRENDER_INSTALL, what_to_install
from clients.filter_client import FilterClient, FilteredFrame
from clients.frame_log import FrameLog
from clients.natural_eye import (
    USUAL_AGE_YEARS,
    USUAL_WHITE_CD_M2,
    NaturalEye,
    distance_at,
    luminance_cd_m2,
)
from clients.option_values import a_number
from clients.scene_renderer import (
    PATHS,
    Moment,
    SceneFrame,
    back_and_forth,
    path_moments,
    scene_frames,
)
from clients.scenes.catalog import SCENE_BUILDERS, build_scene
from clients.streaming import submit
from filter_service.errors import FilterError, ServiceTimeout
from filter_service.messages import (
    DEFAULT_ENDPOINT,
    Camera,
    Dropped,
    ErrorReply,
    EyeName,
)

FRAMES_PER_ROUND = 60
MAX_LOOK_AROUND_DEG = 30.0
STRAIGHT_AHEAD = (0.0, 0.0)
NATURAL_RANGES = {"pupil_range_mm": (2.0, 8.0), "focus_range_dpt": (0.0, 8.5)}
USUAL_SCENE = "courtyard"
USUAL_IPD_MM = 63.0

Show = Callable[[NDArray[np.uint8], NDArray[np.uint8], str], bool]
Learn = Callable[[float, float], None]


class CannotRun(Exception):
    """A package or a display is missing."""


def path_settings(*scene_names: str) -> dict[str, tuple[float, float]]:
    """Return settings that cover the pupils and foci on the paths of scenes."""
    return moment_settings(
        [m for name in scene_names for m in path_moments(PATHS[name], 200)]
    )


def moment_settings(moments: Sequence[Moment]) -> dict[str, tuple[float, float]]:
    """Return settings that cover the pupils and foci of moments."""
    pupils_mm = [moment.pupil_diameter_mm for moment in moments]
    foci_dpt = [moment.focus_dpt for moment in moments]
    # The nearest object in a scene is at 0.12 m; the margins allow for rounding.
    return {
        "pupil_range_mm": (min(pupils_mm) - 0.01, max(pupils_mm) + 0.01),
        "focus_range_dpt": (max(min(foci_dpt) - 0.01, 0.0), max(foci_dpt) + 0.01),
        "object_range_dpt": (0.0, 8.5),
    }


def looking_around(
    frames: Iterator[SceneFrame], reach_deg: float
) -> Generator[SceneFrame, None, None]:
    """Move the gaze on an ellipse, twice as far to the sides as up and down."""
    for number, frame in enumerate(frames):
        turn = 2 * np.pi * number / FRAMES_PER_ROUND
        h_deg, v_deg = reach_deg * np.sin(turn), 0.5 * reach_deg * np.cos(turn)
        yield replace(frame, gaze_deg=(float(h_deg), float(v_deg)))


def looking_naturally(
    frames: Iterator[SceneFrame],
    eye: NaturalEye,
    *,
    white_cd_m2: float = USUAL_WHITE_CD_M2,
    clock: Callable[[], float] = time.monotonic,
) -> Generator[SceneFrame, None, None]:
    """Make the focus follow the fixated object, and the pupil follow the light."""
    for frame in frames:
        height_px, width_px = frame.depth_m.shape
        camera = Camera(width_px, height_px, frame.tangents)
        distance_m = distance_at(
            frame.depth_m, camera, frame.gaze_deg or STRAIGHT_AHEAD
        )
        light_cd_m2 = luminance_cd_m2(frame.color, white_cd_m2)
        vergence_dpt = 0.0 if distance_m is None else 1.0 / distance_m
        state = eye.look(light_cd_m2, vergence_dpt, clock())
        yield replace(
            frame,
            pupil_diameter_mm=state.pupil_diameter_mm,
            focus_dpt=state.focus_dpt,
        )


def stream(
    client: FilterClient,
    frames: Iterator[SceneFrame],
    log: FrameLog,
    show: Show | None = None,
    learn: Learn = lambda asked_dpt, used_dpt: None,
) -> int:
    """Submit frames as they are rendered until they end or the window closes.

    Parameters
    ----------
    client : FilterClient
        Connected client with a profile.
    frames : iterator of SceneFrame
        Frames to submit.
    log : FrameLog
        Receives the statistics of the frames.
    show : callable, optional
        Called with (input, filtered, title) for each result; False ends the stream.
    learn : callable
        Called with the focus that a frame requested and the focus that was used.

    Returns
    -------
    int
        Number of frames submitted.

    Raises
    ------
    FilterError
        If the service rejects a frame or stops responding.
    """
    sent: dict[int, SceneFrame] = {}
    n_sent = 0
    for frame in frames:
        sent[submit(client, frame)] = frame
        n_sent += 1
        if not _handle_replies(client, sent, log, show, learn, timeout_s=0.0):
            return n_sent
    while client.n_unanswered:
        timeout_s = client.timeout_s
        if not _handle_replies(client, sent, log, show, learn, timeout_s=timeout_s):
            break
    return n_sent


def _handle_replies(
    client: FilterClient,
    sent: dict[int, SceneFrame],
    log: FrameLog,
    show: Show | None,
    learn: Learn,
    *,
    timeout_s: float,
) -> bool:
    """Handle the replies so far; return whether the window is still open."""
    events = client.poll(timeout_s)
    if not events and timeout_s:
        raise ServiceTimeout(f"no reply to a frame within {timeout_s:g} s")
    is_open = True
    for event in events:
        if isinstance(event, ErrorReply):
            raise event.exception()
        if isinstance(event, Dropped):
            log.drops[event.reason] += 1
            sent.pop(event.frame_id, None)
        elif isinstance(event, FilteredFrame):
            log.add(event)
            frame = sent.pop(event.frame_id)
            learn(frame.focus_dpt, event.header.focus_dpt)
            if show is not None:
                is_open = show(frame.color, event.color, _title(event)) and is_open
    return is_open


def _title(answer: FilteredFrame) -> str:
    header = answer.header
    return (
        f"ocufilter   pupil {header.pupil_diameter_mm:.1f} mm   "
        f"focus {header.focus_dpt:.2f} dpt   "
        f"gaze {header.gaze_deg[0]:+.0f} {header.gaze_deg[1]:+.0f} deg   "
        f"{answer.age_ms:.0f} ms   (Esc to quit)"
    )


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m clients.pyrender_stream", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--endpoint", default=DEFAULT_ENDPOINT)
    source = parser.add_mutually_exclusive_group()
    source.add_argument(
        "--scene",
        choices=sorted(SCENE_BUILDERS),
        help=f"built-in scene (default: {USUAL_SCENE})",
    )
    source.add_argument(
        "--file", help="file that trimesh loads: .glb, .gltf, .obj, .stl, .ply ..."
    )
    parser.add_argument(
        "--m-per-unit",
        default=1.0,
        type=a_number,
        metavar="M",
        help="meters per unit of the file, such as 0.001 (default: 1)",
    )
    parser.add_argument(
        "--renderer",
        choices=("own", "pyrender"),
        help="renderer of a built-in scene (default: own); files require pyrender",
    )
    parser.add_argument(
        "--stereo", action="store_true", help="render one view for each eye"
    )
    parser.add_argument(
        "--ipd-mm",
        default=USUAL_IPD_MM,
        type=a_number,
        metavar="MM",
        help=f"interpupillary distance, for --stereo (default: {USUAL_IPD_MM:g})",
    )
    parser.add_argument(
        "--profile",
        default="myopia",
        help="preset name, JSON, or a .json, .abp, .csv or .zmx file",
    )
    parser.add_argument(
        "--right-profile",
        metavar="PROFILE",
        help="profile of the right eye, for --stereo (default: that of --profile)",
    )
    parser.add_argument(
        "--size", default="480x270", type=size_px_argument, metavar="WxH"
    )
    parser.add_argument(
        "--frames", default=96, type=int, help="number of frames along the path"
    )
    parser.add_argument(
        "--hidden",
        action="store_true",
        help="also send the hidden layer, the surface behind the visible one "
        "(own renderer only)",
    )
    parser.add_argument(
        "--window",
        action="store_true",
        help="show a live window; the path repeats until Esc",
    )
    parser.add_argument(
        "--look-around",
        default=0.0,
        type=a_number,
        metavar="DEG",
        help=f"radius of a circular gaze movement, 0 to {MAX_LOOK_AROUND_DEG:g}",
    )
    parser.add_argument(
        "--natural",
        action="store_true",
        help="make the focus follow the fixated object and the pupil the light "
        "(default: both follow the path)",
    )
    parser.add_argument(
        "--age",
        default=USUAL_AGE_YEARS,
        type=a_number,
        metavar="YEARS",
        help=f"age of the person, for --natural (default: {USUAL_AGE_YEARS:g})",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    return parser.parse_args(argv)


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Connect and stream; return a summary of the frames."""
    reach_deg = options.look_around
    if not 0.0 <= reach_deg <= MAX_LOOK_AROUND_DEG:
        raise ValueError(
            f"--look-around is {reach_deg:g}; allowed: 0 to {MAX_LOOK_AROUND_DEG:g} deg"
        )
    eye = NaturalEye(age_years=options.age) if options.natural else None
    profiles = _profiles(options)
    rendered, settings = _source(options)
    log = FrameLog()
    with ExitStack() as stack:
        show = _opened_window(options.size, stack) if options.window else None
        client = stack.enter_context(
            FilterClient(options.endpoint, client_name="pyrender_stream")
        )
        frames: Iterator[SceneFrame] = stack.enter_context(closing(rendered))
        if reach_deg:
            frames = looking_around(frames, reach_deg)
            settings["gaze_range_deg"] = (reach_deg, 0.5 * reach_deg)
        learn: dict[str, Learn] = {}
        if eye is not None:
            frames = looking_naturally(frames, eye)
            settings |= NATURAL_RANGES
            learn = {"learn": eye.learn}
        first = next(frames)
        if show is not None:
            show(first.color, np.zeros_like(first.color), "ocufilter   preparing")
        for side, profile in profiles.items():
            client.set_profile(profile, eye=side, settings=settings, views=[first.view])
        n_sent = stream(client, chain([first], frames), log, show, **learn)
    return {"sent": n_sent, **log.summary()}


def _profiles(options: argparse.Namespace) -> dict[EyeName, dict[str, Any]]:
    """Return the profile of each eye."""
    profile = read_profile(options.profile)
    if not options.stereo:
        if options.right_profile is not None:
            raise ValueError("--right-profile requires --stereo")
        return {"both": profile}
    if options.right_profile is None:
        return {"left": profile, "right": profile}
    right = read_profile(options.right_profile, "--right-profile")
    return {"left": profile, "right": right}


def _source(
    options: argparse.Namespace,
) -> tuple[Generator[SceneFrame, None, None], dict[str, tuple[float, float]]]:
    """Return the frames to stream, and settings that cover their states."""
    ipd_mm = options.ipd_mm if options.stereo else None
    if not 0.0 < options.ipd_mm < np.inf:
        raise ValueError(f"--ipd-mm is {options.ipd_mm:g}; allowed: above 0")
    if options.file is not None and options.renderer == "own":
        raise ValueError("--renderer is own; allowed with --file: pyrender")
    if options.file is None and options.renderer != "pyrender":
        name = options.scene or USUAL_SCENE
        frames = scene_frames(
            build_scene(name),
            None,
            options.frames,
            options.size,
            with_hidden=options.hidden,
            repeats=options.window,
            ipd_mm=ipd_mm,
        )
        return frames, path_settings(name)
    if options.hidden:
        raise ValueError(
            "--hidden requires the renderer own; pyrender renders one layer"
        )
    try:
        from clients import pyrender_renderer
    except ModuleNotFoundError as error:
        raise CannotRun(what_to_install(error, PYRENDER_INSTALL)) from None
    flags, infinite_from_m = 0, np.inf
    if options.file is None:
        built = build_scene(options.scene or USUAL_SCENE)
        scene, camera = pyrender_renderer.built_in(built)
        moments = path_moments(PATHS[built.name], options.frames)
        flags, infinite_from_m = pyrender_renderer.BUILT_IN_FLAGS, built.infinite_from_m
        settings = path_settings(built.name)
    else:
        loaded = pyrender_renderer.load_file(
            options.file, m_per_unit=options.m_per_unit
        )
        scene = loaded.scene
        camera, moments = pyrender_renderer.orbit(
            loaded.bounds_m, options.frames, options.size
        )
        settings = moment_settings(moments)
    frames = pyrender_renderer.pyrender_frames(
        scene,
        options.size,
        camera=camera,
        path=back_and_forth(moments) if options.window else moments,
        ipd_mm=ipd_mm,
        flags=flags,
        infinite_from_m=infinite_from_m,
    )
    return frames, settings


def _opened_window(size_px: tuple[int, int], stack: ExitStack) -> Show:
    """Open a window until the end of the stack; return its method to show images."""
    try:
        from clients import window  # which requires glfw
    except ModuleNotFoundError as error:
        raise CannotRun(what_to_install(error)) from error
    try:
        return stack.enter_context(window.LiveWindow(size_px, "ocufilter")).show
    except window.NoDisplay as error:
        raise CannotRun(str(error)) from error


def main(argv: list[str] | None = None) -> int:
    """Run the program; return its exit code."""
    options = _arguments(argv)
    try:
        report = run(options)
    except ValueError as error:
        sys.stderr.write(f"pyrender_stream: {error}\n")
        return 2
    except (FilterError, CannotRun) as error:
        sys.stderr.write(f"pyrender_stream: {error}\n")
        return 1
    text = json.dumps(report) + "\n" if options.json else _report_line(report)
    sys.stdout.write(text)
    return 0


def _report_line(report: dict[str, Any]) -> str:
    age = report["frame_age_ms"]
    dropped = sum(report["drops"].values())
    return (
        f"{report['frames']} of {report['sent']} frames filtered, {dropped} dropped; "
        f"frame age p50 {age['p50']} ms, p99 {age['p99']} ms\n"
    )


if __name__ == "__main__":
    sys.exit(main())
