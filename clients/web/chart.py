"""A letter chart as a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from clients.scenes.letter_chart import letter_chart, letter_height, row_texts
from clients.web.picture import ChartRow, Picture, camera_of, picture_of

ROWS = tuple(round(1.0 - 0.1 * k, 1) for k in range(12))
"""LogMAR, from 1.0 to -0.1."""

WIDTH_DEG = 13.6
"""The largest row takes 7.5 deg, which leaves space for the labels beside it."""

SIZE_PX = (1200, 675)
HALF_WIDTH_HEIGHTS = 4.5
"""Half of a row's width in letter heights: five letters and their gaps."""


def chart_picture(distance_dpt: float) -> Picture:
    """Return a chart that has the same visual angle at every distance."""
    camera = camera_of(WIDTH_DEG, width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    chart = letter_chart(camera, distance_m=math.inf, log_mar=ROWS)
    picture = picture_of("Letter chart", chart.view, distance_dpt=0.0)
    half_width = math.tan(math.radians(WIDTH_DEG) / 2.0)
    rows = tuple(
        ChartRow(
            row.log_mar,
            row.y_px / SIZE_PX[1],
            0.5 + letter_height(row.log_mar) * HALF_WIDTH_HEIGHTS / half_width / 2.0,
        )
        for row in chart.rows
    )
    # the camera turns with the eye, so that the rows stay on the fovea
    return replace(picture, chart_rows=rows, follows_gaze=True).at(distance_dpt)


def marks_of(
    rows: Sequence[ChartRow], smallest_rows: Mapping[str, int | None]
) -> list[dict[str, Any]]:
    """Return the labels of a chart's rows.

    Parameters
    ----------
    smallest_rows : index of the smallest row that each eye can read, or None
    """
    return [
        {
            "y": row.y_ratio,
            "x": row.end_ratio,
            "log_mar": row_texts(row.log_mar)[0],
            "decimal": row_texts(row.log_mar)[1],
            "eyes": [eye for eye, smallest in smallest_rows.items() if smallest == k],
        }
        for k, row in enumerate(rows)
    ]


def caption(rows: Sequence[ChartRow], smallest: int | None) -> str:
    """Describe the smallest row that an eye can read."""
    found = "none of these rows"
    if smallest is not None:
        found = "logMAR {}, decimal {}".format(*row_texts(rows[smallest].log_mar))
    return f"smallest line read: {found}"
