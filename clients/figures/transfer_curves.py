"""Modulation transfer of an eye's optics by spatial frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from clients.figures.study import PUPILS_MM, WAVELENGTH_NM, EyeStudy
from clients.figures.style import (
    BLUE,
    GREEN,
    INK,
    LINE_PT,
    PUPIL_COLORS,
    SOFT,
    draw_band,
    legend_below,
    mark_unknown,
    new_figure,
    style_axes,
    with_grid,
)
from estimator import perfect_transfer

FREQUENCY_CPD = np.linspace(0.0, 60.0, 121)
CORRECTED: dict[str, Any] = {"linestyle": "-", "linewidth": LINE_PT}
AS_IT_IS: dict[str, Any] = {"linestyle": "--", "linewidth": LINE_PT}
PERFECT: dict[str, Any] = {"linestyle": ":", "linewidth": 0.8}


def modulation(
    study: EyeStudy,
    pupil_diameter_mm: float,
    *,
    is_corrected: bool = False,
    at_cpd: NDArray[np.float64] = FREQUENCY_CPD,
) -> NDArray[np.float64]:
    """Return the modulation transfer (n,) of a far object, mean over all directions.

    NaN if the wavefront is too steep to be resolved, where hardly any contrast is left,
    and through lenslets.

    Parameters
    ----------
    is_corrected : bool
        Whether the best sphere and cylinder for this pupil are worn.
    at_cpd : (n,)
    """
    wavefront = study.far(pupil_diameter_mm)
    seen = wavefront.best_corrected if is_corrected else wavefront
    try:
        return seen.transfer().modulation(at_cpd)
    except ValueError:
        return np.full(at_cpd.shape, np.nan)


def draw_mtf(
    axes: Axes,
    study: EyeStudy,
    *,
    drawn_modulation: Mapping[float, NDArray[np.float64]] | None = None,
) -> None:
    """Draw MTFs through 3 and 5 mm pupils, and the diffraction limit.

    Parameters
    ----------
    drawn_modulation : mapping, optional
        Best corrected MTFs (N, n) of N drawn persons by pupil, to draw as bands.
    """
    colors = dict(zip(PUPILS_MM, PUPIL_COLORS, strict=True))
    for pupil_mm, color in colors.items():
        _draw_states(axes, study, pupil_mm, color)
        axes.plot(FREQUENCY_CPD, _perfect(pupil_mm), color=color, **PERFECT)
        if drawn_modulation:
            values = drawn_modulation[pupil_mm]
            draw_band(axes, FREQUENCY_CPD, values, color=color)
    looks = [(f"{pupil_mm:g} mm", {"color": c}) for pupil_mm, c in colors.items()]
    _finish(axes, looks, "Contrast transfer (MTF), far object, 555 nm")


def draw_mtf_of_several(
    axes: Axes, studies: Sequence[EyeStudy], *, labels: Sequence[str], pupil_mm: float
) -> None:
    """Draw the transfer functions of several eyes through one pupil."""
    looks = []
    for study, label, color in zip(studies, labels, (BLUE, GREEN), strict=True):
        looks.append((label, {"color": color}))
        _draw_states(axes, study, pupil_mm, color)
    axes.plot(FREQUENCY_CPD, _perfect(pupil_mm), color=SOFT, **PERFECT)
    _finish(axes, looks, f"Contrast transfer (MTF), far object, {pupil_mm:g} mm")


def _draw_states(axes: Axes, study: EyeStudy, pupil_mm: float, color: str) -> None:
    for is_corrected, looks in ((True, CORRECTED), (False, AS_IT_IS)):
        values = modulation(study, pupil_mm, is_corrected=is_corrected)
        axes.plot(FREQUENCY_CPD, values, color=color, **looks)
    if not study.far(pupil_mm).is_readable:
        mark_unknown(axes)


def _perfect(pupil_mm: float) -> NDArray[np.float64]:
    return perfect_transfer(
        FREQUENCY_CPD, pupil_diameter_mm=pupil_mm, wavelength_nm=WAVELENGTH_NM
    )


def _finish(
    axes: Axes, looks: Sequence[tuple[str, dict[str, Any]]], title: str
) -> None:
    style_axes(axes, title=title, x="cycles per degree", y="modulation")
    axes.set_xlim(0.0, FREQUENCY_CPD[-1])
    axes.set_ylim(0.0, 1.0)
    with_grid(axes)
    styles = {
        "best corrected": CORRECTED,
        "as it is": AS_IT_IS,
        "no aberrations": PERFECT,
    }
    black = [(name, {"color": INK} | style) for name, style in styles.items()]
    legend_below(axes, [*looks, *black])


def mtf_figure(study: EyeStudy) -> Figure:
    """Return `draw_mtf` as a figure."""
    figure = new_figure(90.0, 65.0)
    draw_mtf(figure.subplots(), study)
    return figure
