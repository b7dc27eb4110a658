"""Plots of wavefronts over the visual field."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from estimator.field.field_table import DrawnFields, FieldTable

ARCMIN_PER_MRAD = 3.4377

BAND_PERCENTILES = (5.0, 25.0, 50.0, 75.0, 95.0)
"""Limits of the outer and inner band of drawn persons, and their median between."""


def plot_field(
    table: "FieldTable",
    file: Path,
    *,
    title: str,
    drawn: "DrawnFields | None" = None,
) -> None:
    """Plot M, astigmatism, coma and blur: maps, or lines if one angle is constant.

    Blur is the RMS radius, in minutes of arc, of the geometric image of a point by the
    second order of the wavefront, over the circle of the pupil.

    Parameters
    ----------
    drawn : DrawnFields, optional
        Drawn persons in the directions of the table.  Lines are then their medians,
        within bands from the 5th to the 95th and from the 25th to the 75th percentile.
        Maps are their medians, with contour lines of half the width of the outer band.
    """
    field_figure(table, title=title, drawn=drawn).savefig(file, dpi=110)


def field_figure(
    table: "FieldTable", *, title: str, drawn: "DrawnFields | None" = None
) -> "Figure":
    """Return the figure of `plot_field`."""
    from matplotlib.figure import Figure  # loads slowly

    figure = Figure(figsize=(10, 6.5), layout="constrained")
    if drawn is not None:
        title += f"; {len(drawn.coma_um)} drawn persons: {_band_text(table)}"
    figure.suptitle(title, parse_math=False)  # a name may contain $
    maps = _maps(table if drawn is None else drawn)
    for axes, (name, values) in zip(
        figure.subplots(2, 2).ravel(), maps.items(), strict=True
    ):
        _draw(figure, axes, table, values)
        axes.set_title(name)
    return figure


def blur_arcmin(table: "FieldTable | DrawnFields") -> NDArray[np.float64]:
    """Return the RMS blur (..., n) of the second order, in minutes of arc."""
    # Light at r mm is deflected by r times the power, in mrad; mean r² is R² / 2.
    power_dpt = np.linalg.norm(table.power_dpt, axis=-1)
    return ARCMIN_PER_MRAD * power_dpt * table.zernike_radius_mm / np.sqrt(2.0)


def _maps(table: "FieldTable | DrawnFields") -> dict[str, NDArray[np.float64]]:
    """Return the plotted values (..., n) by title."""
    return {
        "M, dpt": table.power_dpt[..., 0],
        "astigmatism J, dpt": np.linalg.norm(table.power_dpt[..., 1:], axis=-1),
        "coma, µm": table.coma_um,
        "blur, RMS, arcmin": blur_arcmin(table),
    }


def _is_line(table: "FieldTable") -> bool:
    return np.unique(table.h_deg).size < 2 or np.unique(table.v_deg).size < 2


def _band_text(table: "FieldTable") -> str:
    if _is_line(table):
        return "median, 25th to 75th and 5th to 95th percentile"
    return "median; white: half the width from the 5th to the 95th percentile"


def _draw(
    figure: "Figure", axes: "Axes", table: "FieldTable", values: NDArray[Any]
) -> None:
    """Draw values (n,), or those (N, n) of N drawn persons."""
    h_deg, v_deg = np.unique(table.h_deg), np.unique(table.v_deg)
    axes.set_xlabel("v, deg" if h_deg.size < 2 <= v_deg.size else "h, deg")
    order = np.lexsort((table.h_deg, table.v_deg))
    values = values[..., order]
    shown = values
    if values.ndim == 2:
        p5, p25, shown, p75, p95 = np.percentile(values, BAND_PERCENTILES, axis=0)
    if _is_line(table):
        along = (table.h_deg if h_deg.size > 1 else table.v_deg)[order]
        axes.plot(along, shown, "o-")
        if values.ndim == 2:
            axes.fill_between(along, p5, p95, alpha=0.15, color="C0", linewidth=0)
            axes.fill_between(along, p25, p75, alpha=0.3, color="C0", linewidth=0)
        return
    grid = (v_deg.size, h_deg.size)
    filled = axes.contourf(h_deg, v_deg, shown.reshape(grid), levels=16, cmap="viridis")
    axes.set_ylabel("v, deg")
    axes.set_aspect("equal")
    figure.colorbar(filled, ax=axes)
    if values.ndim == 2:
        half_width = ((p95 - p5) / 2.0).reshape(grid)
        lines = axes.contour(
            h_deg, v_deg, half_width, levels=5, colors="white", linewidths=0.8
        )
        axes.clabel(lines, fmt="±%g", fontsize=8)
