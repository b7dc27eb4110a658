"""Figures of an eye for the page, as PNG; drawn in a worker process."""

from __future__ import annotations

import io
import json
from functools import lru_cache

from matplotlib.figure import Figure

from clients.figures import (
    EyeStudy,
    acuity_log_mar,
    cross_section_figure,
    draw_through_focus_acuity,
    draw_wavefront_map,
)
from clients.figures.curves import blur_arcmin, draw_field_map

DOTS_PER_INCH = 220
FIGURE_TITLES = {
    "wavefront": "Wavefront",
    "field": "Field",
    "section": "Section",
    "acuity": "Acuity",
}
MM_PER_INCH = 25.4
AXIS_PT = 8.0


@lru_cache(maxsize=4)
def _study(body: str) -> EyeStudy:
    return EyeStudy.of(json.loads(body))


def eye_figure(
    name: str, body: str, *, pupil_diameter_mm: float, focus_dpt: float
) -> bytes:
    """Return a figure as a PNG.

    Parameters
    ----------
    name : one of `FIGURE_TITLES`
    body : str
        The profile as JSON, which is the cache key of the eye.
    """
    study = _study(body)
    if name == "field":
        figure = _field_figure(study)
    elif name == "section":
        figure = cross_section_figure(study)
    elif name == "acuity":
        figure = _acuity_figure(study, pupil_diameter_mm)
    else:
        figure = _wavefront_figure(study, pupil_diameter_mm, focus_dpt)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()


def predicted_log_mar(
    body: str, *, pupil_diameter_mm: float, focus_dpt: float, object_dpt: float
) -> float:
    """Return the acuity of an eye at a distance; not finite if it is unknown."""
    seen = _study(body).wavefront(
        pupil_diameter_mm, object_dpt=object_dpt, focus_dpt=focus_dpt
    )
    return acuity_log_mar(seen)


def _field_figure(study: EyeStudy) -> Figure:
    """Return refraction and blur over the visual field, from the person's view."""
    figure = Figure(figsize=_size(90.0, 98.0), layout="constrained")
    upper, lower = figure.subplots(2, 1)
    m_dpt = study.field.power_dpt.T[0]
    draw_field_map(
        upper,
        m_dpt,
        title="Refraction M",
        label="dpt",
        middle=float(m_dpt[m_dpt.size // 2]),
    )
    blur = blur_arcmin(study)
    draw_field_map(lower, blur, title="Blur, focused far", label="arcmin, RMS")
    for axes in (upper, lower):
        axes.set_ylabel("up, deg", fontsize=AXIS_PT)
    lower.set_xlabel("right, deg", fontsize=AXIS_PT)
    return figure


def _acuity_figure(study: EyeStudy, pupil_diameter_mm: float) -> Figure:
    """Return the visual acuity at each distance through this pupil."""
    figure = Figure(figsize=_size(95.0, 90.0), layout="constrained")
    draw_through_focus_acuity(figure.subplots(), study, pupils_mm=[pupil_diameter_mm])
    return figure


def _size(width_mm: float, height_mm: float) -> tuple[float, float]:
    return width_mm / MM_PER_INCH, height_mm / MM_PER_INCH


def _wavefront_figure(
    study: EyeStudy, pupil_diameter_mm: float, focus_dpt: float
) -> Figure:
    """Return the wavefront in this pupil for an object at the focus distance."""
    seen = study.wavefront(pupil_diameter_mm, object_dpt=focus_dpt, focus_dpt=focus_dpt)
    figure = Figure(figsize=_size(95.0, 75.0), layout="constrained")
    draw_wavefront_map(
        figure.subplots(),
        seen.zernike_um,
        radius_mm=seen.circle_diameter_mm / 2.0,
        eye_side=study.profile.eye_side,
        title=f"Focused at {focus_dpt:.2f} dpt",
    )
    return figure
