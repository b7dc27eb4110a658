"""What to build first, so that a new eye is seen at once and sharpens later."""

from __future__ import annotations

from filter_service.building.jobs import LookAt
from filter_service.building.used_ranges import UsedRanges
from filter_service.planning.grid import GridSpec

PUPIL_ROOM_MM, FOCUS_ROOM_DPT = 0.1, 0.05
"""So far from its one state a preview is as good as it is there: 1 arcmin of blur."""

MIN_WHOLE_S = 0.3
"""A store that is predicted to take less to build is built at once: with the 0.2 to
0.5 s that estimating and tracing an eye take, it is there within a second."""

MIN_GAIN = 3.0
"""Nor does a preview help where the whole takes less than so many times its time."""


def preview_spec(spec: GridSpec, look_at: LookAt | None) -> GridSpec:
    """Return the grid of a preview: one pupil and one focus, every distance and field.

    Parameters
    ----------
    look_at : LookAt or None
        The state of the last frame; without one the middle of the pupils, and the
        farthest focus.
    """
    low_mm, high_mm = spec.settings.pupil_range_mm
    low_dpt, high_dpt = spec.settings.focus_range_dpt
    if look_at is None:
        pupil_mm, focus_dpt = 0.5 * (low_mm + high_mm), low_dpt
    else:
        pupil_mm = min(max(look_at.pupil_diameter_mm, low_mm), high_mm)
        focus_dpt = min(max(look_at.focus_dpt, low_dpt), high_dpt)
    return spec.with_settings(
        pupil_range_mm=(pupil_mm, pupil_mm),
        focus_range_dpt=(focus_dpt, focus_dpt),
        mode="dynamic" if spec.follows_field else spec.settings.mode,
        grid="planned",
        tolerance="loose",
    )


def preview_ranges(spec: GridSpec) -> UsedRanges:
    """Return what frames may ask of a preview of such a grid."""
    settings = spec.settings
    pupil_mm, focus_dpt = settings.pupil_range_mm[0], settings.focus_range_dpt[0]
    return UsedRanges(
        (pupil_mm - PUPIL_ROOM_MM, pupil_mm + PUPIL_ROOM_MM),
        (focus_dpt - FOCUS_ROOM_DPT, focus_dpt + FOCUS_ROOM_DPT),
        settings.object_range_dpt,
        settings.object_planes_dpt,
    )


def is_worthwhile(*, preview_s: float, whole_s: float) -> bool:
    """Return whether to build a preview first, from the predicted times.

    For the on-axis mode; over the field even planning the whole takes longer than a
    preview, so there it always helps.
    """
    return whole_s >= max(MIN_WHOLE_S, MIN_GAIN * preview_s)
