"""A vertical cross-section of the estimated eye, with rays."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from clients.figures.study import FIELD_PUPIL_MM, EyeStudy
from clients.figures.style import new_figure, style_axes
from estimator import WornLens, draw_section


def draw_cross_section(axes: Axes, study: EyeStudy) -> None:
    """Draw an eye focused far, with rays from infinity through its correction.

    An intraocular lens is not drawn: the eye model has its natural lens.
    """
    focused, lens = study.found.focused(0.0), study.profile.correction
    if isinstance(lens, WornLens) and lens.replaces_lens:
        lens = None
    draw_section(axes, focused.surfaces, pupil_diameter_mm=FIELD_PUPIL_MM, lens=lens)
    length_mm = study.found.eye_length_mm
    suffix = "" if lens is None else ", corrected"
    style_axes(
        axes,
        title=f"Vertical section, {length_mm:.2f} mm long{suffix}",
        x="mm into the eye",
        y="mm, up",
    )


def cross_section_figure(study: EyeStudy) -> Figure:
    """Return `draw_cross_section` as a figure."""
    figure = new_figure(90.0, 65.0)
    draw_cross_section(figure.subplots(), study)
    return figure
