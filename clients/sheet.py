"""Pictures of the demo: images with captions, the contact sheet, and the video.

The video is H.264 in MP4 if PyAV has the encoder, otherwise an animated GIF.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from filter_service.atomic_files import replace_atomically
from filter_service.messages import State, WithState

_PAPER, _BAR, _INK = "#14181c", "#1f262d", "#f2f4f5"
_SOFT, _ACCENT = "#a9b4bd", "#ffc46b"
_GAP_PX = 10
MIN_CELL_WIDTH_PX = 320
MAX_CELL_WIDTH_PX = 480
_MAX_SCALE_DPT = 4.5

_GIF_WIDTH_PX = 1200


@dataclass(frozen=True)
class Cell:
    """An image and its caption.

    Attributes
    ----------
    image : (h, w, 3) uint8
        sRGB.
    title : str
        First line of the caption.
    lines : tuple of str
        Smaller lines below the title.
    detail : array, optional
        A magnified part of the image, drawn below it.
    """

    image: NDArray[np.uint8]
    title: str
    lines: tuple[str, ...] = ()
    detail: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class EyeState(WithState):
    """State of the eye at one moment, for captions."""

    scene: str
    state: State

    def text(self) -> str:
        """Return the state as one line for a caption."""
        return f"pupil {self.pupil_diameter_mm:.1f} mm, focus {self.distance()}"

    def distance(self) -> str:
        """Return the focus distance as text."""
        if self.focus_dpt < 0.02:
            return "far away"
        distance_m = 1 / self.focus_dpt
        if distance_m < 1:
            return f"{100 * distance_m:.0f} cm"
        return f"{distance_m:.1f} m"


def cell_size_px(image_size_px: tuple[int, int]) -> tuple[int, int]:
    """Return the display size of an image (width, height), both even."""
    width, height = image_size_px
    shown = min(max(width, MIN_CELL_WIDTH_PX), MAX_CELL_WIDTH_PX) // 2 * 2
    return shown, max(2, round(shown * height / width / 2) * 2)


def fitted(image: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize an image (h, w, 3) to (width, height) if it has another size."""
    if image.shape[1::-1] == size_px:
        return image
    resized = Image.fromarray(image).resize(size_px, Image.Resampling.LANCZOS)
    return np.asarray(resized)


def magnified(
    image: NDArray[np.uint8], corner: tuple[float, float], size_px: tuple[int, int]
) -> NDArray[np.uint8]:
    """Enlarge a third of the width and a sixth of the height of an image to a strip.

    Parameters
    ----------
    image : (h, w, 3) uint8
        Image to enlarge a part of.
    corner : (float, float)
        Upper left corner, as fractions of the image's width and height.
    size_px : (int, int)
        Width and height of a cell; the strip has its width and half its height.
    """
    height, width = image.shape[:2]
    left, top = round(corner[0] * width), round(corner[1] * height)
    part = image[top : top + max(1, height // 6), left : left + max(1, width // 3)]
    return fitted(part, (size_px[0], size_px[1] // 2))


def video_frame(
    cells: Sequence[Cell], state: EyeState, depth_m: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Return a frame of the video: every image, and a panel with the eye's state.

    Width and height are even, as video encoders require.
    """
    size_px = cells[0].image.shape[1::-1]
    panel = Cell(state_panel(size_px, state, depth_m), "Pupil, focus, depth")
    page = _grid([*cells, panel], title=f"ocufilter: {state.scene}", line_px=0)
    return np.asarray(page)


def contact_sheet(
    blocks: Sequence[tuple[str, Sequence[Cell]]], heading: str
) -> Image.Image:
    """Return a page of blocks of images, each with a title, one below the other."""
    pages = [_grid(cells, title=title, line_px=22) for title, cells in blocks]
    width = max(page.width for page in pages)
    top = 58
    sheet = Image.new("RGB", (width, top + sum(page.height for page in pages)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((_GAP_PX, top / 2 + 4), heading, fill=_INK, font=_font(28), anchor="lm")
    for page in pages:
        sheet.paste(page, (0, top))
        top += page.height
    return sheet


def _grid(cells: Sequence[Cell], *, title: str, line_px: int) -> Image.Image:
    """Arrange cells below a title, in one row of up to three, otherwise in two."""
    columns = len(cells) if len(cells) <= 3 else (len(cells) + 1) // 2
    rows = -(-len(cells) // columns)
    height_px, width_px = cells[0].image.shape[:2]
    n_lines = max(len(cell.lines) for cell in cells) if line_px else 0
    detail_px = max(0 if c.detail is None else len(c.detail) + 2 for c in cells)
    bar_px = 34 + n_lines * line_px
    top_px = 42
    page = Image.new(
        "RGB",
        (
            columns * (width_px + _GAP_PX) + _GAP_PX,
            top_px + rows * (height_px + detail_px + bar_px + _GAP_PX),
        ),
        _PAPER,
    )
    draw = ImageDraw.Draw(page)
    draw.text((_GAP_PX, top_px / 2), title, fill=_ACCENT, font=_font(22), anchor="lm")
    for i, cell in enumerate(cells):
        left = _GAP_PX + i % columns * (width_px + _GAP_PX)
        top = top_px + i // columns * (height_px + detail_px + bar_px + _GAP_PX)
        page.paste(Image.fromarray(cell.image), (left, top))
        top += height_px
        if cell.detail is not None:
            page.paste(Image.fromarray(cell.detail), (left, top + 2))
        top += detail_px
        _caption(draw, cell, (left, top), (width_px, bar_px), line_px)
    return page


def _caption(
    draw: ImageDraw.ImageDraw,
    cell: Cell,
    corner: tuple[int, int],
    size: tuple[int, int],
    line_px: int,
) -> None:
    """Draw a cell's title and lines in the bar below its image."""
    left, top = corner
    draw.rectangle((left, top, left + size[0] - 1, top + size[1] - 1), fill=_BAR)
    draw.text((left + 10, top + 16), cell.title, fill=_INK, font=_font(20), anchor="lm")
    for row, line in enumerate(cell.lines if line_px else ()):
        position = (left + 10, top + 31 + (row + 0.5) * line_px)
        font = _fitting_font(draw, line, 17, size[0] - 20)
        draw.text(position, line, fill=_SOFT, font=font, anchor="lm")


def state_panel(
    size_px: tuple[int, int], state: EyeState, depth_m: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Draw the pupil at its current size, the focus on a scale, and the depth map."""
    width, height = size_px
    panel = Image.new("RGB", size_px, "#0d1013")
    draw = ImageDraw.Draw(panel)
    small = max(10, round(height / 17))

    def label(x: float, y: float, text: str, color: str) -> None:
        draw.text((x, y), text, fill=color, font=_font(small), anchor="mm")

    radius, x, y = 0.21 * height, 0.21 * width, 0.30 * height
    draw.circle((x, y), radius, fill="#4c7a8c")
    draw.circle((x, y), radius * state.pupil_diameter_mm / 8.0, fill="#050607")
    label(x, y + radius + small, f"pupil {state.pupil_diameter_mm:.1f} mm", _INK)
    # Depth as brightness, on a logarithmic scale from 0.15 to 30 m.
    log = np.log(np.clip(depth_m, 0.15, 30.0) / 30.0) / np.log(0.15 / 30.0)
    depth = Image.fromarray(np.round(255 * log).astype(np.uint8))
    depth = depth.resize((round(0.46 * width), round(0.46 * height)))
    panel.paste(depth, (round(0.48 * width), round(0.08 * height)))
    label(0.71 * width, y + radius + small, "depth: near is bright", _INK)
    # A scale of diopters with a mark at the requested focus.
    left, right, y = 0.08 * width, 0.92 * width, 0.82 * height
    pitch = (right - left) / _MAX_SCALE_DPT
    draw.line((left, y, right, y), fill=_SOFT, width=2)
    for dpt, text in enumerate(("far", "1 m", "50 cm", "33 cm", "25 cm")):
        x = left + pitch * dpt
        draw.line((x, y - 4, x, y + 4), fill=_SOFT, width=2)
        label(x, y + small, text, _SOFT)
    x = left + pitch * min(state.focus_dpt, _MAX_SCALE_DPT)
    draw.polygon([(x, y - 3), (x - 7, y - 15), (x + 7, y - 15)], fill=_ACCENT)
    label((left + right) / 2, y - 1.9 * small, f"focus {state.distance()}", _ACCENT)
    return np.asarray(panel)


def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size_px)


def _fitting_font(
    draw: ImageDraw.ImageDraw, text: str, size_px: int, width_px: int
) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the largest font up to size_px in which a line fits the width."""
    while size_px > 9 and draw.textlength(text, font=_font(size_px)) > width_px:
        size_px -= 1
    return _font(size_px)


def write_video(
    stem: Path,
    frames: Callable[[], Iterable[NDArray[np.uint8]]],
    frames_per_second: int,
) -> Path:
    """Write frames to stem.mp4, or to stem.gif without PyAV or a working encoder.

    Parameters
    ----------
    stem : Path
        Path without its suffix.
    frames : callable
        Function that returns the frames (h, w, 3), uint8 sRGB, from the start at each
        call.  Width and height must be even.
    frames_per_second : int
        Frame rate.

    Returns
    -------
    Path
        The file written.
    """
    try:
        from clients.batch import video_writing
    except ModuleNotFoundError:  # PyAV is in the extras
        return _write_gif(stem, frames(), frames_per_second)
    target, segment = stem.with_suffix(".mp4"), stem.with_suffix(".mkv")
    kind, rate_hz = video_writing.VIDEO_KINDS["h264"], frames_per_second
    try:
        video_writing.write_segment(
            segment, enumerate(frames()), kind=kind, rate_hz=rate_hz
        )
        replace_atomically(
            target,
            lambda part: video_writing.join_segments(
                part, [(0, segment)], kind=kind, rate_hz=rate_hz
            ),
        )
        return target
    except (OSError, ValueError, video_writing.EncodingFailed):
        # libx264 is missing or fails
        return _write_gif(stem, frames(), frames_per_second)
    finally:
        segment.unlink(missing_ok=True)


def _write_gif(
    stem: Path, frames: Iterable[NDArray[np.uint8]], frames_per_second: int
) -> Path:
    target = stem.with_suffix(".gif")
    images = []
    for frame in frames:
        image = Image.fromarray(frame)
        image.thumbnail((_GIF_WIDTH_PX, _GIF_WIDTH_PX))
        images.append(image.quantize(128))
    replace_atomically(
        target,
        lambda part: images[0].save(
            part,
            save_all=True,
            append_images=images[1:],
            duration=round(1000 / frames_per_second),
            loop=0,
        ),
    )
    return target
