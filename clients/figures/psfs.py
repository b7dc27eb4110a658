"""Images of an eye's point-spread functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from clients.figures.pupil_wavefront import TILTS, PupilWavefront
from clients.figures.study import PUPILS_MM, EyeStudy
from clients.figures.style import SMALL_PT, TEXT_PT, new_figure, style_image_axes
from clients.figures.wavefront import in_circle, wavefront_values_um
from estimator import compute_psfs

SIDE_PX = 161
MIN_SIDE_ARCMIN = 20.0
SIDE_RATIO = 1.25
"""Ratio of the image's side to the diameter of the blur."""

ARCMIN_PER_MRAD = 60.0 * math.degrees(1e-3)
SLOPE_COUNT = 81
"""Number of points across a pupil at which ray directions are computed."""

DECADES = 2.0
"""Decades of light from white to black."""

NICE_ARCMIN = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600)


def ray_directions_mrad(wavefront: PupilWavefront) -> NDArray[np.float64]:
    """Return the ray directions of a pupil (n, 2), x and y."""
    radius_mm = wavefront.circle_diameter_mm / 2.0
    values_um = wavefront_values_um(wavefront.zernike_um, from_order=1, n=SLOPE_COUNT)
    step_mm = 2.0 * radius_mm / (SLOPE_COUNT - 1)
    down, right = np.gradient(values_um, step_mm)
    slopes = np.stack([right, -down], axis=-1).reshape(-1, 2)
    return slopes[in_circle(SLOPE_COUNT).ravel()]


def centered(wavefront: PupilWavefront) -> tuple[PupilWavefront, float]:
    """Return the wavefront with its blur centered, and the blur's radius, arcmin."""
    slopes = ray_directions_mrad(wavefront)
    middle = (slopes.min(axis=0) + slopes.max(axis=0)) / 2.0
    zernike_um = wavefront.zernike_um.copy()
    # Z(1,±1) is 2 x / r or 2 y / r, and tilt moves a point by its slope.
    zernike_um[TILTS] -= 0.5 * wavefront.circle_diameter_mm / 2.0 * middle[::-1]
    reach_mrad = np.linalg.norm(slopes - middle, axis=1).max()
    reach_mrad += main_reach_mrad(wavefront)
    return replace(wavefront, zernike_um=zernike_um), reach_mrad * ARCMIN_PER_MRAD


def main_reach_mrad(wavefront: PupilWavefront) -> float:
    """Return the deflection of light to the foci of rings, or by lenslets, mrad."""
    rings, radius_mm = wavefront.rings, wavefront.circle_diameter_mm / 2.0
    if rings is None:
        return 0.0
    if not wavefront.is_readable:
        return float(rings.reach_mrad(radius_mm, wavefront.wavelength_nm))
    return float(np.abs(rings.main_dpt(wavefront.wavelength_nm)).max() * radius_mm)


def psf_picture(
    wavefront: PupilWavefront, *, side_arcmin: float
) -> NDArray[np.float32]:
    """Return the PSF (161, 161), top row first, with unit sum."""
    state: dict[str, Any] = {
        "pupil_diameter_mm": wavefront.circle_diameter_mm,
        "pupil_ellipse": wavefront.pupil_ellipse,
        "wavelength_nm": wavefront.wavelength_nm,
        "pixel_pitch_mrad": side_arcmin / SIDE_PX / ARCMIN_PER_MRAD,
        "radius_px": SIDE_PX // 2,
        "accuracy": "fine",
    }
    try:  # combined with ray optics, it shows seams on a logarithmic scale
        found = compute_psfs(
            wavefront.zernike_um[None],
            method="fourier",
            pupil_screen=wavefront.rings,
            **state,
        )
    except ValueError:  # too steep: blur is far wider than the rings' effect
        found = compute_psfs(wavefront.zernike_um[None], **state)
    return found[0].kernel


def draw_psf(
    axes: Axes, wavefront: PupilWavefront, *, side_arcmin: float, title: str = ""
) -> None:
    """Draw one PSF over two decades of light, with a scale bar."""
    kernel = psf_picture(wavefront, side_arcmin=side_arcmin)
    light = np.log10(np.maximum(kernel / kernel.max(), 10.0**-DECADES))
    half = side_arcmin / 2.0
    axes.imshow(
        light, cmap="inferno", vmin=-DECADES, vmax=0.0,
        extent=(-half, half, -half, half), interpolation="bilinear",
    )  # fmt: skip
    style_image_axes(axes, title=title)
    _draw_scale(axes, side_arcmin)


def _draw_scale(axes: Axes, side_arcmin: float) -> None:
    length = max(a for a in NICE_ARCMIN if a <= 0.4 * side_arcmin)
    left, low = -0.45 * side_arcmin, -0.43 * side_arcmin
    axes.plot([left, left + length], [low, low], color="white", linewidth=1.5)
    axes.text(
        left, low + 0.03 * side_arcmin, f"{length}′", color="white", fontsize=SMALL_PT,
        va="bottom",
    )  # fmt: skip


def psf_sides_arcmin(studies: Sequence[EyeStudy]) -> tuple[float, float]:
    """Return the image sides that contain the PSFs of all studies.

    Returns
    -------
    as_it_is_arcmin, corrected_arcmin : float
    """
    states = [_states(study) for study in studies]
    return _side_arcmin(states, "as it is"), _side_arcmin(states, "best corrected")


def _side_arcmin(states: list[dict[str, list[PupilWavefront]]], name: str) -> float:
    reaches_arcmin = (centered(seen)[1] for state in states for seen in state[name])
    return max(MIN_SIDE_ARCMIN, 2.0 * SIDE_RATIO * max(reaches_arcmin))


def _states(study: EyeStudy) -> dict[str, list[PupilWavefront]]:
    """Return wavefronts of a far point through 3 and 5 mm, as is and corrected."""
    states = [study.far(pupil_mm) for pupil_mm in PUPILS_MM]
    return {
        "as it is": states,
        "best corrected": [state.best_corrected for state in states],
    }


def draw_psfs(
    panel: FigureBase,
    study: EyeStudy,
    *,
    sides_arcmin: tuple[float, float] | None = None,
) -> None:
    """Draw PSFs of a far point through 3 and 5 mm: as it is, and best corrected.

    Parameters
    ----------
    sides_arcmin : (float, float), optional
        Sides of the images of both rows, to compare eyes at one scale; by default those
        that contain the PSFs of this eye.
    """
    rows = _states(study)
    if sides_arcmin is None:
        sides_arcmin = psf_sides_arcmin([study])
    grid = panel.subplots(2, 2)
    for across, side_arcmin, (name, wavefronts) in zip(
        grid, sides_arcmin, rows.items(), strict=True
    ):
        for axes, wavefront in zip(across, wavefronts, strict=True):
            draw_psf(axes, centered(wavefront)[0], side_arcmin=side_arcmin)
        across[0].set_ylabel(name, fontsize=TEXT_PT)
    for axes, state in zip(grid[0], rows["as it is"], strict=True):
        axes.set_title(f"{state.circle_diameter_mm:.3g} mm", fontsize=TEXT_PT)


def psfs_figure(study: EyeStudy) -> Figure:
    """Return `draw_psfs` as a figure."""
    figure = new_figure(80.0, 80.0)
    draw_psfs(figure, study)
    return figure
