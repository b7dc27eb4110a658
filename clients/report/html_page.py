"""HTML output of a report: one self-contained file, also the source of the PDF.

The content is independent of the format: sections of rows of blocks.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray
from PIL import Image

from clients.figures.style import new_figure

MARGIN_MM = 12.0
CONTENT_WIDTH_MM = 210.0 - 2.0 * MARGIN_MM
"""Width of A4 without its margins."""

GAP_MM = 5.0
"""Gap between the blocks of a row."""

JPEG_QUALITY = 88
STYLE = """
@page { size: A4; margin: 11mm 12mm 13mm;
  @bottom-left { content: string(running) "\\A" string(footer); white-space: pre-line;
    font: 7.5pt "DejaVu Sans", sans-serif; color: #4c5866; width: 165mm; }
  @bottom-right { content: "page " counter(page) " of " counter(pages);
    font: 7.5pt "DejaVu Sans", sans-serif; color: #4c5866; } }
* { box-sizing: border-box; }
body { font: 9.5pt/1.35 "DejaVu Sans", Verdana, system-ui, sans-serif; color: #1b2430;
  background: #eef1f4; margin: 0; }
main { background: #fff; max-width: 210mm; margin: 0 auto; padding: 12mm;
  string-set: running attr(data-running), footer attr(data-footer); }
header { border-bottom: 1.5pt solid #1f5fa8; margin-bottom: 4mm; }
h1 { font-size: 16pt; margin: 0; }
header p { margin: 1mm 0; color: #4c5866; }
header .origin { font-size: 9pt; }
.origin span { white-space: nowrap; margin-right: 4mm; }
h2 { font-size: 12pt; color: #1f5fa8; margin: 5mm 0 2mm; }
h3 { font-size: 10pt; margin: 0 0 1mm; }
section:first-of-type h2 { display: none; }

.row { display: grid; gap: 5mm; margin-bottom: 3mm; align-items: start; }
table { border-collapse: collapse; width: 100%; font-size: 9pt; }
th, td { text-align: left; vertical-align: top; padding: .4mm 2mm .4mm 0;
  border-bottom: .4pt solid #d9dee4; font-variant-numeric: tabular-nums; }
thead th { color: #4c5866; font-weight: 600; }
thead tr:last-child th { border-bottom-color: #4c5866; }
tbody th { font-weight: normal; }
table.short td, table.short th { white-space: nowrap; }
.note, figcaption, .plain { font-size: 9pt; color: #4c5866; margin: 1mm 0 0; }
ul { margin: 0; padding-left: 4mm; font-size: 9pt; }
figure { margin: 0; }
figure img { display: block; width: 100%; height: auto; }
figure.picture img { border: .6pt solid #d9dee4; }
.marked { position: relative; }
.marks { position: absolute; top: 0; right: 0; bottom: 0; width: 28mm; margin: 0;
  padding: 0; list-style: none; }
.marks li { position: absolute; right: 0; margin-top: -1.6mm; text-align: right;
  white-space: nowrap; font-size: 9pt; line-height: 3.2mm; color: #4c5866; }
.marks li.read { color: #1b2430; font-weight: bold; }
footer { border-top: .4pt solid #4c5866; margin-top: 4mm; padding-top: 1.5mm;
  font-size: 9pt; color: #4c5866; }
@media screen and (max-width: 700px) { main { padding: 5mm; }
  .row { grid-template-columns: minmax(0, 1fr) !important; }
  .row > div { overflow-x: auto; }
  table.short td, table.short th { white-space: normal; } }
@media print { body { background: #fff; } main { padding: 0; max-width: none; }
  h2, h3 { break-after: avoid; } .row, tr, figure { break-inside: avoid; }
  .row.list { break-inside: auto; } footer { display: none; } }
"""
"""Style for screen and paper.  On paper, the footer is in the page margins."""

MARK_MM_PER_CHARACTER = 1.65
"""Width beside an image for its marks, such as ``0.3 · 20/40``."""

MARK_LINE_MM = 3.2
"""Height of a mark's line."""


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
        Names and values that identify the report: patient, reference, date, version.
    running : str
        Text in the margin of every page, which identifies the report.
    """

    title: str
    subtitle: str
    sections: tuple[Section, ...]
    footer: str
    origin: tuple[tuple[str, str], ...] = ()
    running: str = ""


def html_of(document: Document) -> str:
    """Return a document as a single HTML file."""
    sections = "\n".join(_section(section) for section in document.sections)
    origin = " ".join(
        f"<span>{escape(name)} {escape(value)}</span>"
        for name, value in document.origin
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(document.title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f'<body>\n<main data-running="{escape(document.running)}" '
        f'data-footer="{escape(document.footer)}">\n'
        f"<header><h1>{escape(document.title)}</h1>"
        f"<p>{escape(document.subtitle)}</p>"
        f'<p class="origin">{origin}</p></header>\n{sections}\n'
        f"<footer>{escape(document.footer)}</footer>\n</main>\n</body>\n</html>\n"
    )


def _section(section: Section) -> str:
    rows = "\n".join(_row(row) for row in section.rows)
    return f"<section>\n<h2>{escape(section.title)}</h2>\n{rows}\n</section>"


def _row(row: Row) -> str:
    columns = " ".join(f"{width_mm:.1f}fr" for width_mm in row.widths_mm)
    blocks = "\n".join(
        _block(block, width_mm)
        for block, width_mm in zip(row.blocks, row.widths_mm, strict=True)
    )
    is_list = all(isinstance(block, Text) and block.is_list for block in row.blocks)
    kind = "row list" if is_list else "row"
    style = f"grid-template-columns:{columns}"
    return f'<div class="{kind}" style="{style}">\n{blocks}\n</div>'


def _block(block: Block, width_mm: float) -> str:
    if isinstance(block, Table):
        return _table(block)
    if isinstance(block, Text):
        return _text(block)
    if isinstance(block, Picture):
        return _picture(block, width_mm)
    return _plot(block, width_mm)


def _table(table: Table) -> str:
    heads = []
    if table.groups:
        cells = (
            f'<th colspan="{span}" scope="colgroup">{escape(text)}</th>'
            for text, span in table.groups
        )
        heads.append("".join(cells))
    if table.head:
        heads.append("".join(f'<th scope="col">{escape(t)}</th>' for t in table.head))
    top = "".join(f"<tr>{cells}</tr>" for cells in heads)
    rows = "\n".join(
        f'<tr><th scope="row">{escape(row[0])}</th>'
        + "".join(f"<td>{escape(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in table.rows
    )
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    kind = "" if table.has_prose else ' class="short"'
    return (
        f"<div><h3>{escape(table.title)}</h3>"
        f"<table{kind}>"
        f"{f'<thead>{top}</thead>' if top else ''}<tbody>\n{rows}\n</tbody>"
        f"</table>{note}</div>"
    )


def _text(block: Text) -> str:
    title = f"<h3>{escape(block.title)}</h3>" if block.title else ""
    if block.is_list:
        items = "".join(f"<li>{escape(text)}</li>" for text in block.paragraphs)
        return f"<div>{title}<ul>{items}</ul></div>"
    texts = "".join(f'<p class="plain">{escape(text)}</p>' for text in block.paragraphs)
    columns = ""
    if block.n_columns > 1:
        columns = f' style="columns:{block.n_columns};column-gap:5mm"'
    return f"<div{columns}>{title}{texts}</div>"


def _picture(picture: Picture, width_mm: float) -> str:
    caption = escape(picture.caption)
    image = f'<img alt="{caption}" src="{_jpeg(picture.image)}">'
    if picture.marks:
        height, width = picture.image.shape[:2]
        beside_mm = MARK_MM_PER_CHARACTER * max(len(m.text) for m in picture.marks)
        marks = _without_overlap(picture.marks, (width_mm - beside_mm) * height / width)
        items = "".join(map(_mark, marks))
        style = f' style="padding-right:{beside_mm:.1f}mm"'
        image = (
            f'<div class="marked"{style}>{image}<ul class="marks">{items}</ul></div>'
        )
    return f'<figure class="picture">{image}<figcaption>{caption}</figcaption></figure>'


def _mark(mark: Mark) -> str:
    kind, sign = (' class="read"', "◂ ") if mark.is_emphasized else ("", "")
    position = f"top:{100 * mark.y_ratio:.1f}%"
    return f'<li{kind} style="{position}">{sign}{escape(mark.text)}</li>'


def _without_overlap(marks: tuple[Mark, ...], height_mm: float) -> list[Mark]:
    """Return the marks that do not overlap; emphasized ones come first."""
    kept: list[Mark] = []
    for mark in sorted(marks, key=lambda mark: not mark.is_emphasized):
        gaps_mm = (abs(mark.y_ratio - other.y_ratio) * height_mm for other in kept)
        if all(gap_mm >= MARK_LINE_MM for gap_mm in gaps_mm):
            kept.append(mark)
    return sorted(kept, key=lambda mark: mark.y_ratio)


def _plot(plot: Plot, width_mm: float) -> str:
    figure = new_figure(width_mm, plot.height_mm)
    plot.draw(figure)
    return f'<figure><img alt="{escape(plot.alt)}" src="{_svg(figure)}"></figure>'


def _svg(figure: Figure) -> str:
    """Return a figure as an SVG data URI, so that the ids of figures cannot collide."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()


def _jpeg(image: NDArray[Any]) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()
