"""Demo: two scenes streamed through six eyes by a separate service.

`ocufilter demo` runs it.  It writes a video, a contact sheet and latency.json.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import textwrap
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from clients.commands.options import read_size_px
from clients.filter_client import FilterClient, FilteredFrame
from clients.frame_log import FrameLog
from clients.pyrender_stream import path_settings
from clients.scene_renderer import SceneFrame, scene_frames
from clients.scenes.catalog import build_scene
from clients.service_process import ServiceProcess
from clients.sheet import (
    Cell,
    EyeState,
    cell_size_px,
    contact_sheet,
    fitted,
    magnified,
    state_panel,
    video_frame,
    write_video,
)
from clients.streaming import change_eye, filter_in_order
from filter_service.atomic_files import replace_atomically
from filter_service.command_line import CommandFailed, Json, print_json, print_line
from filter_service.errors import FilterError, RenderFailed
from filter_service.messages import State
from filter_service.progress import Progress

if TYPE_CHECKING:
    from PIL import Image

FRAMES_PER_SECOND = 12
DETAIL_CORNERS = {"courtyard": (0.32, 0.19), "primitives": (0.42, 0.30)}
"""Upper left corner of the detail that the contact sheet magnifies, as fractions of the
image's width and height."""

LOG_TAIL_LINES = 12
START_TIMEOUT_S = 180.0  # scenes are rendered meanwhile, on all cores


@dataclass(frozen=True)
class DemoEye:
    """A preset, its title, and two caption lines for each scene."""

    preset: str
    title: str
    look_for: dict[str, tuple[str, str]]


EYES = (
    DemoEye(
        "emmetropia",
        "Emmetropia: no refractive error",
        {
            "courtyard": (
                "Sharp at the fixated distance; the periphery",
                "and the leaves and cup close by are softer.",
            ),
            "primitives": (
                "Focused on the letter, which is sharp.",
                "The ball, 12 to 19 cm away, is soft.",
            ),
        },
    ),
    DemoEye(
        "myopia",
        "Myopia, -6 D",
        {
            "courtyard": (
                "Nothing beyond 16 cm can be sharp: sign and",
                "menus are unreadable, lamps are faint discs.",
            ),
            "primitives": (
                "The ball is sharp, the cube nearly so,",
                "and the letter is lost in blur.",
            ),
        },
    ),
    DemoEye(
        "astigmatism",
        "Astigmatism, with myopia",
        {
            "courtyard": (
                "More blur than myopia, and more across than",
                "up and down: vertical window bars vanish.",
            ),
            "primitives": (
                "Vertical edges and the ends of the bars blur",
                "more than their upper and lower edges.",
            ),
        },
    ),
    DemoEye(
        "keratoconus",
        "Keratoconus",
        {
            "courtyard": (
                "Words stay readable but have a ghost image",
                "below; lamps have tails.",
            ),
            "primitives": (
                "The bars fade above and below, their ends",
                "hardly: the blur is asymmetric.",
            ),
        },
    ),
    DemoEye(
        "cataract",
        "Cataract (wavefront only)",
        {
            "courtyard": (
                "Letters smear downward. The haze of a",
                "cataract is not part of a wavefront.",
            ),
            "primitives": (
                "Upper and lower edges of the bars fade,",
                "vertical edges stay crisp.",
            ),
        },
    ),
    DemoEye(
        "post_lasik",
        "After presbyopic LASIK",
        {
            "courtyard": (
                "The near menu and the far sign are both",
                "readable, a little softer than in emmetropia.",
            ),
            "primitives": (
                "The letter is nearly sharp; the ball close by",
                "is soft, with rings.",
            ),
        },
    ),
)


@dataclass(frozen=True)
class DemoFrame:
    """A rendered frame, the name of its scene, and whether the sheet shows it."""

    scene: str
    rendered: SceneFrame
    is_on_sheet: bool

    @property
    def state(self) -> EyeState:
        """Return the state of the eye, for captions."""
        return EyeState(self.scene.title(), self.rendered.state)


@dataclass
class EyeFilm:
    """Frames filtered through one eye.

    Attributes
    ----------
    small : list of arrays
        All frames in the size of the video's cells.
    full : dict
        The contact sheet's frames by their positions, in full size.
    log : FrameLog
        Statistics of the frames.
    change : dict
        Figures of the change to this eye.
    """

    small: list[NDArray[np.uint8]]
    full: dict[int, FilteredFrame]
    log: FrameLog
    change: dict[str, Any]


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Output folder.")] = Path(
        "out/demo"
    ),
    frames: Annotated[int, typer.Option(min=1, help="Number of frames per eye.")] = 60,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Frame size in px.")
    ] = "480x270",
    json_output: Json = False,
) -> None:
    """Stream two scenes through six eyes and write a video and a contact sheet.

    Starts a separate service and a client that connects to it.  Writes a video (a GIF
    without the package av), contact_sheet.png and latency.json.

    ocufilter demo --out out/demo --frames 24 --size 480x270
    """
    size_px = read_size_px(size)
    out.mkdir(parents=True, exist_ok=True)
    report = run(out, frames, size_px, quiet=json_output)
    if json_output:
        print_json(report)
    else:
        print_line(_summary(report))


def run(
    out: Path, n_frames: int, size_px: tuple[int, int], *, quiet: bool
) -> dict[str, Any]:
    """Render, stream through every eye and write the files; return the report.

    Raises
    ------
    CommandFailed
        If the service does not start, fails during the run or does not reply.
    FilterError
        If the scenes cannot be rendered.
    """
    start_s = time.monotonic()
    with Progress("demo", quiet=quiet) as progress:
        with ServiceProcess(wait=False) as service:  # starts while scenes are rendered
            frames = _rendered(n_frames, size_px, progress)
            progress.task("Waiting for the service")
            server, films = _through(service, frames, size_px, progress)
        video = _written(out, size_px, frames, films, progress)
    report = {
        "machine": {"cpu_count": os.cpu_count(), "platform": platform.platform()},
        "server": server,
        "size_px": list(size_px),
        "frames_per_eye": n_frames,
        "scenes": Counter(frame.scene for frame in frames),
        "eyes": {
            eye.preset: film.log.summary() | {"eye_change": film.change}
            for eye, film in zip(EYES, films, strict=True)
        },
        "video": str(video),
        "contact_sheet": str(out / "contact_sheet.png"),
        "total_s": round(time.monotonic() - start_s, 1),
    }
    text = json.dumps(report, indent=1, allow_nan=False)
    replace_atomically(out / "latency.json", lambda part: part.write_text(text + "\n"))
    return report


def _through(
    service: ServiceProcess,
    frames: list[DemoFrame],
    size_px: tuple[int, int],
    progress: Progress,
) -> tuple[dict[str, Any], list[EyeFilm]]:
    """Stream through every eye; return the service's description and the films."""
    try:
        service.await_ready(START_TIMEOUT_S)
        with FilterClient(service.endpoint, client_name="demo", timeout_s=30) as client:
            assert client.welcome is not None
            server = dict(client.welcome.server)
            return server, _filmed(client, frames, size_px, progress)
    except FilterError as error:
        for line in service.log.splitlines()[-LOG_TAIL_LINES:]:
            sys.stderr.write(f"service: {line}\n")
        text = textwrap.shorten(str(error), 300, placeholder=" ...")
        raise CommandFailed(text) from None
    except RuntimeError as error:  # it did not start; the message ends with its output
        raise CommandFailed(str(error)) from None


def _rendered(
    n_frames: int, size_px: tuple[int, int], progress: Progress
) -> list[DemoFrame]:
    """Render both scenes: two thirds of the frames Courtyard, one third Primitives."""
    n_courtyard = max(1, round(n_frames * 2 / 3))
    task = progress.task("Rendering the scenes", total=n_frames)
    frames = []
    # The sheet shows Courtyard with a wide pupil and far focus (the middle of the path)
    # and Primitives focused on the letter (its beginning).
    for name, count, sheet_index in (
        ("courtyard", n_courtyard, (n_courtyard - 1) // 2),
        ("primitives", n_frames - n_courtyard, 0),
    ):
        if count:
            rendered = scene_frames(build_scene(name), None, count, size_px)
            for index, frame in enumerate(rendered):
                frames.append(DemoFrame(name, frame, index == sheet_index))
                task.advance()
    return frames


def _filmed(
    client: FilterClient,
    frames: list[DemoFrame],
    size_px: tuple[int, int],
    progress: Progress,
) -> list[EyeFilm]:
    """Stream every frame through every eye, continuing while the eye changes."""
    rendered = [frame.rendered for frame in frames]
    settings = path_settings(*{frame.scene for frame in frames})
    films: list[EyeFilm] = []
    for eye in EYES:
        change = change_eye(
            client,
            {"kind": "preset", "name": eye.preset},
            settings=settings,
            frames=rendered,
            has_eye=bool(films),
            on_progress=progress.task(eye.title, total=1.0, unit="%").update,
        )
        task = progress.task(eye.title, total=len(frames))
        film = EyeFilm([], {}, FrameLog(), change)
        answers = filter_in_order(client, rendered, film.log)
        for position, (frame, answer) in enumerate(zip(frames, answers, strict=True)):
            if answer.generation != change["generation"]:
                raise RenderFailed(
                    f"a frame was filtered with generation {answer.generation} "
                    f"after {change['generation']} was ready"
                )
            film.small.append(fitted(answer.color, cell_size_px(size_px)).copy())
            if frame.is_on_sheet:
                film.full[position] = answer
            task.advance()
        films.append(film)
    return films


def _written(
    out: Path,
    size_px: tuple[int, int],
    frames: list[DemoFrame],
    films: list[EyeFilm],
    progress: Progress,
) -> Path:
    """Write the contact sheet and the video; return the video's path."""
    progress.task("Writing the contact sheet")
    cell_px = cell_size_px(size_px)
    sheet = _contact_sheet(frames, films, cell_px)
    replace_atomically(out / "contact_sheet.png", sheet.save)
    task = progress.task("Writing the video", total=len(frames))

    def pages() -> Iterator[NDArray[np.uint8]]:
        for position, frame in enumerate(frames):
            cells = [Cell(fitted(frame.rendered.color, cell_px), "Input")]
            for eye, film in zip(EYES, films, strict=True):
                cells.append(Cell(film.small[position], eye.title))
            yield video_frame(cells, frame.state, frame.rendered.depth_m)
            task.advance()

    return write_video(out / "demo", pages, FRAMES_PER_SECOND)


def _contact_sheet(
    frames: list[DemoFrame], films: list[EyeFilm], cell_px: tuple[int, int]
) -> Image.Image:
    blocks = []
    for position, frame in enumerate(frames):
        if not frame.is_on_sheet:
            continue
        corner = DETAIL_CORNERS[frame.scene]
        lines: tuple[str, ...] = ("The image as rendered:", "sharp at every distance.")
        cells = [_cell(frame.rendered.color, "Input", lines, corner, cell_px)]
        for eye, film in zip(EYES, films, strict=True):
            seen = film.full[position]
            lines = (_used(frame.state, seen), *eye.look_for[frame.scene])
            cells.append(_cell(seen.color, eye.title, lines, corner, cell_px))
        panel = state_panel(cell_px, frame.state, frame.rendered.depth_m)
        lines = ("Below each image: a detail, enlarged.",)
        cells.append(Cell(panel, "Pupil, focus, depth", lines))
        blocks.append((f"{frame.state.scene}: {frame.state.text()}", cells))
    return contact_sheet(blocks, "One frame through six eyes")


def _cell(
    image: NDArray[np.uint8],
    title: str,
    lines: tuple[str, ...],
    corner: tuple[float, float],
    cell_px: tuple[int, int],
) -> Cell:
    detail = magnified(image, corner, cell_px)
    return Cell(fitted(image, cell_px), title, lines, detail)


def _used(requested: EyeState, seen: FilteredFrame) -> str:
    """Describe the state used, which far point and measured pupil may limit."""
    pupil_mm, focus_dpt = seen.pupil_diameter_mm, seen.focus_dpt
    text = EyeState("", State(pupil_mm, focus_dpt)).text()
    if focus_dpt > requested.focus_dpt + 0.05:
        text += " (far point)"
    if pupil_mm < requested.pupil_diameter_mm - 0.05:
        text += " (measured pupil)"
    return text


def _summary(report: dict[str, Any]) -> str:
    folder = Path(report["video"]).parent
    dropped = sum(sum(eye["drops"].values()) for eye in report["eyes"].values())
    ages = [eye["frame_age_ms"]["p50"] for eye in report["eyes"].values()]
    return (
        f"{report['frames_per_eye']} frames through {len(report['eyes'])} eyes in "
        f"{report['total_s']:.0f} s (frame age {min(ages):.0f} to {max(ages):.0f} ms, "
        f"{dropped} dropped): {Path(report['video']).name}, contact_sheet.png and "
        f"latency.json in {folder}"
    )
