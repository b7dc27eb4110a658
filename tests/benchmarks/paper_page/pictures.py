"""Our pictures for the paper's figures 1 and 9 to 12, rendered and kept.

    python -m tests.benchmarks.paper_page.pictures [--quick] [--out DIR]

Every figure is one JPEG: a row for each eye and scene, with our whole picture and then
one part of it by every method that the paper's figure compares, each with its error
there.  The reference has the exact PSF of every pixel.  A whole run takes some
six minutes of two cores and writes tests/benchmarks/results/paper_figure_N.jpg with
paper_figures.json, which holds the errors, the machine and the commit.
"""

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from filter_service.progress import Progress
from filter_service.rendering.media_effects import srgb_from_linear
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.engines import open_renderer
from tests.benchmarks.field_methods import METHODS, EyeBench, State
from tests.benchmarks.harness import RESULTS, commit_id, machine_info
from tests.benchmarks.image_measures import channel_psnr_db
from tests.benchmarks.view_sources import Window
from tests.numerical.scene_frames import scene_view

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


@dataclass(frozen=True)
class Figure:
    """One figure of the paper: which eyes, and whether over the visual field."""

    number: int
    eyes: tuple[str, ...]
    on_axis: bool

    @property
    def methods(self) -> dict[str, str]:
        """Methods of `bench_field`, with the names that the picture shows."""
        return ON_AXIS_METHODS if self.on_axis else FIELD_METHODS


FIGURES = (
    Figure(9, LOW_ORDER, on_axis=True),
    Figure(10, MIXED, on_axis=True),
    Figure(11, LOW_ORDER, on_axis=False),
    Figure(12, MIXED, on_axis=False),
)


@dataclass(frozen=True)
class Cell:
    """One small picture (h, w, 3), sRGB, and the line below it."""

    image: NDArray[np.uint8]
    text: str


def part_of(scene: str, size: tuple[int, int], *, on_axis: bool) -> Window:
    """Return the part of a picture that is compared."""
    left, top = CORNERS[scene, on_axis]
    width_px, height_px = size
    corner = (round(left * width_px), round(top * height_px))
    return Window(*corner, width_px // 4, height_px // 4)


def row_cells(renderer, figure: Figure, eye: str, scene: str, size):
    """Cells of one eye and scene, and the errors of its methods in dB."""
    view = scene_view(scene, width_px=size[0], height_px=size[1])
    bench = EyeBench(renderer, eye, [view])
    window = part_of(scene, size, on_axis=figure.on_axis)
    exact = bench.exact_state(STATE, on_axis=figure.on_axis)
    if figure.on_axis:  # quick as a whole, where PSFs are of distance alone
        truth = window.of(dense_reference(view, exact, bins=True))
    else:
        truth = dense_reference(view, exact, bins=False, window=window)
    cells, errors_db = [], {}
    by_name = {method.name: method for method in METHODS}
    for name, title in figure.methods.items():
        color = by_name[name].run(bench, view, STATE, 1)[-1].color
        error_db = channel_psnr_db(window.of(color), truth)
        errors_db[name] = error_db
        cells.append(Cell(_srgb(window.of(color)), f"{title}: {error_db:.1f} dB"))
    whole = Cell(_srgb(_framed(color, window)), _title(eye, scene))
    bench.release()
    return [whole, *cells, Cell(_srgb(truth), "exact PSF of every pixel")], errors_db


def first_figure(renderer, size) -> list[list[Cell]]:
    """Figure 1: a very myopic eye, without and with its periphery."""
    view = scene_view("courtyard", width_px=size[0], height_px=size[1])
    bench = EyeBench(renderer, "myopia", [view])
    by_name = {method.name: method for method in METHODS}
    cells = []
    for name, text in (
        ("ours on-axis", "myopia, the PSFs of its axis everywhere"),
        ("ours quality", "myopia, over the whole visual field"),
    ):
        color = by_name[name].run(bench, view, STATE, 1)[-1].color
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
    for rows, columns in (
        (slice(top - 1, top + 1), slice(left, right)),
        (slice(bottom - 1, bottom + 1), slice(left, right)),
        (slice(top, bottom), slice(left - 1, left + 1)),
        (slice(top, bottom), slice(right - 1, right + 1)),
    ):
        framed[rows, columns] = FRAME_RGB
    return framed


def _title(eye: str, scene: str) -> str:
    return f"{EYE_TITLES.get(eye, eye)}, {SCENE_TITLES[scene]}"


def render(out: Path, *, quick: bool, progress: Progress) -> dict:
    """Render every figure into a folder; errors of each, and where they are from."""
    size = QUICK_SIZE if quick else SIZE
    scenes = tuple(SCENE_TITLES)
    eyes = {f.number: f.eyes[:1] if quick else f.eyes for f in FIGURES}
    total = 1 + sum(len(eyes[f.number]) * len(scenes) for f in FIGURES)
    task = progress.task("Rendering figures", total=total, unit="rows")
    renderer = open_renderer()
    out.mkdir(parents=True, exist_ok=True)
    _save(sheet(first_figure(renderer, size), (640, 360)), out, 1)
    task.advance()
    errors = []
    for figure in FIGURES:
        rows = []
        for eye in eyes[figure.number]:
            for scene in scenes:
                cells, errors_db = row_cells(renderer, figure, eye, scene, size)
                rows.append(cells)
                place = {"figure": figure.number, "eye": eye, "scene": scene}
                errors.append({**place, "psnr_db": errors_db})
                task.advance()
        _save(sheet(rows, CELL_PX), out, figure.number)
    content = {
        "machine": {**machine_info(), "renderer": renderer.name},
        "commit": commit_id(),
        "size": "{}x{}".format(*size),
        "state": str(STATE),
        "rows": errors,
    }
    text = json.dumps(content, indent=1) + "\n"
    (out / "paper_figures.json").write_text(text, encoding="utf-8")
    return content


def _save(page: Image.Image, out: Path, number: int) -> None:
    path = out / f"paper_figure_{number}.jpg"
    page.save(path, quality=JPEG_QUALITY, optimize=True)


def main() -> int:
    """Run the program; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="320x180, one eye each")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="DIR")
    arguments = parser.parse_args()
    with Progress() as progress:
        render(arguments.out, quick=arguments.quick, progress=progress)
    return 0


if __name__ == "__main__":
    sys.exit(main())
