"""Our pictures for the paper's figures 1 and 9 to 12, rendered and kept.

Every figure is one JPEG: a row for each eye and scene, with our whole picture and then
one part of it by every method that the paper's figure compares, each with its error
there.  The reference has the exact PSF of every pixel.  A whole run writes
tests/benchmarks/results/paper_figure_N.jpg, a quick one out/paper/paper_figure_N.jpg.
A row's time is that of all methods and of the reference.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from filter_service.rendering.media_effects import srgb_from_linear
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.field_methods import METHODS, EyeBench, State
from tests.benchmarks.harness import OUT, Row, Run, memory_mb, written_path
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.view_sources import Window
from tests.numerical.scene_frames import scene_view

MINUTES = 6
SIZE, QUICK_SIZE = (640, 360), (320, 180)
STATE = State(5.0, 0.5)
CELL_PX = (240, 135)
LABEL_PX = 20
GAP_PX = 4
JPEG_QUALITY = 78
PAPER, INK = "#ffffff", "#1b2126"
FRAME_RGB = (1.0, 0.35, 0.0)

LOW_ORDER = ("emmetropia", "myopia", "astigmatism")
MIXED = ("keratoconus", "cataract", "post_lasik")
EYE_TITLES = {"post_lasik": "after LASIK"}
SCENE_TITLES = {"primitives": "Primitives", "courtyard": "Courtyard"}

ON_AXIS_METHODS = {
    "Barsky": "Barsky [58]",
    "predecessor": "tiled splats [49]",
    "paper on-axis": "the paper",
    "ours on-axis": "ocufilter",
}
FIELD_METHODS = {
    "Celaya": "Celaya et al. [26]",
    "Gonzalez": "Gonzalez-Utrera [27]",
    "paper quality": "the paper, quality",
    "ours quality": "ocufilter, quality",
}
CORNERS = {
    # of the part that is shown, of width and height; it is a quarter of both
    ("courtyard", True): (0.62, 0.55),
    ("courtyard", False): (0.72, 0.52),
    ("primitives", True): (0.55, 0.38),
    ("primitives", False): (0.68, 0.46),
}


FIGURES = {
    # number: eyes, and whether PSFs are those of the axis
    9: (LOW_ORDER, True),
    10: (MIXED, True),
    11: (LOW_ORDER, False),
    12: (MIXED, False),
}
BY_NAME = {method.name: method for method in METHODS}


@dataclass(frozen=True)
class FigureRow(Row):
    """Errors of an eye and scene by method; ``error`` is ours."""

    figure: int
    eye: str
    scene: str
    psnr_db: dict[str, float]


@dataclass(frozen=True)
class Cell:
    """One small picture (h, w, 3), sRGB, and the line below it."""

    image: NDArray[np.uint8]
    text: str


def row_cells(renderer, eye: str, scene: str, size, *, on_axis: bool):
    """Cells of one eye and scene, and the errors of its methods in dB."""
    width_px, height_px = size
    view = scene_view(scene, width_px=width_px, height_px=height_px)
    bench = EyeBench(renderer, eye, [view])
    left, top = CORNERS[scene, on_axis]
    corner = (round(left * width_px), round(top * height_px))
    window = Window(*corner, width_px // 4, height_px // 4)
    exact = bench.exact_state(STATE, on_axis=on_axis)
    if on_axis:  # quick as a whole, where PSFs are of distance alone
        truth = window.of(dense_reference(view, exact, bins=True))
    else:
        truth = dense_reference(view, exact, bins=False, window=window)
    cells, errors_db = [], {}
    for name, title in (ON_AXIS_METHODS if on_axis else FIELD_METHODS).items():
        color = BY_NAME[name].run(bench, view, STATE, 1)[-1].color
        error_db = channel_psnr_db(window.of(color), truth)
        errors_db[name] = error_db
        cells.append(Cell(_srgb(window.of(color)), f"{title}: {error_db:.1f} dB"))
    title = f"{EYE_TITLES.get(eye, eye)}, {SCENE_TITLES[scene]}"
    whole = Cell(_srgb(_framed(color, window)), title)
    bench.release()
    return [whole, *cells, Cell(_srgb(truth), "exact PSF of every pixel")], errors_db


def first_figure(renderer, size) -> list[list[Cell]]:
    """Figure 1: a very myopic eye, without and with its periphery."""
    view = scene_view("courtyard", width_px=size[0], height_px=size[1])
    bench = EyeBench(renderer, "myopia", [view])
    cells = []
    for name, text in (
        ("ours on-axis", "myopia, the PSFs of its axis everywhere"),
        ("ours quality", "myopia, over the whole visual field"),
    ):
        color = BY_NAME[name].run(bench, view, STATE, 1)[-1].color
        cells.append(Cell(_srgb(color), text))
    bench.release()
    return [cells]


def sheet(rows: list[list[Cell]], cell_px: tuple[int, int]) -> Image.Image:
    """Lay cells out in rows, each with its line below."""
    width_px, height_px = cell_px
    step_x, step_y = width_px + GAP_PX, height_px + LABEL_PX + GAP_PX
    size = (step_x * len(rows[0]) - GAP_PX, step_y * len(rows))
    page = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(page)
    font = ImageFont.load_default(size=13)
    for y, row in enumerate(rows):
        for x, cell in enumerate(row):
            picture = Image.fromarray(cell.image).resize(
                cell_px, Image.Resampling.BICUBIC
            )
            page.paste(picture, (x * step_x, y * step_y))
            place = (x * step_x + 2, y * step_y + height_px + LABEL_PX // 2)
            draw.text(place, cell.text, fill=INK, font=font, anchor="lm")
    return page


def _srgb(linear_rgb: NDArray) -> NDArray[np.uint8]:
    return np.ascontiguousarray(srgb_from_linear(linear_rgb))


def _framed(color: NDArray, window: Window) -> NDArray:
    """Draw a line around the part that is shown large."""
    framed = np.array(color)
    top, left = window.y, window.x
    bottom, right = top + window.height_px, left + window.width_px
    for y in (top, bottom):
        framed[y - 1 : y + 1, left:right] = FRAME_RGB
    for x in (left, right):
        framed[top:bottom, x - 1 : x + 1] = FRAME_RGB
    return framed


def figure_rows(
    number: int, renderer, size: tuple[int, int], out: Path, *, is_quick: bool
) -> Iterator[FigureRow]:
    """Yield the rows of a figure, and write its picture."""
    eyes, on_axis = FIGURES[number]
    rows = []
    for eye, scene in product(eyes[:1] if is_quick else eyes, SCENE_TITLES):
        start_s = time.perf_counter()
        cells, errors_db = row_cells(renderer, eye, scene, size, on_axis=on_axis)
        time_ms = 1e3 * (time.perf_counter() - start_s)
        rows.append(cells)
        ours_db = errors_db["ours on-axis" if on_axis else "ours quality"]
        yield FigureRow(
            *("paper_figures", f"figure {number}", eye, f"{scene} {size[0]}x{size[1]}"),
            *(1, time_ms, time_ms, memory_mb(), "psnr_db", ours_db),
            *("exact PSF of every pixel", number, eye, scene, errors_db),
        )
    _save(sheet(rows, CELL_PX), out, number)


def _save(page: Image.Image, out: Path, number: int) -> None:
    path = out / f"paper_figure_{number}.jpg"
    page.save(path, quality=JPEG_QUALITY, optimize=True)


def measure(run: Run) -> tuple[list[Row], dict[str, list[dict]]]:
    """Return rows, and the size and state of the frames; write the pictures."""
    size = QUICK_SIZE if run.is_quick else SIZE
    out = OUT / "paper" if run.is_quick else written_path(".")
    out.mkdir(parents=True, exist_ok=True)
    renderer = NativeRenderer()
    _save(sheet(first_figure(renderer, size), (640, 360)), out, 1)
    rows: list[Row] = [
        row
        for number in FIGURES
        for row in figure_rows(number, renderer, size, out, is_quick=run.is_quick)
    ]
    return rows, {"frames": [{"size": "{}x{}".format(*size), "state": str(STATE)}]}
