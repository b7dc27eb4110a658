"""The content of a report on one eye, computed before it is written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.figures import DrawnPeople, EyeStudy, drawn_people
from clients.figures.study import PUPILS_MM, Profile, ProgressCallback
from clients.report.charts import DISTANCES_M, Chart, charts_of
from clients.report.labels import own_name
from clients.report.numbers import chart_numbers, eye_numbers, people_numbers
from filter_service import FilterError

NUMBERS_START_FRACTION, CHARTS_START_FRACTION = 0.1, 0.5
"""Progress fractions at which numbers and charts begin."""

PEOPLE_START_FRACTION = 0.5
"""Progress fraction at which drawn persons begin, after everything else."""


@dataclass(frozen=True)
class EyeFacts:
    """One eye's study, numbers and images.

    Attributes
    ----------
    label : str
        Name of the eye in this report; empty if it has none.
    charts : dict
        Images (height, width, 3) by pupil, mm, and distance, m.  Empty if they could
        not be computed; ``chart_problem`` gives the reason.
    people : DrawnPeople or None
        Persons drawn from the population, if requested.
    """

    study: EyeStudy
    label: str
    numbers: dict[str, Any]
    charts: dict[Chart, NDArray[np.uint8]] = field(default_factory=dict)
    chart_problem: str = ""
    people: DrawnPeople | None = None

    @property
    def chart_numbers(self) -> dict[Chart, dict[str, Any]]:
        """Return the predicted numbers of each chart."""
        return {
            (asked_mm, entry["distance_m"]): entry
            for asked_mm, entry in zip(
                np.repeat(PUPILS_MM, len(DISTANCES_M)).tolist(),
                self.numbers["charts"],
                strict=True,
            )
        }


def facts_of(
    profile: Profile,
    *,
    label: str = "",
    has_charts: bool = True,
    people: int | None = None,
    progress: ProgressCallback | None = None,
) -> EyeFacts:
    """Compute the content of a report on an eye.

    Parameters
    ----------
    label : str
        Name to use instead of the profile's.
    has_charts : bool
        Whether to filter letter charts (about a quarter of the run time).
    people : int, optional
        Number of persons to draw from the population.
    progress : callable, optional
        Called with a fraction and a stage.

    Raises
    ------
    ValueError
        If the profile is invalid, no light passes through the eye, or there is nothing
        to draw.
    """
    eye_share = 1.0 if people is None else PEOPLE_START_FRACTION

    def report_progress(fraction: float, stage: str) -> None:
        if progress is not None:
            progress(eye_share * fraction, stage)

    def report_people(fraction: float) -> None:
        if progress is not None:
            progress(eye_share + (1.0 - eye_share) * fraction, "drawn persons")

    report_progress(0.0, "eye")
    study = EyeStudy.of(profile)
    report_progress(NUMBERS_START_FRACTION, "numbers")
    numbers = eye_numbers(study)
    numbers["charts"] = [
        chart_numbers(study, pupil_mm, distance_m)
        for pupil_mm in PUPILS_MM
        for distance_m in DISTANCES_M
    ]
    charts, problem = _charts(study, has_charts, report_progress)
    drawn = None
    if people is not None:
        drawn = drawn_people(study, people, progress=report_people)
        numbers["people"] = people_numbers(drawn)
    return EyeFacts(
        study, label or own_name(study.profile), numbers, charts, problem, drawn
    )


def _charts(
    study: EyeStudy, has_charts: bool, report_progress: ProgressCallback
) -> tuple[dict[Chart, NDArray[np.uint8]], str]:
    if not has_charts:
        return {}, "not requested"
    report_progress(CHARTS_START_FRACTION, "letter charts")

    def report_charts(fraction: float) -> None:
        done = CHARTS_START_FRACTION + (1.0 - CHARTS_START_FRACTION) * fraction
        report_progress(done, "letter charts")

    try:
        return charts_of(study, progress=report_charts), ""
    except FilterError as error:  # the report is useful without them
        return {}, str(error)
