"""The demo: two scenes streamed through six eyes by its own service.

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
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clients.arguments import size_px_argument
from clients.demo_eyes import EYES
from clients.extra import what_to_install
from clients.filter_client import FilterClient, FilteredFrame
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
from filter_service.errors import FilterError, RenderFailed
from filter_service.progress import Progress

if TYPE_CHECKING:
    from PIL import Image

try:
    from clients.frame_log import FrameLog
    from clients.pyrender_stream import path_settings
    from clients.scene_renderer import SceneFrame, scene_frames
    from clients.scenes.catalog import build_scene
    from clients.streaming import change_eye, filter_in_order
    from clients.video import write_video
except ModuleNotFoundError as error:
    if __name__ != "__main__":
        raise
    sys.exit(f"demo: {what_to_install(error)}")

FRAMES_PER_SECOND = 12
# Upper left corner of the detail that the sheet magnifies, in parts of width, height.
DETAIL_CORNERS = {"courtyard": (0.32, 0.19), "primitives": (0.42, 0.30)}
LOG_TAIL_LINES = 12
START_TIMEOUT_S = 180.0  # a slow machine's first start compiles


class DemoFailed(Exception):
    """The service failed; the message gives the reason and the last output."""


@dataclass(frozen=True)
class Shot:
    """The rendered frames of one scene, and the index of the one on the sheet."""

    scene: str
    frames: list[SceneFrame]
    sheet_index: int


@dataclass
class EyeFilm:
    """Frames filtered through one eye: small images, and the sheet's in full size."""

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
    except DemoFailed as error:
        sys.stderr.write(f"demo: {error}\n")
        return 1
    sys.stdout.write(json.dumps(report) + "\n" if options.json else _summary(report))
    return 0


def _arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m clients.demo", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR")
    parser.add_argument("--frames", type=int, default=60, help="frames for each eye")
    parser.add_argument(
        "--size", type=size_px_argument, default="480x270", metavar="WxH"
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
        If the service does not start, fails during the run or does not answer.
    """
    start_s = time.monotonic()
    with Progress("demo", quiet=options.json) as progress:
        with _service() as service:  # starts while the scenes are rendered
            shots = _rendered(options, progress)
            progress.task("Waiting for the service")
            _await_ready(service)
            server, films = _through(service, shots, options.size, progress)
        video = _written(options, shots, films, progress)
    report = {
        "machine": {"cpu_count": os.cpu_count(), "platform": platform.platform()},
        "server": server,
        "size_px": list(options.size),
        "frames_per_eye": options.frames,
        "scenes": {shot.scene: len(shot.frames) for shot in shots},
        "eyes": {
            eye.preset: film.log.summary() | {"eye_change": film.change}
            for eye, film in zip(EYES, films, strict=True)
        },
        "video": str(video),
        "contact_sheet": str(options.out / "contact_sheet.png"),
        "total_s": round(time.monotonic() - start_s, 1),
    }
    text = json.dumps(report, indent=1, allow_nan=False)
    (options.out / "latency.json").write_text(text + "\n", encoding="utf-8")
    return report


def _service() -> ServiceProcess:
    """Start a service on a free port of this machine."""
    return ServiceProcess(wait=False)


def _await_ready(service: ServiceProcess) -> None:
    try:
        service.await_ready(START_TIMEOUT_S)
    except RuntimeError as error:  # the message ends with the service's output
        raise DemoFailed(str(error)) from None


def _through(
    service: ServiceProcess,
    shots: list[Shot],
    size_px: tuple[int, int],
    progress: Progress,
) -> tuple[dict[str, Any], list[EyeFilm]]:
    """Stream through every eye; return the service's description and the films."""
    try:
        with FilterClient(service.endpoint, client_name="demo", timeout_s=30) as client:
            assert client.welcome is not None
            server = dict(client.welcome.server)
            return server, _filmed(client, shots, size_px, progress)
    except FilterError as error:
        tail = "\n".join(service.log.splitlines()[-LOG_TAIL_LINES:])
        text = textwrap.shorten(str(error), 300, placeholder=" ...")
        raise DemoFailed(f"{text}\nThe service's last lines:\n{tail}") from None


def _rendered(options: argparse.Namespace, progress: Progress) -> list[Shot]:
    """Render both scenes: two thirds of the frames Courtyard, one third Primitives."""
    n_courtyard = max(1, round(options.frames * 2 / 3))
    task = progress.task("Rendering the scenes", total=options.frames)
    shots = []
    # The sheet shows the courtyard with a wide pupil and far focus (middle of the path)
    # and the primitives focused on the letter.
    for name, count, share in (
        ("courtyard", n_courtyard, 0.5),
        ("primitives", options.frames - n_courtyard, 0.0),
    ):
        if count == 0:
            continue
        frames = []
        for frame in scene_frames(build_scene(name), None, count, options.size):
            frames.append(frame)
            task.advance()
        shots.append(Shot(name, frames, int(share * (count - 1))))
    return shots


def _filmed(
    client: FilterClient,
    shots: list[Shot],
    size_px: tuple[int, int],
    progress: Progress,
) -> list[EyeFilm]:
    """Stream every frame through every eye, continuing while the eye changes."""
    frames = [frame for shot in shots for frame in shot.frames]
    settings = path_settings(*(shot.scene for shot in shots))
    films: list[EyeFilm] = []
    for eye in EYES:
        task = progress.task(eye.title, total=1.0, unit="%")
        change = change_eye(
            client,
            {"kind": "preset", "name": eye.preset},
            settings=settings,
            frames=frames,
            has_eye=bool(films),
            on_progress=task.update,
        )
        task = progress.task(eye.title, total=len(frames))
        film = EyeFilm([], {}, FrameLog(), change.summary())
        wanted = _sheet_positions(shots)
        cell_px = cell_size_px(size_px)
        stream = filter_in_order(client, frames, film.log)
        for position, (_, answer) in enumerate(stream):
            if answer.header.generation != change.generation:
                raise RenderFailed(
                    f"a frame came back with generation {answer.header.generation} "
                    f"after {change.generation} was ready"
                )
            film.small.append(fitted(answer.color, cell_px).copy())
            if position in wanted:
                film.full[position] = answer
            task.advance()
        films.append(film)
    return films


def _sheet_positions(shots: list[Shot]) -> list[int]:
    """Return the positions of the sheet's frames among all frames."""
    starts = np.cumsum([0, *(len(shot.frames) for shot in shots)])
    return [
        int(start) + shot.sheet_index
        for start, shot in zip(starts, shots, strict=False)
    ]


def _written(
    options: argparse.Namespace,
    shots: list[Shot],
    films: list[EyeFilm],
    progress: Progress,
) -> Path:
    """Write the contact sheet and the video; return the video's path."""
    progress.task("Writing the contact sheet")
    _contact_sheet(shots, films, options.size).save(options.out / "contact_sheet.png")
    n_frames = sum(len(shot.frames) for shot in shots)
    task = progress.task("Writing the video", total=n_frames)

    def pages() -> Iterator[NDArray[np.uint8]]:
        for page in _video_pages(shots, films, options.size):
            yield page
            task.advance()

    return write_video(options.out / "demo", pages, FRAMES_PER_SECOND)


def _video_pages(
    shots: list[Shot], films: list[EyeFilm], size_px: tuple[int, int]
) -> Iterator[NDArray[np.uint8]]:
    cell_px = cell_size_px(size_px)
    position = 0
    for shot in shots:
        for frame in shot.frames:
            cells = [Cell(fitted(frame.color, cell_px), "Input")]
            for eye, film in zip(EYES, films, strict=True):
                cells.append(Cell(film.small[position], eye.title))
            yield video_frame(cells, _state(shot, frame), frame.depth_m)
            position += 1


def _state(shot: Shot, frame: SceneFrame) -> EyeState:
    return EyeState(shot.scene.title(), frame.pupil_diameter_mm, frame.focus_dpt)


def _contact_sheet(
    shots: list[Shot], films: list[EyeFilm], size_px: tuple[int, int]
) -> Image.Image:
    blocks = []
    for shot, position in zip(shots, _sheet_positions(shots), strict=True):
        frame = shot.frames[shot.sheet_index]
        state = _state(shot, frame)
        cells = [
            Cell(
                frame.color,
                "Input",
                ("The picture as rendered:", "sharp at every distance."),
            )
        ]
        for eye, film in zip(EYES, films, strict=True):
            answer = film.full[position]
            used = replace(
                state,
                pupil_diameter_mm=answer.header.pupil_diameter_mm,
                focus_dpt=answer.header.focus_dpt,
            )
            cells.append(
                Cell(
                    answer.color,
                    eye.title,
                    (_used(state, used), *eye.look_for[shot.scene]),
                )
            )
        cell_px = cell_size_px(size_px)
        cells = [
            replace(
                cell,
                image=fitted(cell.image, cell_px),
                detail=magnified(cell.image, DETAIL_CORNERS[shot.scene], cell_px),
            )
            for cell in cells
        ]
        panel = state_panel(cell_px, state, frame.depth_m)
        cells.append(
            Cell(
                panel, "Pupil, focus, depth", ("Below each picture: a part, enlarged.",)
            )
        )
        blocks.append((f"{state.scene}: {state.text()}", cells))
    return contact_sheet(blocks, "What six eyes see of the same frame")


def _used(asked: EyeState, used: EyeState) -> str:
    """Describe the state used, which far point and measured pupil may limit."""
    text = used.text()
    if used.focus_dpt > asked.focus_dpt + 0.05:
        text += " at the farthest"
    if used.pupil_diameter_mm < asked.pupil_diameter_mm - 0.05:
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
