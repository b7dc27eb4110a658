"""Preparation of the eye of a profile for PSFs: measured wavefront or traced model."""

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from estimator.estimate.given_surfaces import eye_model as model_of
from estimator.field.eye_optics import EyeOptics
from estimator.field.few_colors import few_colors_grid
from estimator.field.interpolation import FieldNodes
from estimator.field.notes import eye_notes, periphery_note
from estimator.field.trace_range import ON_AXIS_DEG, FieldRange
from estimator.field.traced_eye import TracedEye
from estimator.optics.units import RGB_WAVELENGTHS_NM
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import EyeProfile

EYE_MODELS = ("traced", "wavefront")

ESTIMATION_SHARE = 0.5
"""Progress at the end of the estimation."""

ACCURACIES = ("fast", "balanced", "exact")


def prepare_eye(
    profile: EyeProfile,
    *,
    pupil_diameters_mm: ArrayLike = (3.0, 4.0, 5.0, 6.0),
    focus_range_dpt: tuple[float, float] = (0.0, 0.0),
    wavelengths_nm: ArrayLike = RGB_WAVELENGTHS_NM,
    field_range_deg: FieldRange = ON_AXIS_DEG,
    nodes_deg: FieldNodes | None = None,
    eye_model: str = "traced",
    accuracy: str = "exact",
    progress: Callable[[float, str], None] | None = None,
) -> tuple[EyeOptics, tuple[str, ...]]:
    """Return the eye of a profile over its visual field, and notes on it.

    Parameters
    ----------
    profile : EyeProfile
    pupil_diameters_mm : (n,)
        Entrance pupils to trace on axis; others are interpolated.  Off axis, fewer are
        traced.
    focus_range_dpt : (low, high)
        Range of focus distances that will be requested.
    wavelengths_nm : (n,)
    field_range_deg : ((h_low, h_high), (v_low, v_high))
        Azimuths and elevations.
    nodes_deg : (n_h,), (n_v,), optional
        Azimuths and elevations of the range, ends included, whose wavefronts are exact;
        others are not interpolated well.  By default, all are interpolated between
        nodes of its own.
    eye_model : {"traced", "wavefront"}
        "traced" estimates a 45-parameter eye and traces its wavefronts.  "wavefront"
        uses the measurement in closed form, at no cost, but does not model pupils
        larger than the measured one or the effect of accommodation on other
        aberrations.
    accuracy : {"exact", "fast", "balanced"}
        Deprecated and without effect; it will be removed in version 0.3.
    progress : callable, optional
        Callback with the completed fraction and a stage; may raise to cancel.

    Returns
    -------
    eye : EyeOptics
    notes : tuple of str

    Raises
    ------
    ValueError
        The model or accuracy is unknown, or the eye cannot be traced.
    """
    if eye_model not in EYE_MODELS:
        raise ValueError(
            f"eye_model '{eye_model}': allowed are {', '.join(EYE_MODELS)}"
        )
    if accuracy not in ACCURACIES:
        raise ValueError(f"accuracy '{accuracy}': allowed are {', '.join(ACCURACIES)}")
    if accuracy != "exact":
        warnings.warn(
            "the argument accuracy has no effect; it will be removed in version 0.3",
            DeprecationWarning,
            stacklevel=2,
        )
    if eye_model == "wavefront" and not profile.is_given:
        return MeasuredWavefront.from_profile(profile), profile.notes

    def report(fraction: float, stage: str) -> None:
        if progress is not None:
            progress(fraction, stage)

    report(0.0, "eye")
    estimated = model_of(profile)
    report(ESTIMATION_SHARE, "aberrations")
    eye = TracedEye.trace(
        estimated,
        pupil_diameters_mm=pupil_diameters_mm,
        focus_range_dpt=focus_range_dpt,
        wavelengths_nm=wavelengths_nm,
        field_range_deg=field_range_deg,
        nodes_deg=nodes_deg,
        field_grid=few_colors_grid,
        progress=lambda done: report(
            ESTIMATION_SHARE + (1.0 - ESTIMATION_SHARE) * done, "aberrations"
        ),
    )
    notes = eye_notes(estimated)
    if np.any(field_range_deg):
        notes = (*notes, periphery_note(eye))
    return eye, (*notes, *profile.notes)
