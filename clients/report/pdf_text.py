"""Text layout on paper: widths and line breaks."""

from __future__ import annotations

from functools import lru_cache

from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from clients.figures.style import MM_PER_INCH

POINTS_PER_INCH = 72.0
LINE_RATIO = 1.32
"""Ratio of line spacing to font size."""


def mm_of_points(points: float) -> float:
    """Convert points to mm."""
    return points * MM_PER_INCH / POINTS_PER_INCH


def line_mm(size_pt: float) -> float:
    """Return the line spacing."""
    return mm_of_points(size_pt * LINE_RATIO)


@lru_cache(maxsize=20_000)
def width_mm(text: str, size_pt: float, weight: str = "normal") -> float:
    """Return the width of a line of text."""
    font = FontProperties(size=size_pt, weight=weight)
    points, _, _ = text_to_path.get_text_width_height_descent(text, font, ismath=False)
    return mm_of_points(points)


def lines_of(text: str, available_mm: float, size_pt: float) -> list[str]:
    """Break a text into lines; a word that is too long gets its own line."""
    lines, line = [], ""
    for word in text.split():
        longer = f"{line} {word}" if line else word
        if line and width_mm(longer, size_pt) > available_mm:
            lines.append(line)
            longer = word
        line = longer
    return [*lines, line]


def column_widths_mm(
    rows: tuple[tuple[str, ...], ...],
    available_mm: float,
    size_pt: float,
    gap_mm: float,
) -> list[float]:
    """Return a table's column widths; if too wide, the widest column shrinks."""
    needed = [
        max(width_mm(row[k], size_pt) for row in rows if k < len(row)) + gap_mm
        for k in range(max(len(row) for row in rows))
    ]
    if sum(needed) > available_mm:
        widest = needed.index(max(needed))
        others = sum(needed) - needed[widest]
        needed[widest] = max(available_mm - others, available_mm / len(needed))
        return needed
    spare = (available_mm - sum(needed)) / len(needed)
    return [width + spare for width in needed]
