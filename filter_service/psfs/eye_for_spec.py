"""The eye of a profile, over the pupils, foci and directions of a cache."""

from collections.abc import Callable
from dataclasses import replace

from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.worn_lens import WornLens, turns_with_gaze
from estimator.field.eye_optics import EyeOptics
from estimator.field.prepare import prepare_eye
from estimator.field.trace_range import FieldRange
from estimator.field.traced_eye import MAX_PUPIL_MM
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import EyeProfile
from filter_service.errors import BuildCancelled
from filter_service.planning.grid import GridSpec, pupil_nodes_mm

NO_LATERAL_COLOR = "a measured wavefront holds no lateral color: it needs a traced eye"


ONE_GAZE = (
    "the lens is that of the middle of settings.gaze_range_deg: "
    "other gazes use the same part of it"
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
        Called at every step.

    Raises
    ------
    ValueError
        If light does not pass the eye.
    BuildCancelled
    """

    def report(fraction: float, stage: str) -> None:
        if cancelled is not None and cancelled():
            raise BuildCancelled("replaced by a newer profile")
        if progress is not None:
            progress(fraction, stage)

    settings = spec.settings
    if isinstance(profile.correction, WornLens) and profile.correction.rings:
        _check_diffracts(settings.diffraction)
    if settings.age_years is not None:
        profile = replace(profile, age_years=settings.age_years)
    lens = profile.correction
    if isinstance(lens, ProgressiveLens | WornLens) and turns_with_gaze(lens):
        worn = lens.looking(settings.gaze_deg)
        profile = replace(profile, correction=worn)
    low_mm, high_mm = (min(p, MAX_PUPIL_MM) for p in settings.pupil_range_mm)
    eye, notes = prepare_eye(
        profile,
        pupil_diameters_mm=pupil_nodes_mm((low_mm, high_mm)),
        focus_range_dpt=settings.focus_range_dpt,
        wavelengths_nm=spec.traced_wavelengths_nm,
        field_range_deg=_with_axis(spec.field_range_deg),
        eye_model=settings.eye_model,
        accuracy=settings.accuracy,
        progress=report,
    )
    if settings.lateral_color and isinstance(eye, MeasuredWavefront):
        notes = (*notes, NO_LATERAL_COLOR)
    if turns_with_gaze(profile.correction) and any(settings.gaze_range_deg):
        notes = (*notes, ONE_GAZE)
    return eye, notes


def _check_diffracts(diffraction: bool) -> None:
    if not diffraction:
        raise ValueError(
            "settings.diffraction is false beside a lens with several foci: its rings "
            "need diffraction; allowed: true"
        )


def _with_axis(ranges_deg: FieldRange) -> FieldRange:
    """Return field ranges extended to contain the axis, where eyes focus."""
    (left, right), (down, up) = ranges_deg
    return (min(left, 0.0), max(right, 0.0)), (min(down, 0.0), max(up, 0.0))
