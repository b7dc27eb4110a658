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

import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray

from clients.commands.options import read_profile, read_size_px, with_options
from clients.filter_client import FilterClient, FilteredFrame
from clients.frame_log import FrameLog
from clients.natural_eye import (
    USUAL_AGE_YEARS,
    USUAL_WHITE_CD_M2,
    NaturalEye,
    distance_at,
    luminance_cd_m2,
)
from clients.scene_renderer import (
    PATHS,
    Moment,
    SceneFrame,
    back_and_forth,
    path_moments,
    scene_frames,
)
from clients.scenes.catalog import build_scene
from clients.streaming import submit
from filter_service.command_line import (
    CommandFailed,
    Json,
    app_of,
    print_json,
    print_line,
)
from filter_service.command_line import run as run_program
from filter_service.errors import ServiceTimeout
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

SceneName = Literal["courtyard", "primitives"]

Show = Callable[[NDArray[np.uint8], NDArray[np.uint8], str], bool]
Learn = Callable[[float, float], None]


@dataclass(frozen=True, kw_only=True)
class StreamOptions:
    """Options of the command line."""

    endpoint: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Endpoint of the service.")
    ] = DEFAULT_ENDPOINT
    scene: Annotated[
        SceneName | None,
        typer.Option(help=f"Built-in scene; by default {USUAL_SCENE}."),
    ] = None
    file: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="File that trimesh loads, instead of --scene: .glb, .gltf, .obj, "
            ".stl, .ply ...",
        ),
    ] = None
    m_per_unit: Annotated[
        float,
        typer.Option(metavar="M", help="Meters per unit of the file, such as 0.001."),
    ] = 1.0
    renderer: Annotated[
        Literal["own", "pyrender"] | None,
        typer.Option(
            help="Renderer of a built-in scene; by default own.  Files require "
            "pyrender."
        ),
    ] = None
    stereo: Annotated[
        bool, typer.Option("--stereo", help="Render one view for each eye.")
    ] = False
    ipd_mm: Annotated[
        float, typer.Option(metavar="MM", help="Interpupillary distance for --stereo.")
    ] = 63.0
    profile: Annotated[
        str,
        typer.Option(
            help="Preset name, JSON, or a .json, .abp, .csv, .zmx or .txt file."
        ),
    ] = "myopia"
    right_profile: Annotated[
        str | None,
        typer.Option(
            metavar="PROFILE",
            help="Profile of the right eye for --stereo; by default same as --profile.",
        ),
    ] = None
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of a view in px.")] = (
        "480x270"
    )
    frames: Annotated[
        int, typer.Option(help="Number of frames along the path of the camera.")
    ] = 96
    hidden: Annotated[
        bool,
        typer.Option(
            "--hidden",
            help="Also send the hidden layer, the surface behind the visible one; own "
            "renderer only.",
        ),
    ] = False
    window: Annotated[
        bool,
        typer.Option(
            "--window", help="Show a live window; the path repeats until Esc."
        ),
    ] = False
    look_around: Annotated[
        float,
        typer.Option(
            metavar="DEG",
            help="Radius of a circular gaze movement, deg, 0 to "
            f"{MAX_LOOK_AROUND_DEG:g}.",
        ),
    ] = 0.0
    natural: Annotated[
        bool,
        typer.Option(
            "--natural",
            help="Let the focus follow the fixated object, and the pupil the light; "
            "otherwise both follow the path.",
        ),
    ] = False
    age: Annotated[
        float, typer.Option(metavar="YEARS", help="Age of the person for --natural.")
    ] = USUAL_AGE_YEARS

    @property
    def size_px(self) -> tuple[int, int]:
        """Return the width and height of a view in px."""
        return read_size_px(self.size)


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
        gaze_deg = float(h_deg), float(v_deg)
        yield replace(frame, state=replace(frame.state, gaze_deg=gaze_deg))


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
        gaze_deg = frame.state.gaze_deg or STRAIGHT_AHEAD
        distance_m = distance_at(frame.depth_m, camera, gaze_deg)
        vergence_dpt = 0.0 if distance_m is None else 1.0 / distance_m
        light_cd_m2 = luminance_cd_m2(frame.color, white_cd_m2)
        state = eye.look(light_cd_m2, vergence_dpt, clock())
        yield replace(frame, state=replace(state, gaze_deg=frame.state.gaze_deg))


def stream(
    client: FilterClient,
    frames: Iterator[SceneFrame],
    log: FrameLog,
    show: Show | None = None,
    learn: Learn | None = None,
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
    learn : callable, optional
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
    learn: Learn | None,
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
            if learn is not None:
                learn(frame.focus_dpt, event.focus_dpt)
            if show is not None:
                is_open = show(frame.color, event.color, _title(event)) and is_open
    return is_open


def _title(answer: FilteredFrame) -> str:
    header = answer
    return (
        f"ocufilter   pupil {header.pupil_diameter_mm:.1f} mm   "
        f"focus {header.focus_dpt:.2f} dpt   "
        f"gaze {header.gaze_deg[0]:+.0f} {header.gaze_deg[1]:+.0f} deg   "
        f"{answer.age_ms:.0f} ms   (Esc to quit)"
    )


def run(options: StreamOptions) -> dict[str, Any]:
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
        show = _opened_window(options.size_px, stack) if options.window else None
        client = stack.enter_context(
            FilterClient(options.endpoint, client_name="pyrender_stream")
        )
        frames: Iterator[SceneFrame] = stack.enter_context(closing(rendered))
        if reach_deg:
            frames = looking_around(frames, reach_deg)
            settings["gaze_range_deg"] = (reach_deg, 0.5 * reach_deg)
        if eye is not None:
            frames = looking_naturally(frames, eye)
            settings |= NATURAL_RANGES
        first = next(frames)
        if show is not None:
            show(first.color, np.zeros_like(first.color), "ocufilter   preparing")
        for side, profile in profiles.items():
            client.set_profile(profile, eye=side, settings=settings, views=[first.view])
        n_sent = stream(
            client, chain([first], frames), log, show, eye.learn if eye else None
        )
    return {"sent": n_sent, **log.summary()}


def _profiles(options: StreamOptions) -> dict[EyeName, dict[str, Any]]:
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
    options: StreamOptions,
) -> tuple[Generator[SceneFrame, None, None], dict[str, tuple[float, float]]]:
    """Return the frames to stream, and settings that cover their states."""
    ipd_mm = options.ipd_mm if options.stereo else None
    if not 0.0 < options.ipd_mm < np.inf:
        raise ValueError(f"--ipd-mm is {options.ipd_mm:g}; allowed: above 0")
    if options.scene is not None and options.file is not None:
        raise ValueError("--scene and --file: given together; allowed: one of them")
    if options.file is not None and options.renderer == "own":
        raise ValueError("--renderer is own; allowed with --file: pyrender")
    if options.file is None and options.renderer != "pyrender":
        name = options.scene or USUAL_SCENE
        frames = scene_frames(
            build_scene(name),
            None,
            options.frames,
            options.size_px,
            with_hidden=options.hidden,
            repeats=options.window,
            ipd_mm=ipd_mm,
        )
        return frames, path_settings(name)
    if options.hidden:
        raise ValueError(
            "--hidden requires the renderer own; pyrender renders one layer"
        )
    from clients import pyrender_renderer  # which requires pyrender and trimesh

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
            loaded.bounds_m, options.frames, options.size_px
        )
        settings = moment_settings(moments)
    frames = pyrender_renderer.pyrender_frames(
        scene,
        options.size_px,
        camera=camera,
        path=back_and_forth(moments) if options.window else moments,
        ipd_mm=ipd_mm,
        flags=flags,
        infinite_from_m=infinite_from_m,
    )
    return frames, settings


def _opened_window(size_px: tuple[int, int], stack: ExitStack) -> Show:
    """Open a window until the end of the stack; return its method to show images."""
    from clients import window  # which requires glfw

    try:
        return stack.enter_context(window.LiveWindow(size_px, "ocufilter")).show
    except window.NoDisplay as error:
        raise CommandFailed(str(error)) from error


@with_options
def pyrender_stream(options: StreamOptions, json_output: Json = False) -> None:
    """Stream a scene through a running service, as the client of another program.

    python -m clients.pyrender_stream --scene courtyard --profile keratoconus --window

    python -m clients.pyrender_stream --file chair.glb --stereo
    """
    report = run(options)
    if json_output:
        print_json(report)
    else:
        print_line(_report_line(report))


def _report_line(report: dict[str, Any]) -> str:
    age = report["frame_age_ms"]
    dropped = sum(report["drops"].values())
    return (
        f"{report['frames']} of {report['sent']} frames filtered, {dropped} dropped; "
        f"frame age p50 {age['p50']} ms, p99 {age['p99']} ms"
    )


def main() -> None:
    """Run the program."""
    run_program(app_of(pyrender_stream), "pyrender_stream")


if __name__ == "__main__":
    main()
