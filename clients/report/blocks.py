"""Content of a report, independent of its format: sections of rows of blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import FigureBase
from numpy.typing import NDArray

MARGIN_MM = 12.0
CONTENT_WIDTH_MM = 210.0 - 2.0 * MARGIN_MM
"""Width of A4 without its margins."""

GAP_MM = 5.0
"""Gap between the blocks of a row."""


@dataclass(frozen=True)
class Table:
    """Cells of text; the first column labels the rows.

    Attributes
    ----------
    groups : tuple of (str, int)
        Headings above the head, each with the number of columns that it spans.
    has_prose : bool
        Whether cells contain sentences, which break over lines.
    """

    title: str
    rows: tuple[tuple[str, ...], ...]
    head: tuple[str, ...] = ()
    note: str = ""
    groups: tuple[tuple[str, int], ...] = ()
    has_prose: bool = False


@dataclass(frozen=True)
class Plot:
    """A figure, drawn on demand; ``alt`` describes it in words."""

    draw: Callable[[FigureBase], None]
    height_mm: float
    alt: str


@dataclass(frozen=True)
class Mark:
    """A text beside an image, at a height from 0, its top, to 1."""

    y_ratio: float
    text: str
    is_emphasized: bool = False


@dataclass(frozen=True)
class Picture:
    """An sRGB image (height, width, 3) with a caption and texts on its right."""

    image: NDArray[np.uint8]
    caption: str
    marks: tuple[Mark, ...] = ()


@dataclass(frozen=True)
class Text:
    """Paragraphs, or the items of a list, in one or more columns."""

    paragraphs: tuple[str, ...]
    title: str = ""
    is_list: bool = False
    n_columns: int = 1


Block = Table | Plot | Picture | Text


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


@dataclass(frozen=True)
class Document:
    """A report.

    Attributes
    ----------
    origin : tuple of (str, str)
        Name and value of what identifies the report: patient, reference, date, version.
    running : str
        Text in the margin of every page: what identifies the report.
    """

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    footer: str
    origin: tuple[tuple[str, str], ...] = ()
    running: str = ""
