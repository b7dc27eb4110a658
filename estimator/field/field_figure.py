"""Figure of an eye over its visual field: maps, and point-spread functions."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimator.field.field_table import DrawnFields, FieldTable
from estimator.optics.units import MRAD_PER_RAD
from estimator.psf.compute import compute_psf_batch, plan_psfs
from estimator.psf.drawing import draw_psf

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

ARCMIN_PER_MRAD = 3.4377

BAND_PERCENTILES = (5.0, 25.0, 50.0, 75.0, 95.0)
"""Limits of the outer and inner band of drawn persons, and their median between."""

MAX_COLUMNS, MAX_ROWS = 9, 5
RADIUS_PX = 40
LIGHT_RATIO, MARGIN_ARCMIN = 0.98, 2.0
"""Share of the light of the widest PSF within the images, and room for diffraction."""

MRAD_PER_ARCMIN = MRAD_PER_RAD * np.radians(1.0 / 60.0)


def plot_field(
    table: FieldTable,
    file: Path,
    *,
    title: str,
    drawn: DrawnFields | None = None,
) -> None:
    """Plot M, astigmatism, coma and blur: maps, or lines if one angle is constant.

    Blur is the RMS radius, in minutes of arc, of the geometric image of a point by the
    second order of the wavefront, over the circle of the pupil.  PSFs of the table, at
    most 9 x 5, are below.

    Parameters
    ----------
    drawn : DrawnFields, optional
        Drawn persons in the directions of the table.  Lines are then their medians,
        within bands from the 5th to the 95th and from the 25th to the 75th percentile.
        Maps are their medians, with contour lines of half the width of the outer band.
    """
    field_figure(table, title=title, drawn=drawn).savefig(file, dpi=110)


def field_figure(
    table: FieldTable, *, title: str, drawn: DrawnFields | None = None
) -> "Figure":
    """Return the figure of `plot_field`."""
    from matplotlib.figure import Figure  # loads slowly

    n_rows = len(shown_directions(table))
    heights = (6.5, 0.6 + 1.25 * n_rows)
    figure = Figure(figsize=(10, sum(heights)), layout="constrained")
    panels: Any = figure.subfigures(2, 1, height_ratios=heights)
    maps_panel, psfs_panel = panels
    if drawn is not None:
        title += f"; {len(drawn.coma_um)} drawn persons: {_band_text(table)}"
    figure.suptitle(title, parse_math=False)  # a name may contain $
    maps = _maps(table if drawn is None else drawn)
    for axes, (name, values) in zip(
        maps_panel.subplots(2, 2).ravel(), maps.items(), strict=True
    ):
        _draw(maps_panel, axes, table, values)
        axes.set_title(name)
    draw_field_psfs(psfs_panel, table)
    return figure


def blur_arcmin(table: FieldTable | DrawnFields) -> NDArray[np.float64]:
    """Return the RMS blur (..., n) of the second order, in minutes of arc."""
    # Light at r mm is deflected by r times the power, in mrad; mean r² is R² / 2.
    power_dpt = np.linalg.norm(table.power_dpt, axis=-1)
    return ARCMIN_PER_MRAD * power_dpt * table.zernike_radius_mm / np.sqrt(2.0)


def _maps(table: FieldTable | DrawnFields) -> dict[str, NDArray[np.float64]]:
    """Return the plotted values (..., n) by title."""
    return {
        "M, dpt": table.power_dpt[..., 0],
        "astigmatism J, dpt": np.linalg.norm(table.power_dpt[..., 1:], axis=-1),
        "coma, µm": table.coma_um,
        "blur, RMS, arcmin": blur_arcmin(table),
    }


def _is_line(table: FieldTable) -> bool:
    return np.unique(table.h_deg).size < 2 or np.unique(table.v_deg).size < 2


def _band_text(table: FieldTable) -> str:
    if _is_line(table):
        return "median, 25th to 75th and 5th to 95th percentile"
    return "median; white: half the width from the 5th to the 95th percentile"


def _draw(
    figure: "FigureBase", axes: "Axes", table: FieldTable, values: NDArray[Any]
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


def shown_directions(table: FieldTable) -> NDArray[np.int64]:
    """Return the indices (rows, columns) of directions to show, the upper row first.

    They are evenly spaced, at most `MAX_ROWS` x `MAX_COLUMNS`.
    """
    v_deg, h_deg = np.unique(table.v_deg)[::-1], np.unique(table.h_deg)
    rows, columns = (
        angles[
            np.linspace(0, angles.size - 1, min(angles.size, most)).round().astype(int)
        ]
        for angles, most in ((v_deg, MAX_ROWS), (h_deg, MAX_COLUMNS))
    )
    distance = np.abs(table.v_deg - rows[:, None, None]) + np.abs(
        table.h_deg - columns[:, None]
    )
    return distance.argmin(axis=-1)


def psfs_of_field(
    table: FieldTable, indices: NDArray[np.int64]
) -> tuple[NDArray[np.float32], float]:
    """Return PSFs (n, y, x) in directions (n,), and half the side of each, arcmin."""
    waves, rings = table.in_pupil, table.eye.rings
    arguments: dict[str, Any] = {
        "zernike_um": waves.zernike_um[indices],
        "pupil_diameter_mm": waves.circle_diameter_mm[indices],
        "pupil_ellipse": waves.pupil_ellipse[indices],
        "wavelength_nm": table.wavelength_nm,
        "pupil_screen": rings
        and rings.seen_from(table.h_deg[indices], table.v_deg[indices]),
    }
    side = 2 * RADIUS_PX + 1
    rows, columns = np.mgrid[:side, :side] - RADIUS_PX
    radius_px = np.hypot(rows, columns)

    def computed(half_side_arcmin: float) -> NDArray[np.float32]:
        pitch_mrad = half_side_arcmin * MRAD_PER_ARCMIN / (RADIUS_PX + 0.5)
        batch = compute_psf_batch(
            **arguments,
            pixel_pitch_mrad=pitch_mrad,
            radius_px=RADIUS_PX,
        )
        return batch.flat_kernels.reshape(-1, side, side)

    plan = plan_psfs(**arguments, pixel_pitch_mrad=1.0, max_radius_px=100_000)
    widest = float(plan.survey.blur_radius_px.max()) / MRAD_PER_ARCMIN + MARGIN_ARCMIN
    order = np.argsort(radius_px, axis=None)
    light = np.cumsum(computed(widest).reshape(-1, side**2)[:, order], axis=1)
    last = np.argmax(light >= LIGHT_RATIO * light[:, -1:], axis=1)
    shown_px = float(radius_px.ravel()[order][last].max()) + 0.5
    half_side = widest * shown_px / (RADIUS_PX + 0.5)
    return computed(half_side), half_side


def draw_field_psfs(panel: "FigureBase", table: FieldTable) -> None:
    """Draw the PSFs of a far point over the field, all at one scale."""
    places = shown_directions(table)
    kernels, half_side = psfs_of_field(table, places.ravel())
    grid = panel.subplots(*places.shape, squeeze=False)
    for axes, index, kernel in zip(
        grid.ravel(), places.ravel().tolist(), kernels, strict=True
    ):
        draw_psf(axes, kernel, half_side_arcmin=half_side)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_title(
            f"{table.h_deg[index]:g}, {table.v_deg[index]:g}", fontsize="x-small"
        )
    panel.suptitle(
        f"PSFs at h, v deg: {2.0 * half_side:.3g} arcmin wide, logarithmic",
        fontsize="medium",
    )
