"""Refraction of drawn persons along the horizontal meridian."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from clients.figures.drawn_curves import DrawnPeople
from clients.figures.study import FIELD_H_DEG, EyeStudy
from clients.figures.style import (
    BLUE,
    LINE_PT,
    SOFT,
    draw_band,
    legend_below,
    style_axes,
    with_grid,
)

INNER, INNER_ALPHA = (25.0, 75.0), 0.25


def draw_field_line(axes: Axes, study: EyeStudy, people: DrawnPeople) -> None:
    """Draw M along the horizontal meridian: an eye, and bands of drawn persons."""
    drawn_dpt = people.field.power_dpt[..., 0]
    draw_band(axes, FIELD_H_DEG, drawn_dpt, color=BLUE)
    draw_band(
        axes, FIELD_H_DEG, drawn_dpt, color=BLUE, percentiles=INNER, alpha=INNER_ALPHA
    )
    median_dpt = np.median(drawn_dpt, axis=0)
    axes.plot(FIELD_H_DEG, median_dpt, color=BLUE, linewidth=LINE_PT)
    on_meridian = study.field.v_deg == 0.0
    own_dpt = study.field.power_dpt[on_meridian, 0]
    own: dict[str, Any] = {"color": SOFT, "linestyle": "--", "linewidth": LINE_PT}
    axes.plot(study.field.h_deg[on_meridian], own_dpt, **own)
    style_axes(
        axes,
        title=f"M along the horizontal, {people.count} drawn persons",
        x="h, deg; positive to the person's right",
        y="M, dpt",
    )
    axes.set_xlim(FIELD_H_DEG[0], FIELD_H_DEG[-1])
    with_grid(axes)
    wide: dict[str, Any] = {"linewidth": 6.0, "color": BLUE}
    legend_below(
        axes,
        [
            ("this report's eye", own),
            ("median", {"color": BLUE}),
            ("25 to 75 %", wide | {"alpha": 0.4}),
            ("5 to 95 %", wide | {"alpha": 0.18}),
        ],
    )
