"""Map of defocus over the visual field, with the power that zones or lenslets add."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from clients.figures.style import (
    DIVERGING,
    color_bar,
    new_figure,
    style_axes,
)
from estimator import EyeProfile, Lenslets, field_table

MAP_H_DEG = np.linspace(-30.0, 30.0, 13)
MAP_V_DEG = np.linspace(-20.0, 20.0, 9)
WAVELENGTH_NM = 555.0
_PUPIL_RINGS, _PUPIL_ANGLES = 24, 48


def added_power_dpt(
    profile: EyeProfile,
    *,
    pupil_diameter_mm: float,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    wavelength_nm: float = WAVELENGTH_NM,
) -> NDArray[np.float64]:
    """Return the mean power (n,) that zones or lenslets add, over the pupil's light.

    Parameters
    ----------
    profile : EyeProfile
        Eye with its correction; without zones or lenslets, the power is 0.
    pupil_diameter_mm : float
    h_deg, v_deg : (n,)
        Field directions.
    """
    h, v = np.broadcast_arrays(*(np.asarray(a, float) for a in (h_deg, v_deg)))
    rings = getattr(profile.correction, "rings", None)
    if rings is None:
        return np.zeros(h.shape)
    radius_mm = pupil_diameter_mm / 2.0
    if not isinstance(rings, Lenslets):
        light = rings.main_light_ratio(radius_mm, wavelength_nm)
        mean_dpt = rings.main_dpt(wavelength_nm) @ light / light.sum()
        return np.full(h.shape, float(mean_dpt))
    centers_mm = np.asarray(rings.seen_from(h, v).centre_mm)
    ring = np.sqrt((np.arange(_PUPIL_RINGS) + 0.5) / _PUPIL_RINGS) * radius_mm
    angle = 2.0 * np.pi * (np.arange(_PUPIL_ANGLES) + 0.5) / _PUPIL_ANGLES
    points_mm = np.stack(
        [np.outer(ring, f(angle)).ravel() for f in (np.cos, np.sin)], axis=-1
    )
    covered = _in_lenslets(points_mm - centers_mm[..., None, :], rings)
    return rings.power_dpt * covered.mean(axis=-1)


def _in_lenslets(points_mm: NDArray[np.float64], lens: Lenslets) -> NDArray[np.bool_]:
    """Return whether points (..., 2) of a lens are in one of its lenslets."""
    row_mm = lens.pitch_mm * math.sqrt(3.0) / 2.0
    x, y = np.moveaxis(points_mm, -1, 0)
    below = np.floor(y / row_mm)
    covered = np.zeros(x.shape, bool)
    for row in (below, below + 1.0):
        shift = row % 2.0 / 2.0
        column = np.round(x / lens.pitch_mm - shift)
        at_x, at_y = (column + shift) * lens.pitch_mm, row * row_mm
        center_mm = np.hypot(at_x, at_y)
        is_there = (center_mm >= lens.inner_mm) & (center_mm <= lens.outer_mm)
        near = np.hypot(x - at_x, y - at_y) <= lens.diameter_mm / 2.0
        covered |= is_there & near
    return covered


def field_defocus_dpt(
    profile: EyeProfile,
    *,
    pupil_diameter_mm: float,
    focus_dpt: float,
    h_deg: NDArray[np.float64] = MAP_H_DEG,
    v_deg: NDArray[np.float64] = MAP_V_DEG,
) -> NDArray[np.float64]:
    """Return the defocus (rows of v, columns of h) of the distance looked at.

    It is the spherical equivalent of what the eye has too much of, dpt: positive where
    light of an object at this distance comes to a focus in front of the retina.
    Zones and lenslets count with the share of the light that they focus.
    """
    h, v = (axis.ravel() for axis in np.meshgrid(h_deg, v_deg))
    table = field_table(
        profile,
        h_deg=h,
        v_deg=v,
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=WAVELENGTH_NM,
        focus_dpt=focus_dpt,
        object_dpt=focus_dpt,
    )
    added_dpt = added_power_dpt(
        profile, pupil_diameter_mm=pupil_diameter_mm, h_deg=h, v_deg=v
    )
    return (added_dpt - table.power_dpt[:, 0]).reshape(v_deg.size, h_deg.size)


def defocus_maps_figure(
    profiles: Mapping[str, EyeProfile], *, pupil_diameter_mm: float, focus_dpt: float
) -> Figure:
    """Return a map of defocus over the field for each profile, by its title."""
    maps = {
        title: field_defocus_dpt(
            profile, pupil_diameter_mm=pupil_diameter_mm, focus_dpt=focus_dpt
        )
        for title, profile in profiles.items()
    }
    largest_dpt = max(float(np.abs(values).max()) for values in maps.values())
    figure = new_figure(90.0 * len(maps), 68.0)
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, (title, values) in zip(panels, maps.items(), strict=True):
        _draw_map(axes, values, title=title, largest_dpt=largest_dpt)
    color_bar(
        panels[-1],
        panels[-1].images[0],
        label="dpt, positive in front of the retina",
    )
    return figure


def _draw_map(
    axes: Axes, values: NDArray[np.float64], *, title: str, largest_dpt: float
) -> None:
    axes.imshow(
        values,
        origin="lower",
        extent=(MAP_H_DEG[0], MAP_H_DEG[-1], MAP_V_DEG[0], MAP_V_DEG[-1]),
        vmin=-largest_dpt,
        vmax=largest_dpt,
        cmap=DIVERGING,
        interpolation="bilinear",
    )
    lines = axes.contour(
        MAP_H_DEG, MAP_V_DEG, values, levels=5, colors="black", linewidths=0.6
    )
    axes.clabel(lines, fmt="%.2g", fontsize=7)
    style_axes(axes, title=title, x="h, deg", y="v, deg")
