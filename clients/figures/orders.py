"""Charts of a wavefront's RMS by radial order, and of its coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from clients.figures.study import EyeStudy
from clients.figures.style import (
    BLUE,
    GREEN,
    INK,
    SMALL_PT,
    SOFT,
    legend_above,
    literal_legend,
    new_figure,
    style_axes,
    with_grid,
)
from estimator import nm_from_index, rescale_pupil

MIN_AXIS_LIMIT_UM = 0.1
"""Smallest upper limit of an axis; smaller aberrations are negligible."""

LOWEST_BLURRING_ORDER, LOWEST_HIGHER_ORDER = 2, 3
"""Lowest order that blurs, and lowest order that spectacles do not correct."""


def order_range(order: int) -> slice:
    """Return the slice of the terms of a radial order."""
    first = order * (order + 1) // 2
    return slice(first, first + order + 1)


def rms_by_order_um(zernike_um: NDArray[np.float64]) -> dict[int, float]:
    """Return the RMS of each order from 2 on, µm.

    The total RMS is the root of the sum of their squares.
    """
    highest, _ = nm_from_index(len(zernike_um) - 1)
    return {
        n: float(np.linalg.norm(zernike_um[order_range(n)]))
        for n in range(LOWEST_BLURRING_ORDER, highest + 1)
    }


def rms_um(
    zernike_um: NDArray[np.float64], *, from_order: int = LOWEST_HIGHER_ORDER
) -> float:
    """Return the RMS of an order and all above it, µm."""
    return float(np.linalg.norm(zernike_um[order_range(from_order).start :]))


def on_circle_um(study: EyeStudy, radius_mm: float) -> NDArray[np.float64]:
    """Return a study's measured wavefront on a smaller circle (n_terms,)."""
    ratio = radius_mm / study.found.zernike_radius_mm
    return rescale_pupil(study.measured_um, radius_ratio=min(ratio, 1.0))


def draw_rms_by_order(
    axes: Axes, studies: Sequence[EyeStudy], *, labels: Sequence[str] = ()
) -> None:
    """Draw the higher orders of one or more eyes, on the smallest of their circles.

    The second order, which is much larger, is given as text.
    """
    radius_mm = min(study.found.zernike_radius_mm for study in studies)
    wavefronts_um = [on_circle_um(study, radius_mm) for study in studies]
    highest = max(max(rms_by_order_um(wave_um)) for wave_um in wavefronts_um)
    orders = range(LOWEST_HIGHER_ORDER, highest + 1)
    names = [*map(str, orders), f"{LOWEST_HIGHER_ORDER}-{highest}"]
    width, positions = 0.8 / len(studies), np.arange(len(names))
    seconds, drawn = [], []
    colored = zip(wavefronts_um, (BLUE, GREEN), strict=False)
    for k, (wavefront_um, color) in enumerate(colored):
        by_order = rms_by_order_um(wavefront_um)
        values = [*(by_order.get(n, 0.0) for n in orders), rms_um(wavefront_um)]
        at = positions + (k - 0.5 * (len(studies) - 1)) * width
        bars = axes.bar(at, values, width * 0.92, color=color)
        drawn.append(bars)
        axes.bar_label(
            bars,
            [f"{v:.2f}" for v in values],
            fontsize=SMALL_PT,
            color=INK,
            padding=1,
            rotation=0 if len(studies) == 1 else 90,
        )
        seconds.append(f"{by_order[2]:.2f}")
    axes.set_xticks(positions, names)
    axes.margins(y=0.4 if labels else 0.18)  # labels are above the bars
    axes.set_ylim(0.0, max(axes.get_ylim()[1], MIN_AXIS_LIMIT_UM))
    note = f"{2 * radius_mm:.1f} mm pupil; order 2: {', '.join(seconds)} µm"
    title = f"RMS by radial order{studies[0].assumed_suffix}"
    style_axes(axes, title=title, x=f"radial order\n{note}", y="RMS, µm")
    axes.xaxis.label.set_fontsize(SMALL_PT)
    if labels:
        literal_legend(axes.figure, drawn, labels, loc="outside lower center")


def rms_by_order_figure(studies: Sequence[EyeStudy], **options: Any) -> Figure:
    """Return `draw_rms_by_order` as a figure."""
    figure = new_figure(62.0, 56.0)
    draw_rms_by_order(figure.subplots(), studies, **options)
    return figure


def draw_terms(axes: Axes, study: EyeStudy) -> None:
    """Draw each higher-order coefficient: measured, and of the estimated eye."""
    index = np.arange(order_range(LOWEST_HIGHER_ORDER).start, study.measured_um.size)
    measured, eye = study.measured_um[index], study.found.zernike_um[index]
    source = "assumed" if study.has_assumed_aberrations else study.source_label
    axes.bar(index - 0.2, measured, 0.4, color=SOFT, label=source)
    axes.bar(index + 0.2, eye, 0.4, color=BLUE, label="estimated eye")
    names = [
        "{},{:+d}".format(*nm_from_index(int(j))).replace("+0", "0") for j in index
    ]
    axes.set_xticks(index, names, rotation=90)
    reach_um = max(1.1 * np.abs([measured, eye]).max(), MIN_AXIS_LIMIT_UM)
    axes.set_ylim(-reach_um, reach_um)
    style_axes(axes, title="Coefficients by order and frequency", x="n, m", y="µm, RMS")
    axes.axhline(0.0, color=SOFT, linewidth=0.6)
    with_grid(axes)
    legend_above(axes)


def terms_figure(study: EyeStudy) -> Figure:
    """Return `draw_terms` as a figure."""
    figure = new_figure(180.0, 55.0)
    draw_terms(figure.subplots(), study)
    return figure
