"""Style of all figures: sizes, colors, fonts, without matplotlib's global settings.

Figures are made without pyplot, which is not thread-safe.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.cm import ScalarMappable

INK, SOFT, GRID = "#1b2430", "#5b6775", "#d9dee4"
BLUE, ORANGE, GREEN, RED = "#1f5fa8", "#d9731a", "#2c8a57", "#b3262e"
PUPIL_COLORS = (BLUE, ORANGE)
"""Colors of the small and the large pupil."""

TEXT_PT, SMALL_PT, TITLE_PT = 8.0, 7.0, 9.0
LINE_PT = 1.5
LEGEND_DOWN_PT = 27.0
"""Distance from an axis to the legend below it; tick and axis labels are between."""
MM_PER_INCH = 25.4
LITERAL: dict[str, Any] = {"parse_math": False}
"""Property of a text that contains a name: ``$`` does not start a formula."""

DIVERGING, SEQUENTIAL = "RdBu_r", "cividis"


def new_figure(width_mm: float, height_mm: float) -> Figure:
    """Return an empty figure of a given size on paper."""
    size = (width_mm / MM_PER_INCH, height_mm / MM_PER_INCH)
    return Figure(figsize=size, layout="constrained", facecolor="white")


def figure_of(
    width_mm: float,
    height_mm: float,
    draw: Callable[..., None],
    *subjects: Any,
    **options: Any,
) -> Figure:
    """Return a figure with one pair of axes, into which a function draws."""
    figure = new_figure(width_mm, height_mm)
    draw(figure.subplots(), *subjects, **options)
    return figure


def style_axes(axes: Axes, *, title: str = "", x: str = "", y: str = "") -> None:
    """Set title and labels of axes, and apply the common style."""
    if title:
        axes.set_title(title, fontsize=TITLE_PT, color=INK, loc="left", **LITERAL)
    axes.set_xlabel(x, fontsize=TEXT_PT, color=INK)
    axes.set_ylabel(y, fontsize=TEXT_PT, color=INK)
    axes.tick_params(labelsize=SMALL_PT, colors=SOFT, width=0.6, length=2.5)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(SOFT)
        spine.set_linewidth(0.6)


def with_grid(axes: Axes) -> None:
    """Draw a faint grid."""
    axes.set_axisbelow(True)
    axes.grid(color=GRID, linewidth=0.5)


def draw_band(
    axes: Axes,
    at: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    color: str,
    percentiles: tuple[float, float] = (5.0, 95.0),
    alpha: float = 0.18,
) -> None:
    """Draw the range of values (N, n) of N persons along an axis as a band."""
    low, high = np.percentile(values, percentiles, axis=0)
    axes.fill_between(at, low, high, color=color, alpha=alpha, linewidth=0.0)


def legend_above(axes: Axes) -> None:
    """Draw a legend above the right end of axes, where it covers no data."""
    axes.legend(
        fontsize=SMALL_PT, labelcolor=INK, frameon=False, ncols=2, loc="lower right",
        bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, columnspacing=1.2,
        handlelength=1.2,
    )  # fmt: skip


def legend_below(axes: Axes, entries: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Draw a legend of labels and line styles below the axes, clear of the curves."""
    lines = [Line2D([], [], **({"linewidth": LINE_PT} | looks)) for _, looks in entries]
    down = ScaledTranslation(0.0, -LEGEND_DOWN_PT / 72.0, axes.figure.dpi_scale_trans)
    below = axes.transAxes + down
    literal_legend(
        axes, lines, [label for label, _ in entries],
        loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, columnspacing=1.2,
        bbox_transform=below,
        handlelength=1.6, borderaxespad=0.0,
    )  # fmt: skip


def literal_legend(
    owner: Axes | FigureBase,
    handles: Sequence[Any],
    labels: Sequence[str],
    **placing: Any,
) -> None:
    """Draw a legend of labels as they are written.

    matplotlib itself takes labels with ``$`` for formulas, and omits those that start
    with an underscore.
    """
    legend = owner.legend(
        handles, [" "] * len(handles), fontsize=SMALL_PT, labelcolor=INK,
        frameon=False, **placing,
    )  # fmt: skip
    for text, label in zip(legend.get_texts(), labels, strict=True):
        text.set(text=label, **LITERAL)


def mark_unknown(axes: Axes) -> None:
    """Write the reason for missing curves in the middle of axes."""
    axes.text(
        0.5, 0.5, "not known through lenslets", fontsize=SMALL_PT, color=SOFT,
        ha="center", transform=axes.transAxes,
    )  # fmt: skip


def style_image_axes(axes: Axes, *, title: str = "") -> None:
    """Remove ticks and spines from an image's axes."""
    style_axes(axes, title=title)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def color_bar(axes: Axes, drawn: ScalarMappable, *, label: str) -> None:
    """Draw a color bar beside axes."""
    bar = axes.figure.colorbar(drawn, ax=axes, fraction=0.05, pad=0.02, aspect=18)
    bar.set_label(label, fontsize=SMALL_PT, color=INK)
    bar.ax.tick_params(labelsize=SMALL_PT, colors=SOFT, width=0.6, length=2.5)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()
    bar.outline.set_linewidth(0.4)
