"""PDF output of a report on A4 pages: vector figures and text, by matplotlib alone.

Matplotlib draws the figures anyway, here directly into the page; another library would
need them as bitmaps, or require a browser.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import GridSpec
from matplotlib.lines import Line2D

from clients.figures.style import BLUE, GRID, INK, SOFT, new_figure
from clients.report.blocks import (
    CONTENT_WIDTH_MM,
    GAP_MM,
    MARGIN_MM,
    PAGE_HEIGHT_MM,
    PAGE_WIDTH_MM,
    Block,
    Document,
    Picture,
    Plot,
    Row,
    Section,
    Table,
    Words,
)
from clients.report.pdf_text import column_widths_mm, line_mm, lines_of

TITLE_PT, HEADING_PT, BLOCK_PT, CELL_PT, NOTE_PT = 15.0, 11.0, 8.5, 7.5, 6.8
CELL_GAP_MM, CELL_ROOM_MM, ROW_GAP_MM = 3.0, 1.3, 3.0
HEAD_MM = 16.0
BOTTOM_MM = PAGE_HEIGHT_MM - MARGIN_MM - 5.0


def write_pdf(document: Document, path: Path) -> int:
    """Write a document as a PDF; return the number of pages.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    pages = _Pages(document)
    pages.fill()
    with PdfPages(
        path, metadata={"Title": document.title, "CreationDate": None}
    ) as pdf:
        for number, page in enumerate(pages.made, start=1):
            pages.finish(page, number)
            pdf.savefig(page)
    return len(pages.made)


class _Pages:
    """Pages filled with rows from top to bottom; positions in mm from the top left."""

    def __init__(self, document: Document) -> None:
        self._document = document
        self.made: list[Figure] = []
        self._y_mm = 0.0

    def fill(self) -> None:
        """Lay out all sections."""
        self._new_page()
        self._head()
        for k, section in enumerate(self._document.sections):
            self._section(section, is_first=k == 0)

    def finish(self, page: Figure, number: int) -> None:
        """Draw the footer of a page."""
        y_mm = PAGE_HEIGHT_MM - MARGIN_MM
        self._rule(page, MARGIN_MM, CONTENT_WIDTH_MM, y_mm - 3.5, SOFT)
        self._text(page, MARGIN_MM, y_mm, self._document.footer, NOTE_PT, color=SOFT)
        count = f"{number} / {len(self.made)}"
        right_mm = PAGE_WIDTH_MM - MARGIN_MM
        self._text(page, right_mm, y_mm, count, NOTE_PT, color=SOFT, ha="right")

    def _new_page(self) -> None:
        page = new_figure(PAGE_WIDTH_MM, PAGE_HEIGHT_MM)
        page.set_layout_engine("none")  # until a figure needs a layout
        self.made.append(page)
        self._y_mm = MARGIN_MM

    def _head(self) -> None:
        page, document = self.made[-1], self._document
        self._text(
            page, MARGIN_MM, self._y_mm + 5.0, document.title, TITLE_PT, bold=True
        )
        self._text(
            page, MARGIN_MM, self._y_mm + 10.0, document.subtitle, BLOCK_PT, color=SOFT
        )
        self._rule(page, MARGIN_MM, CONTENT_WIDTH_MM, self._y_mm + 12.5, BLUE, 1.5)
        self._y_mm += HEAD_MM

    def _section(self, section: Section, *, is_first: bool) -> None:
        first_mm = row_height_mm(section.rows[0])
        if section.starts_page or self._y_mm + 8.0 + first_mm > BOTTOM_MM:
            self._new_page()
        if not is_first:
            self._y_mm += 4.0
            page = self.made[-1]
            self._text(
                page, MARGIN_MM, self._y_mm, section.title, HEADING_PT, bold=True,
                color=BLUE,
            )  # fmt: skip
            self._y_mm += 3.5
        for row in section.rows:
            for part in _fitting(row):
                height_mm = row_height_mm(part)
                if self._y_mm + height_mm > BOTTOM_MM:
                    self._new_page()
                self._row(part, height_mm)
                self._y_mm += height_mm
            self._y_mm += ROW_GAP_MM

    def _row(self, row: Row, height_mm: float) -> None:
        left_mm = MARGIN_MM
        for block, width_mm in zip(row.blocks, row.widths_mm, strict=True):
            self._block(block, left_mm, width_mm, height_mm)
            left_mm += width_mm + GAP_MM

    def _block(
        self, block: Block, left_mm: float, width_mm: float, height_mm: float
    ) -> None:
        page, top_mm = self.made[-1], self._y_mm
        if isinstance(block, Table):
            self._table(page, block, left_mm, top_mm, width_mm)
        elif isinstance(block, Words):
            self._words(page, block, left_mm, top_mm, width_mm)
        elif isinstance(block, Picture):
            self._picture(page, block, left_mm, top_mm, width_mm)
        else:
            block.draw(_panel(page, left_mm, top_mm, width_mm, block.height_mm))

    def _table(
        self, page: Figure, table: Table, left_mm: float, top_mm: float, width_mm: float
    ) -> None:
        y_mm = top_mm + line_mm(BLOCK_PT)
        self._text(page, left_mm, y_mm - 0.8, table.title, BLOCK_PT, bold=True)
        widths = _widths_mm(table, width_mm)
        for number, row in enumerate(_rows(table)):
            is_head = bool(table.head) and number == 0
            cells = _cells(row, widths)
            x_mm = left_mm
            for lines, column_mm in zip(cells, widths, strict=False):
                for k, line in enumerate(lines):
                    at_mm = y_mm + (k + 0.85) * line_mm(CELL_PT) + CELL_ROOM_MM / 2
                    self._text(
                        page, x_mm, at_mm, line, CELL_PT, bold=is_head,
                        color=SOFT if is_head else INK,
                    )  # fmt: skip
                x_mm += column_mm
            y_mm += _cells_mm(cells)
            self._rule(page, left_mm, width_mm, y_mm, SOFT if is_head else GRID, 0.4)
        for line in lines_of(table.note, width_mm, NOTE_PT) if table.note else ():
            y_mm += line_mm(NOTE_PT)
            self._text(page, left_mm, y_mm, line, NOTE_PT, color=SOFT)

    def _words(
        self, page: Figure, words: Words, left_mm: float, top_mm: float, width_mm: float
    ) -> None:
        y_mm = top_mm
        if words.title:
            y_mm += line_mm(BLOCK_PT)
            self._text(page, left_mm, y_mm - 0.8, words.title, BLOCK_PT, bold=True)
        for paragraph in words.paragraphs:
            indent_mm = 3.0 if words.is_list else 0.0
            for k, line in enumerate(
                lines_of(paragraph, width_mm - indent_mm, NOTE_PT)
            ):
                y_mm += line_mm(NOTE_PT)
                if words.is_list and k == 0:
                    self._text(page, left_mm, y_mm, "•", NOTE_PT)
                self._text(page, left_mm + indent_mm, y_mm, line, NOTE_PT, color=SOFT)
            y_mm += 0.8

    def _picture(
        self,
        page: Figure,
        picture: Picture,
        left_mm: float,
        top_mm: float,
        width_mm: float,
    ) -> None:
        height_mm = width_mm * picture.image.shape[0] / picture.image.shape[1]
        box = (
            left_mm / PAGE_WIDTH_MM,
            1.0 - (top_mm + height_mm) / PAGE_HEIGHT_MM,
            width_mm / PAGE_WIDTH_MM,
            height_mm / PAGE_HEIGHT_MM,
        )
        axes = page.add_axes(box)
        axes.imshow(picture.image, interpolation="none", aspect="auto")
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_color(GRID)
            spine.set_linewidth(0.4)
        for k, line in enumerate(lines_of(picture.caption, width_mm, NOTE_PT)):
            at_mm = top_mm + height_mm + 0.5 + (k + 1) * line_mm(NOTE_PT)
            self._text(page, left_mm, at_mm, line, NOTE_PT, color=SOFT)

    @staticmethod
    def _text(
        page: Figure,
        x_mm: float,
        y_mm: float,
        text: str,
        size_pt: float,
        *,
        bold: bool = False,
        color: str = INK,
        ha: str = "left",
    ) -> None:
        page.text(
            x_mm / PAGE_WIDTH_MM, 1.0 - y_mm / PAGE_HEIGHT_MM, text, fontsize=size_pt,
            weight="bold" if bold else "normal", color=color, ha=ha, va="baseline",
        )  # fmt: skip

    @staticmethod
    def _rule(
        page: Figure,
        x_mm: float,
        width_mm: float,
        y_mm: float,
        color: str,
        line_pt: float = 0.6,
    ) -> None:
        along = [x_mm / PAGE_WIDTH_MM, (x_mm + width_mm) / PAGE_WIDTH_MM]
        at = 1.0 - y_mm / PAGE_HEIGHT_MM
        page.add_artist(Line2D(along, [at, at], color=color, linewidth=line_pt))


def _panel(
    page: Figure, left_mm: float, top_mm: float, width_mm: float, height_mm: float
) -> SubFigure:
    """Return a subfigure of a page with its own layout."""
    page.set_layout_engine("constrained")
    grid = GridSpec(
        3,
        3,
        figure=page,
        width_ratios=_around(left_mm, width_mm, PAGE_WIDTH_MM),
        height_ratios=_around(top_mm, height_mm, PAGE_HEIGHT_MM),
    )
    return page.add_subfigure(grid[1, 1])


def _around(start_mm: float, size_mm: float, whole_mm: float) -> tuple[float, ...]:
    return start_mm, size_mm, whole_mm - start_mm - size_mm


def _rows(table: Table) -> tuple[tuple[str, ...], ...]:
    return (table.head, *table.rows) if table.head else table.rows


def _widths_mm(table: Table, width_mm: float) -> list[float]:
    return column_widths_mm(_rows(table), width_mm, CELL_PT, CELL_GAP_MM)


def _cells(row: tuple[str, ...], widths_mm: list[float]) -> list[list[str]]:
    return [
        lines_of(cell, column_mm - 0.5 * CELL_GAP_MM, CELL_PT)
        for cell, column_mm in zip(row, widths_mm, strict=False)
    ]


def _cells_mm(cells: list[list[str]]) -> float:
    return max(len(lines) for lines in cells) * line_mm(CELL_PT) + CELL_ROOM_MM


def row_height_mm(row: Row) -> float:
    """Return the height of a row, that of its highest block."""
    return max(
        _height_mm(block, width_mm)
        for block, width_mm in zip(row.blocks, row.widths_mm, strict=True)
    )


def _height_mm(block: Block, width_mm: float) -> float:
    if isinstance(block, Plot):
        return block.height_mm
    if isinstance(block, Picture):
        height_mm = width_mm * block.image.shape[0] / block.image.shape[1]
        return height_mm + 1.0 + line_mm(NOTE_PT) * _line_count(block.caption, width_mm)
    if isinstance(block, Words):
        indent_mm = 3.0 if block.is_list else 0.0
        counts = (_line_count(p, width_mm - indent_mm) for p in block.paragraphs)
        title_mm = line_mm(BLOCK_PT) if block.title else 0.0
        return title_mm + sum(n * line_mm(NOTE_PT) + 0.8 for n in counts)
    widths = _widths_mm(block, width_mm)
    cells_mm = sum(_cells_mm(_cells(row, widths)) for row in _rows(block))
    note_mm = (
        line_mm(NOTE_PT) * _line_count(block.note, width_mm) if block.note else 0.0
    )
    return line_mm(BLOCK_PT) + cells_mm + note_mm + 1.0


def _line_count(text: str, width_mm: float) -> int:
    return len(lines_of(text, width_mm, NOTE_PT))


def _fitting(row: Row) -> list[Row]:
    """Return a row, or its paragraphs one by one, so that they can break over pages."""
    if len(row.blocks) > 1 or not isinstance(row.blocks[0], Words):
        return [row]
    words = row.blocks[0]
    return [
        Row((Words((paragraph,), words.title if k == 0 else "", words.is_list),))
        for k, paragraph in enumerate(words.paragraphs)
    ]
