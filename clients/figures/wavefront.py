"""Figures of a wavefront: maps, orders, coefficients, point images; section of the eye.

Maps of a wavefront over the pupil are drawn as the examiner sees them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Circle
from numpy.typing import NDArray

from clients.figures.study import (
    FIELD_PUPIL_MM,
    PUPILS_MM,
    TILTS,
    EyeStudy,
    PupilWavefront,
)
from clients.figures.style import (
    BLUE,
    DIVERGING,
    GREEN,
    INK,
    SMALL_PT,
    SOFT,
    TEXT_PT,
    color_bar,
    figure_of,
    legend_above,
    literal_legend,
    new_figure,
    style_axes,
    style_image_axes,
    with_grid,
)
from estimator import (
    EyeWithImplant,
    WornLens,
    compute_psfs,
    draw_section,
    nm_from_index,
    rescale_pupil,
    zernike_values,
)

MIN_AXIS_LIMIT_UM = 0.1
"""Smallest upper limit of an axis; smaller aberrations are negligible."""

LOWEST_BLURRING_ORDER, LOWEST_HIGHER_ORDER = 2, 3
"""Lowest order that blurs, and lowest order that spectacles do not correct."""

SIDE_COUNT = 161
LEVEL_COUNT = 13
LEAST_RMS_UM = 5e-4
"""Smallest RMS of a map; less is numerical."""

MIN_RANGE_UM = 0.05
"""Smallest half range of the colors; below a tenth of a wave there is no shape."""

SIDE_PX = 161
MIN_SIDE_ARCMIN = 20.0
SIDE_RATIO = 1.25
"""Ratio of the image's side to the diameter of the blur."""

ARCMIN_PER_MRAD = 60.0 * math.degrees(1e-3)
SLOPE_COUNT = 81
"""Number of points across a pupil at which ray directions are computed."""

DECADES = 3.0
"""Decades of light from white to black: the halo of a trifocal lens is 1/600 as bright
as the image of a point."""

NICE_ARCMIN = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600)


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
    title = f"RMS by order{studies[0].assumed_suffix}"
    style_axes(axes, title=title, x=f"radial order\n{note}", y="RMS, µm")
    axes.xaxis.label.set_fontsize(SMALL_PT)
    if labels:
        literal_legend(axes.figure, drawn, labels, loc="outside lower center")


def rms_by_order_figure(studies: Sequence[EyeStudy], **options: Any) -> Figure:
    """Return `draw_rms_by_order` as a figure."""
    return figure_of(62.0, 56.0, draw_rms_by_order, studies, **options)


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
    return figure_of(180.0, 55.0, draw_terms, study)


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


def wavefront_range_um(
    zernike_um: NDArray[np.float64], *, from_order: int = LOWEST_BLURRING_ORDER
) -> float:
    """Return the largest deviation of a wavefront (28,), for the scale of its map."""
    values = wavefront_values_um(zernike_um, from_order=from_order)
    return max(float(np.abs(values[in_circle(SIDE_COUNT)]).max()), MIN_RANGE_UM)


def draw_wavefront_map(
    axes: Axes,
    zernike_um: NDArray[np.float64],
    *,
    radius_mm: float,
    eye_side: str,
    from_order: int = LOWEST_BLURRING_ORDER,
    title: str = "",
    range_um: float | None = None,
) -> None:
    """Draw a map, facing the person: a right eye's temporal side is on the left.

    Parameters
    ----------
    zernike_um : (28,)
        Coefficients in the eye's frame, x to the person's right.
    range_um : float, optional
        Upper end of the color scale; by default, `wavefront_range_um` of the map.
    """
    rms = rms_um(zernike_um, from_order=from_order)
    if rms < LEAST_RMS_UM:
        is_higher = from_order >= LOWEST_HIGHER_ORDER
        known = "no higher orders\nin the coefficients" if is_higher else "flat"
        _draw_no_map(axes, title, known)
        return
    values = wavefront_values_um(zernike_um, from_order=from_order)[:, ::-1]
    top = wavefront_range_um(zernike_um, from_order=from_order)
    top = top if range_um is None else range_um
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
    axes.set_xlabel(
        f"{2 * radius_mm:.1f} mm pupil, RMS {rms:.2f} µm", fontsize=SMALL_PT, color=SOFT
    )
    color_bar(axes, drawn, label="µm")


def _draw_no_map(axes: Axes, title: str, text: str) -> None:
    """Say that there is nothing to draw."""
    style_image_axes(axes, title=title)
    axes.text(
        0.5, 0.5, text, color=SOFT,
        fontsize=SMALL_PT, ha="center", va="center", transform=axes.transAxes,
    )  # fmt: skip
    axes.set_box_aspect(1.0)


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
    """Draw one PSF over three decades of light, with a scale bar."""
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
    """Return wavefronts of a far point, uncorrected and corrected, for each pupil."""
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
    """Draw PSFs of a far point through 3 and 5 mm, uncorrected and best corrected.

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
        # on two lines, because the images may be lower than the text is long
        across[0].set_ylabel(name.replace(" ", "\n", 1), fontsize=TEXT_PT)
    for axes, state in zip(grid[0], rows["as it is"], strict=True):
        axes.set_title(f"{state.circle_diameter_mm:.3g} mm", fontsize=TEXT_PT)


def psfs_figure(study: EyeStudy) -> Figure:
    """Return `draw_psfs` as a figure."""
    figure = new_figure(80.0, 80.0)
    draw_psfs(figure, study)
    return figure


def draw_cross_section(axes: Axes, study: EyeStudy) -> None:
    """Draw an eye focused far, with rays from infinity through its correction.

    An implant is drawn if the eye is traced through it; an intraocular lens that acts
    as a phase is not.
    """
    focused, lens = study.found.focused(0.0), study.profile.correction
    if isinstance(lens, WornLens) and lens.replaces_lens:
        lens = None
    draw_section(axes, focused.surfaces, pupil_diameter_mm=FIELD_PUPIL_MM, lens=lens)
    length_mm = study.found.eye_length_mm
    suffix = "" if lens is None else ", corrected"
    if isinstance(study.found, EyeWithImplant):
        suffix = ", implant"
    style_axes(
        axes,
        title=f"Vertical section, {length_mm:.2f} mm long{suffix}",
        x="mm into the eye",
        y="mm, up",
    )


def cross_section_figure(study: EyeStudy) -> Figure:
    """Return `draw_cross_section` as a figure."""
    return figure_of(90.0, 65.0, draw_cross_section, study)
