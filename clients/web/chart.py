"""A letter chart as a picture."""

from __future__ import annotations

import math
from dataclasses import replace

from clients.scenes.letter_chart import letter_chart
from clients.web.picture import ChartRow, Picture, camera_of, picture_of

ROWS = tuple(round(0.8 - 0.1 * k, 1) for k in range(10))
"""LogMAR, from 0.8 to -0.1."""

WIDTH_DEG = 9.6
SIZE_PX = (960, 540)


def chart_picture(distance_dpt: float) -> Picture:
    """Return a chart of the same visual angle at every distance."""
    camera = camera_of(WIDTH_DEG, width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    chart = letter_chart(camera, distance_m=math.inf, log_mar=ROWS)
    picture = picture_of("Letter chart", chart.view, distance_dpt=0.0)
    rows = tuple(ChartRow(row.log_mar, row.y_px / SIZE_PX[1]) for row in chart.rows)
    return replace(picture, chart_rows=rows).at(distance_dpt)
