"""A letter chart as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from clients.scenes.letter_chart import letter_chart
from clients.web.picture import ChartRow, Picture, camera_of, picture_of

ROWS = tuple(round(0.8 - 0.1 * k, 1) for k in range(10))
"""LogMAR, from 0.8 to -0.1."""

WIDTH_DEG = 9.6
SIZE_PX = (960, 540)
ROUNDING = 0.05
"""A row counts as read from half a step below its size."""


def chart_picture(distance_dpt: float) -> Picture:
    """Return a chart of the same visual angle at every distance."""
    camera = camera_of(WIDTH_DEG, width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    chart = letter_chart(camera, distance_m=math.inf, log_mar=ROWS)
    picture = picture_of("Letter chart", chart.view, distance_dpt=0.0)
    rows = tuple(ChartRow(row.log_mar, row.y_px / SIZE_PX[1]) for row in chart.rows)
    return replace(picture, chart_rows=rows).at(distance_dpt)


def row_text(log_mar: float) -> str:
    """Return a row's size in logMAR and as a decimal acuity."""
    return f"{log_mar:.1f} · {10.0**-log_mar:.2f}".replace("-", "\N{MINUS SIGN}")


def smallest_row(rows: Sequence[float], acuity_log_mar: float) -> int | None:
    """Return the index of the smallest row that an acuity reads; None if it reads none.

    Parameters
    ----------
    rows : logMAR of each row, largest first
    """
    read = [k for k, row in enumerate(rows) if row >= acuity_log_mar - ROUNDING]
    return read[-1] if read else None
