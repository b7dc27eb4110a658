"""Curves of visual acuity by distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from clients.figures.study import PUPILS_MM, EyeStudy
from clients.figures.style import (
    BLUE,
    GREEN,
    INK,
    LINE_PT,
    PUPIL_COLORS,
    SMALL_PT,
    SOFT,
    draw_band,
    legend_below,
    mark_unknown,
    new_figure,
    style_axes,
    with_grid,
)

WORST_LOG_MAR, BEST_LOG_MAR = 1.6, -0.3
ACCOMMODATING: dict[str, Any] = {"linestyle": "-", "linewidth": LINE_PT}
FOCUSED_FAR: dict[str, Any] = {"linestyle": "--", "linewidth": LINE_PT}
EDGE_RATIO = 0.95
"""Position along the axis beyond which a centered text would cross its end."""

MARKS = {0.0: " far", 1.0: "1 m", 2.5: "40 cm", 5.0: "20 cm", 10.0: "10 cm"}


def draw_through_focus_acuity(
    axes: Axes,
    study: EyeStudy,
    *,
    pupils_mm: Sequence[float] = PUPILS_MM,
    drawn_log_mar: Mapping[float, NDArray[np.float64]] | None = None,
) -> None:
    """Draw acuity by distance through several pupils: focused far and accommodating.

    Parameters
    ----------
    drawn_log_mar : mapping, optional
        Acuity (N, n) of N drawn persons who accommodate, at the distances of the
        study, by pupil, to draw as bands.
    """
    colors = dict(zip(pupils_mm, PUPIL_COLORS, strict=False))
    for pupil_mm, color in colors.items():
        found = study.acuity(pupil_mm)
        axes.plot(found.object_dpt, found.near_log_mar, color=color, **ACCOMMODATING)
        axes.plot(found.object_dpt, found.far_log_mar, color=color, **FOCUSED_FAR)
        if drawn_log_mar and pupil_mm in drawn_log_mar:
            draw_band(axes, found.object_dpt, drawn_log_mar[pupil_mm], color=color)
    looks = [(f"{pupil_mm:g} mm", {"color": c}) for pupil_mm, c in colors.items()]
    styles = {"accommodating": ACCOMMODATING, "focused far": FOCUSED_FAR}
    black = [(name, {"color": INK} | style) for name, style in styles.items()]
    _finish(axes, found.object_dpt[-1], [*looks, *black], "Acuity by distance")
    if np.isnan(found.far_log_mar[0]):
        mark_unknown(axes)


def draw_acuity_of_several(
    axes: Axes, studies: Sequence[EyeStudy], *, labels: Sequence[str], pupil_mm: float
) -> None:
    """Draw the acuity of several accommodating eyes through one pupil."""
    looks = []
    nearest_dpt, is_known = 0.0, True
    for study, label, color in zip(studies, labels, (BLUE, GREEN), strict=True):
        looks.append((label, {"color": color}))
        found = study.acuity(pupil_mm)
        axes.plot(found.object_dpt, found.near_log_mar, color=color, **ACCOMMODATING)
        is_known &= not np.isnan(found.far_log_mar[0])
        nearest_dpt = max(nearest_dpt, float(found.object_dpt[-1]))
    title = f"Acuity by distance, accommodating, {pupil_mm:g} mm"
    _finish(axes, nearest_dpt, looks, title)
    if not is_known:
        mark_unknown(axes)


def _finish(
    axes: Axes,
    nearest_dpt: float,
    looks: Sequence[tuple[str, dict[str, Any]]],
    title: str,
) -> None:
    style_axes(axes, title=title, x="distance of the chart, dpt", y="acuity, logMAR")
    axes.set_xlim(0.0, nearest_dpt)
    axes.set_ylim(WORST_LOG_MAR, BEST_LOG_MAR)  # better is higher, as on charts
    axes.set_yticks(np.arange(-0.2, 1.61, 0.2))
    with_grid(axes)
    for distance_dpt, name in MARKS.items():
        if distance_dpt <= nearest_dpt:
            axes.text(
                distance_dpt, WORST_LOG_MAR - 0.03, name, fontsize=SMALL_PT, color=SOFT,
                ha=_alignment(distance_dpt / nearest_dpt), va="bottom",
            )  # fmt: skip
    legend_below(axes, looks)


def _alignment(position_ratio: float) -> str:
    """Return the text alignment that keeps a label within the axis."""
    if position_ratio == 0.0:
        return "left"
    return "center" if position_ratio < EDGE_RATIO else "right"


def through_focus_acuity_figure(study: EyeStudy) -> Figure:
    """Return `draw_through_focus_acuity` as a figure."""
    figure = new_figure(90.0, 65.0)
    draw_through_focus_acuity(figure.subplots(), study)
    return figure
