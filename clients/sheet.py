"""Layout of images with captions: frames of the demo's video and its contact sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

_PAPER, _BAR, _INK, _SOFT, _ACCENT = (
    "#14181c",
    "#1f262d",
    "#f2f4f5",
    "#a9b4bd",
    "#ffc46b",
)
_GAP_PX = 10
MIN_CELL_WIDTH_PX = 320
MAX_CELL_WIDTH_PX = 480


@dataclass(frozen=True)
class Cell:
    """One image and its caption.

    Attributes
    ----------
    image : (h, w, 3) uint8, sRGB
    title : one line
    lines : smaller lines below the title
    detail : a magnified part, drawn below the image; optional
    """

    image: NDArray[np.uint8]
    title: str
    lines: tuple[str, ...] = ()
    detail: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class EyeState:
    """State of the eye at one moment, for captions."""

    scene: str
    pupil_diameter_mm: float
    focus_dpt: float

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
    """Resize an image (h, w, 3) to (width, height), unless it has that size."""
    if image.shape[1::-1] == size_px:
        return image
    picture = Image.fromarray(image)
    return np.asarray(picture.resize(size_px, Image.Resampling.LANCZOS))


def magnified(
    image: NDArray[np.uint8], corner: tuple[float, float], size_px: tuple[int, int]
) -> NDArray[np.uint8]:
    """Return a third of the width and a sixth of the height, enlarged to a strip.

    Parameters
    ----------
    corner : upper left corner in parts of the image's width and height
    size_px : (width, height) of a cell; the strip has its width and half its height.
    """
    height, width = image.shape[:2]
    left, top = round(corner[0] * width), round(corner[1] * height)
    part = image[top : top + max(1, height // 6), left : left + max(1, width // 3)]
    return fitted(part, (size_px[0], size_px[1] // 2))


def video_frame(
    cells: Sequence[Cell], state: EyeState, depth_m: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Return one video frame: every image, and a panel with the state of the eye.

    Width and height are even, as video encoders require.
    """
    size_px = cells[0].image.shape[1::-1]
    panel = Cell(state_panel(size_px, state, depth_m), "Pupil, focus, depth")
    page = _grid([*cells, panel], title=f"ocufilter: {state.scene}", line_px=0)
    return np.asarray(page)


def contact_sheet(
    blocks: Sequence[tuple[str, Sequence[Cell]]], heading: str
) -> Image.Image:
    """Return a page of titled blocks of images, one below the other."""
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
    """Return cells in two rows (one if there are few) below a title."""
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
    """Draw a cell's title and lines into the bar below its image."""
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
    radius = 0.21 * height
    cx, cy = 0.21 * width, 0.30 * height
    _disc(draw, cx, cy, radius, "#4c7a8c")
    _disc(draw, cx, cy, radius * state.pupil_diameter_mm / 8.0, "#050607")
    draw.text(
        (cx, cy + radius + small),
        f"pupil {state.pupil_diameter_mm:.1f} mm",
        fill=_INK, font=_font(small), anchor="mm",
    )  # fmt: skip
    shown = (round(0.46 * width), round(0.46 * height))
    panel.paste(
        _depth_picture(depth_m, shown), (round(0.48 * width), round(0.08 * height))
    )
    draw.text(
        (0.71 * width, cy + radius + small),
        "depth: near is bright",
        fill=_INK, font=_font(small), anchor="mm",
    )  # fmt: skip
    _focus_scale(draw, size_px, state, small)
    return np.asarray(panel)


def _disc(
    draw: ImageDraw.ImageDraw, x: float, y: float, radius: float, color: str
) -> None:
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=color)


def _focus_scale(
    draw: ImageDraw.ImageDraw, size_px: tuple[int, int], state: EyeState, small: int
) -> None:
    """Draw a scale of diopters with a mark at the requested focus."""
    width, height = size_px
    left, right, y = 0.08 * width, 0.92 * width, 0.82 * height
    top_dpt = 4.5
    draw.line((left, y, right, y), fill=_SOFT, width=2)
    for dpt, label in (
        (0, "far"),
        (1, "1 m"),
        (2, "50 cm"),
        (3, "33 cm"),
        (4, "25 cm"),
    ):
        x = left + (right - left) * dpt / top_dpt
        draw.line((x, y - 4, x, y + 4), fill=_SOFT, width=2)
        draw.text((x, y + small), label, fill=_SOFT, font=_font(small), anchor="mm")
    x = left + (right - left) * min(state.focus_dpt, top_dpt) / top_dpt
    draw.polygon([(x, y - 3), (x - 7, y - 15), (x + 7, y - 15)], fill=_ACCENT)
    draw.text(
        ((left + right) / 2, y - 1.9 * small),
        f"focus {state.distance()}",
        fill=_ACCENT, font=_font(small), anchor="mm",
    )  # fmt: skip


def _depth_picture(
    depth_m: NDArray[np.float32], size_px: tuple[int, int]
) -> Image.Image:
    """Return depth as brightness, on a logarithmic scale from 0.15 to 30 m."""
    log = np.log(np.clip(depth_m, 0.15, 30.0) / 30.0) / np.log(0.15 / 30.0)
    return Image.fromarray(np.round(255 * log).astype(np.uint8)).resize(size_px)


def _font(size_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=size_px)


def _fitting_font(
    draw: ImageDraw.ImageDraw, text: str, size_px: int, width_px: int
) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the largest font up to size_px in which a line fits the width."""
    while size_px > 9 and draw.textlength(text, font=_font(size_px)) > width_px:
        size_px -= 1
    return _font(size_px)
