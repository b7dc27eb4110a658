"""Figures of an eye for the page, as PNG; they run in a process beside it."""

from __future__ import annotations

import io
import json
from functools import lru_cache

from matplotlib.figure import Figure

from clients.figures import (
    EyeStudy,
    cross_section_figure,
    draw_wavefront_map,
    field_maps_figure,
)

DOTS_PER_INCH = 220
FIGURE_TITLES = {
    "wavefront": "Wavefront",
    "field": "Field",
    "section": "Section",
}
MM_PER_INCH = 25.4


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
        The profile as JSON: the eye is kept by it.
    """
    study = _study(body)
    if name == "field":
        figure = field_maps_figure(study)
    elif name == "section":
        figure = cross_section_figure(study)
    else:
        figure = _wavefront_figure(study, pupil_diameter_mm, focus_dpt)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()


def _wavefront_figure(
    study: EyeStudy, pupil_diameter_mm: float, focus_dpt: float
) -> Figure:
    """Return the wavefront in this pupil, of the distance that the eye looks at."""
    seen = study.wavefront(pupil_diameter_mm, object_dpt=focus_dpt, focus_dpt=focus_dpt)
    figure = Figure(
        figsize=(95.0 / MM_PER_INCH, 75.0 / MM_PER_INCH), layout="constrained"
    )
    draw_wavefront_map(
        figure.subplots(),
        seen.zernike_um,
        radius_mm=seen.circle_diameter_mm / 2.0,
        eye_side=study.profile.eye_side,
        title=f"Looking at {focus_dpt:.2f} dpt",
    )
    return figure
