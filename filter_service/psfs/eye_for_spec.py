"""The eye of a profile, over the pupils, foci and directions of a cache."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.worn_lens import WornLens, depends_on_gaze
from estimator.field.eye_optics import EyeOptics
from estimator.field.network_eye import network_eye
from estimator.field.prepare import prepare_eye
from estimator.field.traced_fields import FieldRange
from estimator.networks.inference import NetworkUnavailable
from estimator.note import Note
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import EyeProfile
from estimator.psf.compute import plan_psfs
from estimator.psf.enz import PAPER_DEGREE, captured_ratios
from filter_service.errors import BadMessage, BuildCancelled
from filter_service.planning.defocus_nodes import paper_ranges
from filter_service.planning.grid import (
    GREEN,
    GridSpec,
    field_range_deg,
    pupil_nodes_mm,
)

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
    if settings.pipeline == "published":
        return _published_eye(profile, spec, report)
    if isinstance(profile.correction, WornLens) and profile.correction.rings:
        _check_diffraction(settings.diffraction)
    if settings.age_years is not None:
        profile = replace(profile, age_years=settings.age_years)
    lens = profile.correction
    if isinstance(lens, ProgressiveLens | WornLens) and depends_on_gaze(lens):
        lens = lens.with_gaze_offset(settings.gaze_deg)
        profile = replace(profile, correction=lens)
    eye, notes = prepare_eye(
        profile,
        pupil_diameters_mm=pupil_nodes_mm(settings.pupil_range_mm),
        focus_range_dpt=settings.focus_range_dpt,
        wavelengths_nm=spec.traced_wavelengths_nm,
        field_range_deg=_with_axis(spec.field_range_deg),
        eye_model=settings.eye_model,
        progress=report,
    )
    if isinstance(eye, MeasuredWavefront) and settings.lateral_color:
        notes = (*notes, NO_LATERAL_COLOR)
    if depends_on_gaze(profile.correction) and any(settings.gaze_range_deg):
        notes = (*notes, ONE_GAZE)
    return eye, notes


def _published_eye(
    profile: EyeProfile, spec: GridSpec, report: Callable[[float, str], None]
) -> tuple[EyeOptics, tuple[str, ...]]:
    """Return the eye by network, with notes on the errors of the whole pipeline."""
    settings = spec.settings
    if settings.age_years is not None:
        profile = replace(profile, age_years=settings.age_years)
    pupil_range_mm, focus_range_dpt = paper_ranges(spec)
    try:
        eye, notes = network_eye(
            profile,
            pupil_range_mm=pupil_range_mm,
            focus_range_dpt=focus_range_dpt,
            wavelengths_nm=spec.traced_wavelengths_nm,
            field_range_deg=_with_axis(spec.field_range_deg),
            progress=report,
        )
    except NetworkUnavailable as error:
        raise BadMessage(
            f"'published' cannot be used: {error}",
            field="settings.pipeline",
            allowed="exact",
        ) from error
    return eye, (*notes, _series_note(eye, spec))


def _series_note(eye: EyeOptics, spec: GridSpec) -> Note:
    """Return a note on the light that the ENZ series represents."""
    (_, right_deg), (_, up_deg) = _with_axis(
        field_range_deg(spec.camera, gaze_deg=spec.settings.gaze_deg)
        if spec.follows_field
        else ((0.0, 0.0), (0.0, 0.0))
    )
    (_, pupil_mm), (focus_dpt, _) = paper_ranges(spec)
    pupil_mm = eye.usable_pupil_mm(pupil_mm)
    found = eye.wavefronts(
        h_deg=np.array([0.0, right_deg]),
        v_deg=np.array([0.0, up_deg]),
        pupil_diameter_mm=pupil_mm,
        accommodation_dpt=eye.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm),
        wavelength_nm=spec.channel_wavelengths_nm[GREEN],
        total_defocus_dpt=0.0,  # which the series includes exactly
    )
    plan = plan_psfs(
        found.zernike_um,
        pupil_diameter_mm=found.circle_diameter_mm,
        pupil_ellipse=found.pupil_ellipse,
        wavelength_nm=spec.channel_wavelengths_nm[GREEN],
        pixel_pitch_mrad=spec.pixel_pitch_mrad,
        method="enz_unchecked",
    )
    on_axis, at_corner = captured_ratios(plan.survey).tolist()
    text = (
        f"PSFs by the ENZ series to degree {PAPER_DEGREE}, which represents "
        f"{on_axis:.1%} of the light of a {pupil_mm:g} mm pupil on the axis"
    )
    values = {"pupil_diameter_mm": pupil_mm, "on_axis_ratio": on_axis}
    if spec.follows_field:
        text += f" and {at_corner:.1%} at the corner of the image"
        values["corner_ratio"] = at_corner
    return Note("enz_series", text, **values)


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
