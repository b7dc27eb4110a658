"""Curves of an eye by spatial frequency, distance and direction, and of drawn persons.

Drawn persons have the prescription of an eye, or its wavefront on the axis, and differ
in everything else.  Their curves are coarser than the curves of an `EyeStudy`: a person
takes 0.3 s instead of 5 s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from clients.figures.study import (
    FIELD_H_DEG,
    FIELD_PUPIL_MM,
    FIELD_V_DEG,
    PUPILS_MM,
    WAVELENGTH_NM,
    EyeStudy,
    acuity_log_mar,
)
from clients.figures.style import (
    BLUE,
    DIVERGING,
    GREEN,
    INK,
    LINE_PT,
    PUPIL_COLORS,
    SEQUENTIAL,
    SMALL_PT,
    SOFT,
    TEXT_PT,
    color_bar,
    draw_band,
    figure_of,
    legend_below,
    mark_unknown,
    new_figure,
    style_axes,
    with_grid,
)
from clients.figures.wavefront import ARCMIN_PER_MRAD, rms_um
from estimator import (
    DrawnFields,
    drawn_fields,
    drawn_profiles,
    draws_axis,
    draws_eye,
    perfect_transfer,
)

FREQUENCY_CPD = np.linspace(0.0, 60.0, 121)
CORRECTED: dict[str, Any] = {"linestyle": "-", "linewidth": LINE_PT}
AS_IT_IS: dict[str, Any] = {"linestyle": "--", "linewidth": LINE_PT}
PERFECT: dict[str, Any] = {"linestyle": ":", "linewidth": 0.8}

WORST_LOG_MAR, BEST_LOG_MAR = 1.6, -0.3
ACCOMMODATING: dict[str, Any] = {"linestyle": "-", "linewidth": LINE_PT}
FOCUSED_FAR: dict[str, Any] = {"linestyle": "--", "linewidth": LINE_PT}
EDGE_RATIO = 0.95
"""Position along the axis beyond which a centered text would cross its end."""

MARKS = {0.0: " far", 1.0: "1 m", 2.5: "40 cm", 5.0: "20 cm", 10.0: "10 cm"}
MIN_RANGE_DPT = 0.25
LEVEL_COUNT = 14
ACUITY_PUPIL_MM = PUPILS_MM[0]
"""Pupil of the acuity of drawn persons; the larger one would take another 0.1 s."""

SHARP_STEP_CPD, N_SAMPLES = 1.0, 64
"""Coarser than by default.  In 12 persons of three prescriptions, modulation is within
0.003 (of one in three at 5 mm 0.012)."""

UNRESOLVED_LOG_MAR = 2.5
"""Acuity of wavefronts that are too steep to be resolved, as for `log_mar_of`."""

INNER, INNER_ALPHA = (25.0, 75.0), 0.25


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
    _finish_mtf(axes, looks, "Contrast transfer (MTF), far object, 555 nm")


def draw_mtf_of_several(
    axes: Axes, studies: Sequence[EyeStudy], *, labels: Sequence[str], pupil_mm: float
) -> None:
    """Draw the transfer functions of several eyes through one pupil."""
    looks = []
    for study, label, color in zip(studies, labels, (BLUE, GREEN), strict=True):
        looks.append((label, {"color": color}))
        _draw_states(axes, study, pupil_mm, color)
    axes.plot(FREQUENCY_CPD, _perfect(pupil_mm), color=SOFT, **PERFECT)
    _finish_mtf(axes, looks, f"Contrast transfer (MTF), far object, {pupil_mm:g} mm")


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


def _finish_mtf(
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
    return figure_of(90.0, 65.0, draw_mtf, study)


def draw_through_focus_acuity(
    axes: Axes,
    study: EyeStudy,
    *,
    pupils_mm: Sequence[float] = PUPILS_MM,
    drawn_log_mar: Mapping[float, NDArray[np.float64]] | None = None,
) -> None:
    """Draw acuity by distance through several pupils: focused far and accommodating.

    Parameters
    ----------
    drawn_log_mar : mapping, optional
        Acuity (N, n) of N drawn persons who accommodate, at the distances of the
        study, by pupil, to draw as bands.
    """
    colors = dict(zip(pupils_mm, PUPIL_COLORS, strict=False))
    for pupil_mm, color in colors.items():
        found = study.acuity(pupil_mm)
        axes.plot(found.object_dpt, found.near_log_mar, color=color, **ACCOMMODATING)
        axes.plot(found.object_dpt, found.far_log_mar, color=color, **FOCUSED_FAR)
        if drawn_log_mar and pupil_mm in drawn_log_mar:
            draw_band(axes, found.object_dpt, drawn_log_mar[pupil_mm], color=color)
    looks = [(f"{pupil_mm:g} mm", {"color": c}) for pupil_mm, c in colors.items()]
    styles = {"accommodating": ACCOMMODATING, "focused far": FOCUSED_FAR}
    black = [(name, {"color": INK} | style) for name, style in styles.items()]
    _finish_acuity(axes, found.object_dpt[-1], [*looks, *black], "Acuity by distance")
    if np.isnan(found.far_log_mar[0]):
        mark_unknown(axes)


def draw_acuity_of_several(
    axes: Axes, studies: Sequence[EyeStudy], *, labels: Sequence[str], pupil_mm: float
) -> None:
    """Draw the acuity of several accommodating eyes through one pupil."""
    looks = []
    nearest_dpt, is_known = 0.0, True
    for study, label, color in zip(studies, labels, (BLUE, GREEN), strict=True):
        looks.append((label, {"color": color}))
        found = study.acuity(pupil_mm)
        axes.plot(found.object_dpt, found.near_log_mar, color=color, **ACCOMMODATING)
        is_known &= not np.isnan(found.far_log_mar[0])
        nearest_dpt = max(nearest_dpt, float(found.object_dpt[-1]))
    title = f"Acuity by distance, accommodating, {pupil_mm:g} mm"
    _finish_acuity(axes, nearest_dpt, looks, title)
    if not is_known:
        mark_unknown(axes)


def _finish_acuity(
    axes: Axes,
    nearest_dpt: float,
    looks: Sequence[tuple[str, dict[str, Any]]],
    title: str,
) -> None:
    style_axes(axes, title=title, x="distance of the chart, dpt", y="acuity, logMAR")
    axes.set_xlim(0.0, nearest_dpt)
    axes.set_ylim(WORST_LOG_MAR, BEST_LOG_MAR)  # better is higher, as on charts
    axes.set_yticks(np.arange(-0.2, 1.61, 0.2))
    with_grid(axes)
    for distance_dpt, name in MARKS.items():
        if distance_dpt <= nearest_dpt:
            axes.text(
                distance_dpt, WORST_LOG_MAR - 0.03, name, fontsize=SMALL_PT, color=SOFT,
                ha=_alignment(distance_dpt / nearest_dpt), va="bottom",
            )  # fmt: skip
    legend_below(axes, looks)


def _alignment(position_ratio: float) -> str:
    """Return the text alignment that keeps a label within the axis."""
    if position_ratio == 0.0:
        return "left"
    return "center" if position_ratio < EDGE_RATIO else "right"


def through_focus_acuity_figure(study: EyeStudy) -> Figure:
    """Return `draw_through_focus_acuity` as a figure."""
    return figure_of(90.0, 65.0, draw_through_focus_acuity, study)


def blur_arcmin(study: EyeStudy) -> NDArray[np.float64]:
    """Return the blur (n,) of each direction for an eye focused far, arcmin.

    It is the RMS radius of a far point's blur from second-order aberrations.
    """
    m_dpt, j0_dpt, j45_dpt = study.field.power_dpt.T
    m_dpt = m_dpt - study.far_accommodation_dpt
    # A ray at r mm is deflected by r times the power, in mrad; mean r² is R² / 2.
    power_dpt = np.sqrt(m_dpt**2 + j0_dpt**2 + j45_dpt**2)
    return ARCMIN_PER_MRAD * power_dpt * study.field.zernike_radius_mm / np.sqrt(2.0)


def draw_field_map(
    axes: Axes,
    values: NDArray[np.float64],
    *,
    title: str,
    label: str,
    middle: float | None = None,
    compared: Sequence[NDArray[np.float64]] = (),
) -> None:
    """Draw a map of values (n,) of the field's directions.

    Parameters
    ----------
    middle : float, optional
        Value at which the diverging colors are white; sequential colors if None.
    compared : sequence of (n,)
        Values of all maps that have the same colors, with these ones.
    """
    of_all = np.concatenate([values, *compared])
    grid = values.reshape(FIELD_V_DEG.size, FIELD_H_DEG.size)
    levels: int | NDArray[np.float64]
    levels, colors = LEVEL_COUNT, SEQUENTIAL
    if middle is not None:
        reach = max(float(np.abs(of_all - middle).max()), MIN_RANGE_DPT)
        levels = np.linspace(middle - reach, middle + reach, LEVEL_COUNT + 1)
        colors = DIVERGING
    elif np.ptp(of_all) < 1e-6:
        levels = np.linspace(grid.min() - 0.5, grid.min() + 0.5, LEVEL_COUNT + 1)
    elif compared:
        levels = np.linspace(of_all.min(), of_all.max(), LEVEL_COUNT + 1)
    drawn = axes.contourf(FIELD_H_DEG, FIELD_V_DEG, grid, levels=levels, cmap=colors)
    axes.plot(0.0, 0.0, "+", color="k", markersize=5, markeredgewidth=0.7)
    axes.set_aspect("equal")
    style_axes(axes, title=title, x="", y="")
    color_bar(axes, drawn, label=label)


def draw_field_maps(
    panel: FigureBase, study: EyeStudy, *, compared: Sequence[EyeStudy] = ()
) -> None:
    """Draw M, J0, J45 and blur over 60 x 40 deg, from the person's view.

    Parameters
    ----------
    compared : sequence of EyeStudy
        Eyes whose maps have the same colors, with this one.
    """
    studies = (study, *compared)
    powers_dpt = [each.field.power_dpt.T for each in studies]
    m_dpt = [power[0] for power in powers_dpt]
    middle_dpt = float(np.mean([m[m.size // 2] for m in m_dpt[-len(compared) :]]))
    maps = {
        "M": (m_dpt, "dpt", middle_dpt),
        "J0": ([power[1] for power in powers_dpt], "dpt", 0.0),
        "J45": ([power[2] for power in powers_dpt], "dpt", 0.0),
        "Blur, focused far": (
            [blur_arcmin(each) for each in studies],
            "arcmin, RMS",
            None,
        ),
    }
    grid = panel.subplots(2, 2, sharex=True, sharey=True)
    for axes, (name, (values, label, middle)) in zip(
        grid.ravel(), maps.items(), strict=True
    ):
        draw_field_map(
            axes, values[0], title=name, label=label, middle=middle, compared=values[1:]
        )
    sides = ("nasal", "temporal")
    left, right = sides if study.profile.eye_side == "OD" else sides[::-1]
    panel.supxlabel(
        f"{left}  ←  visual field, deg  →  {right}", fontsize=SMALL_PT, color=SOFT
    )
    if study.is_field_assumed:
        panel.suptitle(
            "Assumed off-axis: the average of people with such an axis",
            fontsize=TEXT_PT, color=SOFT,
        )  # fmt: skip
    panel.supylabel("elevation, deg", fontsize=SMALL_PT, color=SOFT)


def field_maps_figure(study: EyeStudy) -> Figure:
    """Return `draw_field_maps` as a figure."""
    figure = new_figure(125.0, 85.0)
    draw_field_maps(figure, study)
    return figure


@dataclass(frozen=True)
class DrawnPeople:
    """Persons drawn from the population.

    Attributes
    ----------
    count : int
        Number N of persons.
    field : DrawnFields
        Relaxed, along the horizontal meridian (`FIELD_H_DEG`), through 4 mm.
    modulation : dict of (N, n)
        MTFs of a far object by pupil, best corrected, at `FREQUENCY_CPD`.  This and
        the following are empty if the axis is not drawn, and through lenslets.
    higher_order_rms_um : dict of (N,)
        By pupil, in the entrance pupil.
    log_mar : dict of (N, n)
        Acuity of accommodating persons by pupil, at the distances of the study.
    """

    count: int
    field: DrawnFields
    modulation: dict[float, NDArray[np.float64]]
    higher_order_rms_um: dict[float, NDArray[np.float64]]
    log_mar: dict[float, NDArray[np.float64]]


def drawn_people(
    study: EyeStudy, count: int, *, progress: Callable[[float], None] | None = None
) -> DrawnPeople:
    """Draw persons with the profile of a study.

    Parameters
    ----------
    count : int
        Number of persons, 2 to 1000.
    progress : callable, optional
        Called with the completed fraction.

    Raises
    ------
    ValueError
        The count is not allowed, or persons with this profile do not differ.
    """
    has_axis = (draws_axis(study.profile) or draws_eye(study.profile)) and study.far(
        ACUITY_PUPIL_MM
    ).is_readable
    steps = (1 + has_axis) * count
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done / steps)

    field = drawn_fields(
        study.profile,
        count,
        progress=advance,
        h_deg=FIELD_H_DEG,
        v_deg=0.0,
        pupil_diameter_mm=study.optics.usable_pupil_mm(FIELD_PUPIL_MM),
        wavelength_nm=WAVELENGTH_NM,
    )
    axes = []
    for profile in drawn_profiles(study.profile, count) if has_axis else ():
        axes.append(_axis_of(study, EyeStudy.of(profile)))
        advance()
    if not axes:
        return DrawnPeople(count, field, {}, {}, {})
    modulation, higher_order_rms_um, log_mar = zip(*axes, strict=True)
    return DrawnPeople(
        count,
        field,
        dict(zip(PUPILS_MM, np.stack(modulation, axis=1), strict=True)),
        dict(zip(PUPILS_MM, np.stack(higher_order_rms_um, axis=1), strict=True)),
        {ACUITY_PUPIL_MM: np.stack(log_mar)},
    )


def _axis_of(
    study: EyeStudy, person: EyeStudy
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the MTFs (pupils, n), RMS (pupils,) and acuity (m,) of a person."""
    seen = [person.far(pupil_mm) for pupil_mm in PUPILS_MM]
    modulation = [
        wavefront.near_best_corrected(n_samples=N_SAMPLES)
        .transfer(frequency_step_cpd=SHARP_STEP_CPD)
        .modulation(FREQUENCY_CPD)
        for wavefront in seen
    ]
    rms = [rms_um(wavefront.zernike_um) for wavefront in seen]
    return np.array(modulation), np.array(rms), _acuity(study, person)


def _acuity(study: EyeStudy, person: EyeStudy) -> NDArray[np.float64]:
    """Return the acuity (n,) of a person at the distances of the study.

    The difference from the eye of the study is computed at the first and last distance
    and around both ends of accommodation, where it changes most, and interpolated.
    """
    known = study.acuity(ACUITY_PUPIL_MM)
    own = np.minimum(known.near_log_mar, UNRESOLVED_LOG_MAR)
    last = own.size - 1
    limits_dpt = study.optics.focus_limits_dpt(
        study.optics.usable_pupil_mm(ACUITY_PUPIL_MM)
    )
    far, near = np.abs(known.object_dpt[:, None] - limits_dpt).argmin(axis=0)
    chosen = np.clip([0, far - 1, far, near, near + 1, near + 3, last], 0, last)
    chosen = np.unique(chosen)
    at_dpt = known.object_dpt[chosen]
    seen = (
        person.wavefront(ACUITY_PUPIL_MM, object_dpt=at, focus_dpt=at)
        for at in at_dpt.tolist()
    )
    found = np.minimum([*map(acuity_log_mar, seen)], UNRESOLVED_LOG_MAR)
    return own + np.interp(known.object_dpt, at_dpt, found - own[chosen])


def draw_field_line(axes: Axes, study: EyeStudy, people: DrawnPeople) -> None:
    """Draw M along the horizontal meridian: an eye, and bands of drawn persons."""
    drawn_dpt = people.field.power_dpt[..., 0]
    draw_band(axes, FIELD_H_DEG, drawn_dpt, color=BLUE)
    draw_band(
        axes, FIELD_H_DEG, drawn_dpt, color=BLUE, percentiles=INNER, alpha=INNER_ALPHA
    )
    median_dpt = np.median(drawn_dpt, axis=0)
    axes.plot(FIELD_H_DEG, median_dpt, color=BLUE, linewidth=LINE_PT)
    on_meridian = study.field.v_deg == 0.0
    own_dpt = study.field.power_dpt[on_meridian, 0]
    own: dict[str, Any] = {"color": SOFT, "linestyle": "--", "linewidth": LINE_PT}
    axes.plot(study.field.h_deg[on_meridian], own_dpt, **own)
    style_axes(
        axes,
        title=f"M along the horizontal, {people.count} drawn persons",
        x="h, deg; positive to the person's right",
        y="M, dpt",
    )
    axes.set_xlim(FIELD_H_DEG[0], FIELD_H_DEG[-1])
    with_grid(axes)
    wide: dict[str, Any] = {"linewidth": 6.0, "color": BLUE}
    legend_below(
        axes,
        [
            ("this report's eye", own),
            ("median", {"color": BLUE}),
            ("25 to 75 %", wide | {"alpha": 0.4}),
            ("5 to 95 %", wide | {"alpha": 0.18}),
        ],
    )
