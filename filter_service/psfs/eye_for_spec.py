"""The eye of a profile, over the pupils, foci and directions of a cache."""

from collections.abc import Callable
from dataclasses import replace

from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.worn_lens import WornLens, depends_on_gaze
from estimator.field.eye_optics import EyeOptics
from estimator.field.prepare import prepare_eye
from estimator.field.trace_range import FieldRange
from estimator.field.traced_eye import MAX_PUPIL_MM
from estimator.note import Note
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import EyeProfile
from filter_service.errors import BuildCancelled
from filter_service.planning.grid import GridSpec, pupil_nodes_mm

NO_LATERAL_COLOR = Note(
    "lateral_color_ignored",
    "settings.lateral_color has no effect on a measured wavefront; "
    "it requires a traced eye",
)

ONE_GAZE = Note(
    "one_gaze",
    "the lens is evaluated for the middle of settings.gaze_range_deg; the "
    "other gaze directions use the same part of the lens",
)


def eye_for_spec(
    profile: EyeProfile,
    spec: GridSpec,
    *,
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> tuple[EyeOptics, tuple[str, ...]]:
    """Return the eye and notes about it; see `estimator.prepare_eye`.

    Parameters
    ----------
    cancelled : callable, optional
        Called at every step; returns whether to cancel.

    Raises
    ------
    ValueError
        If no light passes the eye.
    BuildCancelled
    """

    def report(fraction: float, stage: str) -> None:
        if cancelled is not None and cancelled():
            raise BuildCancelled("replaced by a newer profile")
        if progress is not None:
            progress(fraction, stage)

    settings = spec.settings
    if isinstance(profile.correction, WornLens) and profile.correction.rings:
        _check_diffraction(settings.diffraction)
    if settings.age_years is not None:
        profile = replace(profile, age_years=settings.age_years)
    lens = profile.correction
    if isinstance(lens, ProgressiveLens | WornLens) and depends_on_gaze(lens):
        lens = lens.with_gaze_offset(settings.gaze_deg)
        profile = replace(profile, correction=lens)
    low_mm, high_mm = (min(p, MAX_PUPIL_MM) for p in settings.pupil_range_mm)
    eye, notes = prepare_eye(
        profile,
        pupil_diameters_mm=pupil_nodes_mm((low_mm, high_mm)),
        focus_range_dpt=settings.focus_range_dpt,
        wavelengths_nm=spec.traced_wavelengths_nm,
        field_range_deg=_with_axis(spec.field_range_deg),
        eye_model=settings.eye_model,
        progress=report,
    )
    if isinstance(eye, MeasuredWavefront):
        if settings.lateral_color:
            notes = (*notes, NO_LATERAL_COLOR)
    elif settings.accuracy != "exact":
        text = f"accuracy {settings.accuracy!r} has no effect: the eye is traced"
        notes = (*notes, Note("accuracy_ignored", text))
    if depends_on_gaze(profile.correction) and any(settings.gaze_range_deg):
        notes = (*notes, ONE_GAZE)
    return eye, notes


def _check_diffraction(diffraction: bool) -> None:
    if not diffraction:
        raise ValueError(
            "settings.diffraction is false, but the rings of a lens with several foci "
            "require diffraction; allowed: true"
        )


def _with_axis(ranges_deg: FieldRange) -> FieldRange:
    """Return field ranges extended to the axis, where the eye focuses."""
    (left, right), (down, up) = ranges_deg
    return (min(left, 0.0), max(right, 0.0)), (min(down, 0.0), max(up, 0.0))
