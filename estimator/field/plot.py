"""Plots of wavefronts over the visual field."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from estimator.field.field_table import FieldTable

ARCMIN_PER_MRAD = 3.4377
COMA = [7, 8]


def plot_field(table: "FieldTable", file: Path, *, title: str) -> None:
    """Plot M, astigmatism, coma and blur: maps, or lines if one angle is constant.

    Blur is the RMS radius, in minutes of arc, of the geometric image of a point by the
    second order of the wavefront, over the circle of the pupil.
    """
    from matplotlib.figure import Figure  # loads slowly

    m_dpt, j0_dpt, j45_dpt = table.power_dpt.T
    maps = {
        "M, dpt": m_dpt,
        "astigmatism J, dpt": np.hypot(j0_dpt, j45_dpt),
        "coma, µm": np.linalg.norm(table.zernike_um[:, COMA], axis=1),
        "blur, RMS, arcmin": blur_arcmin(table),
    }
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    figure.suptitle(title)
    for axes, (name, values) in zip(
        figure.subplots(2, 2).ravel(), maps.items(), strict=True
    ):
        _draw(figure, axes, table, values)
        axes.set_title(name)
    figure.savefig(file, dpi=110)


def blur_arcmin(table: "FieldTable") -> NDArray[np.float64]:
    """Return the RMS blur (n,) of the second order, in minutes of arc."""
    m_dpt, j0_dpt, j45_dpt = table.power_dpt.T
    # Light at r mm is deflected by r times the power, in mrad; mean r² is R² / 2.
    power_dpt = np.sqrt(m_dpt**2 + j0_dpt**2 + j45_dpt**2)
    blur: NDArray[np.float64] = (
        ARCMIN_PER_MRAD * power_dpt * table.zernike_radius_mm / np.sqrt(2.0)
    )
    return blur


def _draw(
    figure: "Figure", axes: "Axes", table: "FieldTable", values: NDArray[Any]
) -> None:
    h_deg, v_deg = np.unique(table.h_deg), np.unique(table.v_deg)
    axes.set_xlabel("h, deg")
    if h_deg.size < 2 or v_deg.size < 2:
        along = table.h_deg if h_deg.size > 1 else table.v_deg
        order = np.argsort(along)
        axes.plot(along[order], values[order], "o-")
        return
    order = np.lexsort((table.h_deg, table.v_deg))
    grid = values[order].reshape(v_deg.size, h_deg.size)
    drawn = axes.contourf(h_deg, v_deg, grid, levels=16, cmap="viridis")
    axes.set_ylabel("v, deg")
    axes.set_aspect("equal")
    figure.colorbar(drawn, ax=axes)
