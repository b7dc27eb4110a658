"""Maps of a wavefront over the pupil, as seen by the examiner."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Circle
from numpy.typing import NDArray

from clients.figures.orders import LOWEST_BLURRING_ORDER, LOWEST_HIGHER_ORDER, rms_um
from clients.figures.study import EyeStudy
from clients.figures.style import (
    DIVERGING,
    SMALL_PT,
    SOFT,
    color_bar,
    new_figure,
    style_image_axes,
)
from estimator import zernike_values

SIDE_COUNT = 161
LEVEL_COUNT = 13
MIN_RANGE_UM = 0.05
"""Smallest half range of the colors; below a tenth of a wave there is no shape."""


def wavefront_values_um(
    zernike_um: NDArray[np.float64],
    *,
    from_order: int = LOWEST_BLURRING_ORDER,
    n: int = SIDE_COUNT,
) -> NDArray[np.float64]:
    """Return a wavefront's values (n, n) on the circle's square, top row first.

    Parameters
    ----------
    from_order : int
        Lowest radial order to draw.
    """
    along = np.linspace(-1.0, 1.0, n)
    x, y = np.meshgrid(along, -along)
    first = from_order * (from_order + 1) // 2
    values = zernike_values(x, y, n_terms=zernike_um.size)
    return values[..., first:] @ zernike_um[first:]


def in_circle(n: int) -> NDArray[np.bool_]:
    """Return a mask (n, n) of the values inside the pupil."""
    along = np.linspace(-1.0, 1.0, n)
    return np.hypot(along, along[:, None]) <= 1.0


def draw_wavefront_map(
    axes: Axes,
    zernike_um: NDArray[np.float64],
    *,
    radius_mm: float,
    eye_side: str,
    from_order: int = LOWEST_BLURRING_ORDER,
    title: str = "",
) -> None:
    """Draw a map, facing the person: a right eye's temporal side is on the left.

    Parameters
    ----------
    zernike_um : (28,)
        Coefficients in the eye's frame, x to the person's right.
    """
    values = wavefront_values_um(zernike_um, from_order=from_order)[:, ::-1]
    top = max(float(np.abs(values[in_circle(SIDE_COUNT)]).max()), MIN_RANGE_UM)
    drawn = axes.imshow(
        values,
        extent=(-radius_mm, radius_mm) * 2,
        cmap=DIVERGING,
        vmin=-top,
        vmax=top,
        interpolation="bilinear",
    )
    lines = axes.contour(
        values[::-1],
        extent=(-radius_mm, radius_mm) * 2,
        levels=np.linspace(-top, top, LEVEL_COUNT),
        colors="k",
        linewidths=0.3,
        alpha=0.5,
    )
    rim = Circle((0.0, 0.0), radius_mm, transform=axes.transData)
    drawn.set_clip_path(rim)
    lines.set_clip_path(rim)
    style_image_axes(axes, title=title)
    sides = ("T", "N") if eye_side == "OD" else ("N", "T")
    for x_mm, side in zip((-1.12, 1.12), sides, strict=True):
        axes.text(
            x_mm * radius_mm, 0.0, side, color=SOFT, fontsize=SMALL_PT,
            ha="center", va="center",
        )  # fmt: skip
    axes.set_xlim(-1.2 * radius_mm, 1.2 * radius_mm)
    rms = rms_um(zernike_um, from_order=from_order)
    axes.set_xlabel(
        f"{2 * radius_mm:.1f} mm pupil, RMS {rms:.2f} µm", fontsize=SMALL_PT, color=SOFT
    )
    color_bar(axes, drawn, label="µm")


def draw_wavefront_maps(panel: FigureBase, study: EyeStudy) -> None:
    """Draw the measured wavefront: all orders, and the higher orders."""
    for axes, from_order, title in zip(
        panel.subplots(1, 2),
        (LOWEST_BLURRING_ORDER, LOWEST_HIGHER_ORDER),
        ("All orders", f"Higher orders (3 to 6){study.assumed_suffix}"),
        strict=True,
    ):
        draw_wavefront_map(
            axes,
            study.measured_um,
            radius_mm=study.found.zernike_radius_mm,
            eye_side=study.profile.eye_side,
            from_order=from_order,
            title=title,
        )


def wavefront_map_figure(study: EyeStudy) -> Figure:
    """Return the map of an eye's wavefront at the cornea, without its correction."""
    figure = new_figure(125.0, 56.0)
    draw_wavefront_maps(figure, study)
    return figure
