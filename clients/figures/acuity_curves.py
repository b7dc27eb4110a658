"""What an eye may read at each distance, as its optics let it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from clients.figures.study import PUPILS_MM, EyeStudy, PupilWavefront
from clients.figures.style import (
    BLUE,
    GREEN,
    INK,
    LINE_PT,
    PUPIL_COLORS,
    SMALL_PT,
    SOFT,
    dress,
    legend_below,
    new_figure,
    with_grid,
)
from estimator import log_mar_of

STEP_COUNT, WITHIN_COUNT = 11, 3
NEAREST_DPT = 5.0
PAST_FAR_POINT_DPT = 2.0
HIGHEST_DPT = 20.0
WORST_LOG_MAR, BEST_LOG_MAR = 1.6, -0.3
ACCOMMODATING: dict = {"linestyle": "-", "linewidth": LINE_PT}
LOOKING_FAR: dict = {"linestyle": "--", "linewidth": LINE_PT}
MARKS = {0.0: "far", 1.0: "1 m", 2.5: "40 cm", 5.0: "20 cm", 10.0: "10 cm"}


def acuity_log_mar(wavefront: PupilWavefront) -> float:
    """Return the acuity of a wavefront; infinite where it is too steep to be told."""
    try:
        return log_mar_of(wavefront.transfer())
    except ValueError:
        return np.inf


def distances_dpt(study: EyeStudy) -> NDArray[np.float64]:
    """Return the distances (n,) of a curve: far to 20 cm, and past the far point."""
    far_dpt, _ = study.optics.focus_limits_dpt(
        study.optics.usable_pupil_mm(PUPILS_MM[0])
    )
    nearest = min(max(NEAREST_DPT, far_dpt + PAST_FAR_POINT_DPT), HIGHEST_DPT)
    even = np.linspace(0.0, np.ceil(nearest), STEP_COUNT)
    has_peak = 0.0 < far_dpt < nearest
    return np.union1d(even, [far_dpt]) if has_peak else even


def through_focus_log_mar(
    study: EyeStudy, pupil_diameter_mm: float, object_dpt: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the acuity (n,) of an eye that looks far, logMAR, at distances (n,)."""
    return np.array(
        [
            acuity_log_mar(study.wavefront(pupil_diameter_mm, object_dpt=distance_dpt))
            for distance_dpt in object_dpt.tolist()
        ]
    )


def accommodated_log_mar(
    study: EyeStudy,
    pupil_diameter_mm: float,
    object_dpt: NDArray[np.float64],
    far_log_mar: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the acuity (n,) of an eye that accommodates for each distance, logMAR.

    Within the eye's reach it changes slowly: it is told at three distances and drawn
    through them.

    Parameters
    ----------
    far_log_mar : (n,)
        Of the same eye that looks far: beyond its far point it is no better.
    """
    pupil_mm = study.optics.usable_pupil_mm(pupil_diameter_mm)
    far_dpt, near_dpt = study.optics.focus_limits_dpt(pupil_mm)

    def seen(distances: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(
            [
                acuity_log_mar(study.wavefront(pupil_mm, object_dpt=d, focus_dpt=d))
                for d in distances.tolist()
            ]
        )

    found = far_log_mar.copy()
    is_near = object_dpt > near_dpt
    found[is_near] = seen(object_dpt[is_near])
    within = object_dpt[(object_dpt >= max(far_dpt, 0.0)) & ~is_near]
    if within.size:
        told = np.unique(np.linspace(within[0], within[-1], WITHIN_COUNT))
        found[np.isin(object_dpt, within)] = np.interp(within, told, seen(told))
    return found


def draw_through_focus_acuity(axes: Axes, study: EyeStudy) -> None:
    """Draw acuity by distance through 3 and 5 mm: looking far, and accommodating."""
    object_dpt = distances_dpt(study)
    colors = dict(zip(PUPILS_MM, PUPIL_COLORS, strict=True))
    for pupil_mm, color in colors.items():
        far = through_focus_log_mar(study, pupil_mm, object_dpt)
        near = accommodated_log_mar(study, pupil_mm, object_dpt, far)
        axes.plot(object_dpt, near, color=color, **ACCOMMODATING)
        axes.plot(object_dpt, far, color=color, **LOOKING_FAR)
    looks = {f"{pupil_mm:g} mm": {"color": c} for pupil_mm, c in colors.items()}
    styles = {"accommodating": ACCOMMODATING, "looking far": LOOKING_FAR}
    black = {name: {"color": INK} | style for name, style in styles.items()}
    _finish(axes, object_dpt, looks | black, "Acuity by distance")


def draw_acuity_of_several(
    axes: Axes, studies: Sequence[EyeStudy], *, labels: Sequence[str], pupil_mm: float
) -> None:
    """Draw the acuity of several eyes that accommodate, through one pupil."""
    object_dpt = max((distances_dpt(study) for study in studies), key=len)
    colors = dict(zip(labels, (BLUE, GREEN), strict=False))
    for study, color in zip(studies, colors.values(), strict=True):
        far = through_focus_log_mar(study, pupil_mm, object_dpt)
        values = accommodated_log_mar(study, pupil_mm, object_dpt, far)
        axes.plot(object_dpt, values, color=color, **ACCOMMODATING)
    looks = {label: {"color": color} for label, color in colors.items()}
    title = f"Acuity by distance, accommodating, {pupil_mm:g} mm"
    _finish(axes, object_dpt, looks, title)


def _finish(axes: Axes, object_dpt: NDArray, looks: dict, title: str) -> None:
    dress(axes, title=title, x="distance of the chart, dpt", y="acuity, logMAR")
    axes.set_xlim(object_dpt[0], object_dpt[-1])
    axes.set_ylim(WORST_LOG_MAR, BEST_LOG_MAR)  # better is higher, as on charts
    axes.set_yticks(np.arange(-0.2, 1.61, 0.2))
    with_grid(axes)
    for distance_dpt, name in MARKS.items():
        if distance_dpt <= object_dpt[-1]:
            axes.text(
                distance_dpt, WORST_LOG_MAR - 0.03, name, fontsize=SMALL_PT, color=SOFT,
                ha="left" if distance_dpt == 0.0 else "center", va="bottom",
            )  # fmt: skip
    legend_below(axes, looks)


def through_focus_acuity_figure(study: EyeStudy) -> Figure:
    """Return `draw_through_focus_acuity` as a figure."""
    figure = new_figure(90.0, 65.0)
    draw_through_focus_acuity(figure.subplots(), study)
    return figure
