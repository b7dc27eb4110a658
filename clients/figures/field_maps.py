"""Refraction and blur over the visual field, as maps."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from clients.figures.study import FIELD_H_DEG, FIELD_V_DEG, EyeStudy
from clients.figures.style import (
    DIVERGING,
    SEQUENTIAL,
    SMALL_PT,
    SOFT,
    TEXT_PT,
    color_bar,
    new_figure,
    style_axes,
)

MIN_RANGE_DPT = 0.25
ARCMIN_PER_MRAD = 60.0 * 180.0 / np.pi / 1000.0
LEVEL_COUNT = 14


def blur_arcmin(study: EyeStudy) -> NDArray[np.float64]:
    """Return the blur (n,) of each direction for an eye focused far, arcmin.

    It is the RMS radius of a far point's blur from second-order aberrations.
    """
    m_dpt, j0_dpt, j45_dpt = study.field.power_dpt.T
    m_dpt = m_dpt - study.far_accommodation_dpt
    # A ray at r mm is deflected by r times the power, in mrad; mean r² is R² / 2.
    power_dpt = np.sqrt(m_dpt**2 + j0_dpt**2 + j45_dpt**2)
    return ARCMIN_PER_MRAD * power_dpt * study.field.zernike_radius_mm / np.sqrt(2.0)


def draw_field_map(
    axes: Axes,
    values: NDArray[np.float64],
    *,
    title: str,
    label: str,
    middle: float | None = None,
) -> None:
    """Draw a map of values (n,) of the field's directions.

    Parameters
    ----------
    middle : float, optional
        Value at which the diverging colors are white; sequential colors if None.
    """
    grid = values.reshape(FIELD_V_DEG.size, FIELD_H_DEG.size)
    levels: int | NDArray[np.float64]
    levels, colors = LEVEL_COUNT, SEQUENTIAL
    if middle is not None:
        reach = max(float(np.abs(grid - middle).max()), MIN_RANGE_DPT)
        levels = np.linspace(middle - reach, middle + reach, LEVEL_COUNT + 1)
        colors = DIVERGING
    elif np.ptp(grid) < 1e-6:
        levels = np.linspace(grid.min() - 0.5, grid.min() + 0.5, LEVEL_COUNT + 1)
    drawn = axes.contourf(FIELD_H_DEG, FIELD_V_DEG, grid, levels=levels, cmap=colors)
    axes.plot(0.0, 0.0, "+", color="k", markersize=5, markeredgewidth=0.7)
    axes.set_aspect("equal")
    style_axes(axes, title=title, x="", y="")
    color_bar(axes, drawn, label=label)


def draw_field_maps(panel: FigureBase, study: EyeStudy) -> None:
    """Draw M, J0, J45 and blur over 60 x 40 deg, from the person's view."""
    m_dpt, j0_dpt, j45_dpt = study.field.power_dpt.T
    maps = {
        "M": (m_dpt, "dpt", float(m_dpt[m_dpt.size // 2])),
        "J0": (j0_dpt, "dpt", 0.0),
        "J45": (j45_dpt, "dpt", 0.0),
        "Blur, focused far": (blur_arcmin(study), "arcmin, RMS", None),
    }
    grid = panel.subplots(2, 2, sharex=True, sharey=True)
    for axes, (name, (values, label, middle)) in zip(
        grid.ravel(), maps.items(), strict=True
    ):
        draw_field_map(axes, values, title=name, label=label, middle=middle)
    sides = ("nasal", "temporal")
    left, right = sides if study.profile.eye_side == "OD" else sides[::-1]
    panel.supxlabel(
        f"{left}  ←  visual field, deg  →  {right}", fontsize=SMALL_PT, color=SOFT
    )
    if study.is_field_assumed:
        panel.suptitle(
            "Assumed off-axis: the average of people with such an axis",
            fontsize=TEXT_PT, color=SOFT,
        )  # fmt: skip
    panel.supylabel("elevation, deg", fontsize=SMALL_PT, color=SOFT)


def field_maps_figure(study: EyeStudy) -> Figure:
    """Return `draw_field_maps` as a figure."""
    figure = new_figure(125.0, 85.0)
    draw_field_maps(figure, study)
    return figure
