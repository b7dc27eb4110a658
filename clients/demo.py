"""Demo: two scenes streamed through six eyes by a service of its own.

`ocufilter demo` runs it.  It writes a video, a contact sheet and latency.json.
"""

from __future__ import annotations

import argparse
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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clients.arguments import size_px_argument
from clients.demo_eyes import EYES
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
)
from clients.streaming import change_eye, filter_in_order
from clients.video import write_video
from filter_service.atomic_files import replace_atomically
from filter_service.errors import FilterError, RenderFailed
from filter_service.progress import Progress

if TYPE_CHECKING:
    from PIL import Image

FRAMES_PER_SECOND = 12
DETAIL_CORNERS = {"courtyard": (0.32, 0.19), "primitives": (0.42, 0.30)}
"""Upper left corner of the detail that the contact sheet magnifies, as fractions of the
image's width and height."""

LOG_TAIL_LINES = 12
START_TIMEOUT_S = 180.0  # scenes are rendered meanwhile, on all cores


class DemoFailed(Exception):
    """The demo could not run; the message gives the reason."""


@dataclass(frozen=True)
class DemoFrame:
    """A rendered frame, the name of its scene, and whether the sheet shows it."""

    scene: str
    rendered: SceneFrame
    is_on_sheet: bool

    @property
    def state(self) -> EyeState:
        """Return the state of the eye, for captions."""
        pupil_mm, focus_dpt = self.rendered.pupil_diameter_mm, self.rendered.focus_dpt
        return EyeState(self.scene.title(), pupil_mm, focus_dpt)


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


def main(argv: list[str] | None = None) -> int:
    """Run the demo; return its exit code."""
    options = _arguments(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        report = run(options)
    except (DemoFailed, FilterError) as error:
        sys.stderr.write(f"demo: {error}\n")
        return 1
    sys.stdout.write(json.dumps(report) + "\n" if options.json else _summary(report))
    return 0


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m clients.demo", description=__doc__.split("\n")[0]
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        metavar="DIR",
        help="output folder",
    )
    parser.add_argument("--frames", type=int, default=60, help="frames for each eye")
    parser.add_argument(
        "--size",
        type=size_px_argument,
        default="480x270",
        metavar="WxH",
        help="frame size in px",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args(argv)
    if options.frames < 1:
        parser.error(f"--frames {options.frames}; allowed: 1 or more")
    return options


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Render, stream through every eye and write the files; return the report.

    Raises
    ------
    DemoFailed
        If the service does not start, fails during the run or does not reply.
    FilterError
        If the scenes cannot be rendered.
    """
    start_s = time.monotonic()
    with Progress("demo", quiet=options.json) as progress:
        with ServiceProcess(wait=False) as service:  # starts while scenes are rendered
            frames = _rendered(options, progress)
            progress.task("Waiting for the service")
            server, films = _through(service, frames, options.size, progress)
        video = _written(options, frames, films, progress)
    report = {
        "machine": {"cpu_count": os.cpu_count(), "platform": platform.platform()},
        "server": server,
        "size_px": list(options.size),
        "frames_per_eye": options.frames,
        "scenes": Counter(frame.scene for frame in frames),
        "eyes": {
            eye.preset: film.log.summary() | {"eye_change": film.change}
            for eye, film in zip(EYES, films, strict=True)
        },
        "video": str(video),
        "contact_sheet": str(options.out / "contact_sheet.png"),
        "total_s": round(time.monotonic() - start_s, 1),
    }
    text = json.dumps(report, indent=1, allow_nan=False)
    replace_atomically(
        options.out / "latency.json", lambda part: part.write_text(text + "\n")
    )
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
        tail = "\n".join(service.log.splitlines()[-LOG_TAIL_LINES:])
        text = textwrap.shorten(str(error), 300, placeholder=" ...")
        raise DemoFailed(f"{text}\nThe last lines of the service:\n{tail}") from None
    except RuntimeError as error:  # it did not start; the message ends with its output
        raise DemoFailed(str(error)) from None


def _rendered(options: argparse.Namespace, progress: Progress) -> list[DemoFrame]:
    """Render both scenes: two thirds of the frames Courtyard, one third Primitives."""
    n_courtyard = max(1, round(options.frames * 2 / 3))
    task = progress.task("Rendering the scenes", total=options.frames)
    frames = []
    # The sheet shows Courtyard with a wide pupil and far focus (the middle of the path)
    # and Primitives focused on the letter (its beginning).
    for name, count, sheet_index in (
        ("courtyard", n_courtyard, (n_courtyard - 1) // 2),
        ("primitives", options.frames - n_courtyard, 0),
    ):
        if count:
            rendered = scene_frames(build_scene(name), None, count, options.size)
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
            if answer.header.generation != change["generation"]:
                raise RenderFailed(
                    f"a frame was filtered with generation {answer.header.generation} "
                    f"after {change['generation']} was ready"
                )
            film.small.append(fitted(answer.color, cell_size_px(size_px)).copy())
            if frame.is_on_sheet:
                film.full[position] = answer
            task.advance()
        films.append(film)
    return films


def _written(
    options: argparse.Namespace,
    frames: list[DemoFrame],
    films: list[EyeFilm],
    progress: Progress,
) -> Path:
    """Write the contact sheet and the video; return the video's path."""
    progress.task("Writing the contact sheet")
    cell_px = cell_size_px(options.size)
    sheet = _contact_sheet(frames, films, cell_px)
    replace_atomically(options.out / "contact_sheet.png", sheet.save)
    task = progress.task("Writing the video", total=len(frames))

    def pages() -> Iterator[NDArray[np.uint8]]:
        for position, frame in enumerate(frames):
            cells = [Cell(fitted(frame.rendered.color, cell_px), "Input")]
            for eye, film in zip(EYES, films, strict=True):
                cells.append(Cell(film.small[position], eye.title))
            yield video_frame(cells, frame.state, frame.rendered.depth_m)
            task.advance()

    return write_video(options.out / "demo", pages, FRAMES_PER_SECOND)


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
    pupil_mm, focus_dpt = seen.header.pupil_diameter_mm, seen.header.focus_dpt
    text = EyeState("", pupil_mm, focus_dpt).text()
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
        f"latency.json in {folder}\n"
    )


if __name__ == "__main__":
    sys.exit(main())
