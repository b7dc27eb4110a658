"""Building blocks of a report, independent of its format: titled rows of blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import FigureBase
from numpy.typing import NDArray

PAGE_WIDTH_MM, PAGE_HEIGHT_MM = 210.0, 297.0
MARGIN_MM = 12.0
CONTENT_WIDTH_MM = PAGE_WIDTH_MM - 2.0 * MARGIN_MM
GAP_MM = 5.0
"""Gap between the blocks of a row."""


@dataclass(frozen=True)
class Table:
    """Cells of text; the first column labels the rows."""

    title: str
    rows: tuple[tuple[str, ...], ...]
    head: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Plot:
    """A figure, drawn on demand; ``alt`` describes it in words."""

    draw: Callable[[FigureBase], None]
    height_mm: float
    alt: str


@dataclass(frozen=True)
class Picture:
    """An sRGB image (height, width, 3) with a caption."""

    image: NDArray[np.uint8]
    caption: str


@dataclass(frozen=True)
class Words:
    """Paragraphs, or the items of a list."""

    paragraphs: tuple[str, ...]
    title: str = ""
    is_list: bool = False


Block = Table | Plot | Picture | Words


@dataclass(frozen=True)
class Row:
    """Blocks side by side, and their shares of the width."""

    blocks: tuple[Block, ...]
    width_ratio: tuple[float, ...] = ()

    @property
    def widths_mm(self) -> tuple[float, ...]:
        """Return the width of each block on paper."""
        ratios = self.width_ratio or (1.0,) * len(self.blocks)
        free_mm = CONTENT_WIDTH_MM - GAP_MM * (len(self.blocks) - 1)
        return tuple(free_mm * share / sum(ratios) for share in ratios)


@dataclass(frozen=True)
class Section:
    """Rows under a title."""

    title: str
    rows: tuple[Row, ...]
    starts_page: bool = False


@dataclass(frozen=True)
class Document:
    """A report: title, subtitle, sections and footer."""

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    footer: str
