"""Prepare the eye of a profile for PSFs, as a measured wavefront or a traced model.

One wavelength is traced at every node of the field.  The differences between it and the
other wavelengths are smaller and smoother than the change over the field, so they are
traced at fewer fields and accommodations and interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.estimation import POOR_FIT_UM
from estimator.estimate.given_surfaces import GivenSurfaces
from estimator.estimate.model import EyeModel
from estimator.estimate.model import eye_model as model_of
from estimator.estimate.surgery import natural_eye
from estimator.eye.accommodation import REFRACTION_TOLERANCE_DPT
from estimator.eye.focusing import FocusedSurfaces
from estimator.field.eye_optics import EyeOptics
from estimator.field.interpolation import (
    AberrationGrid,
    FieldInterpolation,
    FieldNodes,
    aberration_grid,
    fewer_field_nodes_deg,
    lagrange_weights,
    stretched,
)
from estimator.field.traced_eye import TRACED_ERROR_UM, TracedEye
from estimator.field.traced_fields import ON_AXIS_DEG, FieldRange, scaled_progress
from estimator.note import Note
from estimator.optics.units import RGB_WAVELENGTHS_NM
from estimator.periphery.change import MAX_MISFIT_UM
from estimator.periphery.population import KNOTS_DEG
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import EyeProfile
from estimator.wavefront.field_wavefronts import ellipse_from_rim, rim_from_ellipse

FIELD_RATIO = 0.7
"""Number of field nodes of the other wavelengths per node of the first one, along each
axis: 7 x 6 for 10 x 8.  The RMS error at random fields (emmetropia, 5 mm) is then
0.98e-3 um instead of 0.95e-3; with 6 x 5, it is 1.2e-3."""

FEW_ACCOMMODATIONS = 3
"""Largest number of accommodations of other wavelengths; with two, the RMS error is
2.1e-3 um."""

FIRST_SHARE = 0.6
"""Fraction of the time that the first wavelength takes."""

COLOR_AXIS = {"chief_shift_mrad": 3}
"""Wavelength axis of an array of a grid, if it is not 4."""


def few_colors_grid(
    eye: EyeModel,
    *,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    accommodations_dpt: ArrayLike,
    wavelengths_nm: ArrayLike,
    states: Sequence[FocusedSurfaces] | None = None,
    progress: Callable[[float], None] | None = None,
    **sampling: Any,
) -> AberrationGrid:
    """Return a grid like `aberration_grid`, in about half the time.

    If a node is vignetted, all wavelengths are traced at all nodes.

    Parameters
    ----------
    h_deg, v_deg : (n_h,), (n_v,)
        Field nodes from `field_nodes_deg`.
    accommodations_dpt : (n_accommodations,)
    wavelengths_nm : (n_wavelengths,)
        Ascending; the middle one is traced at all nodes.
    states : (n_accommodations,), optional
        Eye at each accommodation, if already computed.
    progress : callable, optional
        Callback with the completed fraction; may raise to cancel.
    **sampling
        Pupils and rays, see `aberration_grid`.

    Raises
    ------
    ValueError
        A value is out of range, or the eye cannot be traced.
    """
    nm, nodes_dpt = np.atleast_1d(wavelengths_nm), np.atleast_1d(accommodations_dpt)
    place = {"h_deg": np.atleast_1d(h_deg), "v_deg": np.atleast_1d(v_deg)}
    middle = nm.size // 2
    known = eye.accommodating.states_at(nodes_dpt) if states is None else states

    def traced(
        of_nm: NDArray[Any],
        at: dict[str, Any],
        some: NDArray[Any],
        *shares: float,
    ) -> AberrationGrid:
        return aberration_grid(
            eye,
            **at,
            accommodations_dpt=nodes_dpt[some],
            wavelengths_nm=of_nm,
            states=[known[k] for k in some.tolist()],
            progress=scaled_progress(progress, *shares),
            **sampling,
        )

    every = np.arange(nodes_dpt.size)
    first = traced(nm[middle : middle + 1], place, every, 0.0, FIRST_SHARE)
    if nm.size == 1:
        return first
    other_nm, others, progress_range = np.delete(nm, middle), None, (FIRST_SHARE, 1.0)
    if _is_open(first):
        few = {
            name: fewer_field_nodes_deg(at, FIELD_RATIO) for name, at in place.items()
        }
        ends = np.linspace(0, nodes_dpt.size - 1, FEW_ACCOMMODATIONS)
        some = np.unique(ends.round().astype(int))
        coarse = traced(other_nm, few, some, *progress_range)
        if _is_open(coarse):
            others = _interpolated_to(first, coarse)
    if others is None:
        others = traced(other_nm, place, every, *progress_range)
    return _merged(first, others, middle)


def _is_open(grid: AberrationGrid) -> bool:
    return bool(
        FieldInterpolation.is_open(grid).all()
        and np.isfinite(grid.chief_shift_mrad).all()
    )


def _interpolated_to(first: AberrationGrid, coarse: AberrationGrid) -> AberrationGrid:
    """Interpolate the other wavelengths from ``coarse`` to the nodes of ``first``."""
    to_coarse, to_all = (
        [
            lagrange_weights(transformed(nodes), transformed(at))
            for nodes, at, transformed in (
                (from_.h_deg, to.h_deg, stretched),
                (from_.v_deg, to.v_deg, stretched),
                (from_.accommodations_dpt, to.accommodations_dpt, np.asarray),
            )
        ]
        for from_, to in ((first, coarse), (coarse, first))
    )

    def of(name: str) -> NDArray[np.float64]:
        known, few = getattr(first, name), getattr(coarse, name)
        if name == "ellipse_mm":
            known, few = rim_from_ellipse(known), rim_from_ellipse(few)
        axis = COLOR_AXIS.get(name, 4) - 1  # of the accommodations
        difference = few - _resampled(known, to_coarse, axis)
        found = known + _resampled(difference, to_all, axis)
        return ellipse_from_rim(found) if name == "ellipse_mm" else found

    names = [f.name for f in fields(first) if getattr(first, f.name).ndim > 1]
    return replace(
        first,
        wavelengths_nm=coarse.wavelengths_nm,
        **{name: of(name) for name in names},
    )


def _resampled(
    values: NDArray[np.float64], weights: list[NDArray[np.float64]], axis: int
) -> NDArray[np.float64]:
    """Interpolate values [h, v, ...] to other nodes of field and accommodation."""
    for along, own in zip((0, 1, axis), weights, strict=True):
        values = np.moveaxis(np.tensordot(own, values, (1, along)), 0, along)
    return values


def _merged(
    first: AberrationGrid, others: AberrationGrid, middle: int
) -> AberrationGrid:
    """Insert the first wavelength at index ``middle`` of the others."""

    def of(name: str) -> NDArray[np.float64]:
        own: NDArray[np.float64]
        own, other = getattr(first, name), getattr(others, name)
        if own.ndim == 1:
            return own
        axis = COLOR_AXIS.get(name, 4)
        before, after = np.split(other, [middle], axis=axis)
        return np.concatenate([before, own, after], axis=axis)

    nm = np.insert(others.wavelengths_nm, middle, first.wavelengths_nm)
    names = (f.name for f in fields(first) if f.name != "wavelengths_nm")
    return AberrationGrid(wavelengths_nm=nm, **{name: of(name) for name in names})


def eye_notes(estimated: EyeModel) -> tuple[str, ...]:
    """Return notes on the computation of the eye, its focus and its aberrations."""
    return (
        _of_eye(natural_eye(estimated)),
        Note(
            "focus_accuracy",
            f"focus traced to {REFRACTION_TOLERANCE_DPT:.0e} dpt",
            error_dpt=REFRACTION_TOLERANCE_DPT,
        ),
        Note(
            "aberration_accuracy",
            f"aberrations traced to about {TRACED_ERROR_UM:.0e} um",
            error_um=TRACED_ERROR_UM,
        ),
        *estimated.notes,
    )


def periphery_note(eye: TracedEye) -> str:
    """Return a note on the source and the accuracy of the periphery of an eye."""
    if eye.periphery is None:
        text = "periphery: from the eye model, not from measured eyes"
        return Note("periphery_of_model", text)
    change = eye.periphery.change
    at_deg = (10.0, 20.0, 30.0)
    known_dpt = dict(zip(KNOTS_DEG, change.sphere_deviation_dpt, strict=True))
    deviations_dpt = [max(known_dpt[a], known_dpt[-a]) for a in at_deg]
    known = ", ".join(f"{deviation_dpt:.1f}" for deviation_dpt in deviations_dpt)
    source = "mean of measured eyes with similar on-axis wavefronts"
    if change.measured_count:
        source = f"measured in {change.measured_count} directions off the axis"
    if change.sample is not None:
        source = f"drawn from measured eyes with sample {change.sample}"
    note = f"periphery: {source}; M at 10, 20, 30 deg known to +-{known} dpt"
    if change.misfit_um > MAX_MISFIT_UM:
        note += f"; RMS misfit of the measurements {change.misfit_um:.2f} um"
    values = {
        f"deviation_at_{angle_deg:.0f}_deg_dpt": deviation_dpt
        for angle_deg, deviation_dpt in zip(at_deg, deviations_dpt, strict=True)
    }
    return Note("periphery_of_people", note, **values, misfit_um=change.misfit_um)


def _of_eye(estimated: EyeModel) -> str:
    if isinstance(estimated, GivenSurfaces):
        return Note("eye_given_by_surfaces", "eye as given by its surfaces")
    if estimated.method == "given":
        return Note("eye_given_by_parameters", "eye as given by its parameters")
    poor = "poorly " if estimated.mean_abs_error_um > POOR_FIT_UM else ""
    found = (
        f"in {estimated.time_ms:.0f} ms, mean error "
        f"{estimated.mean_abs_error_um:.1e} um over 25 terms"
    )
    start = ", refined from an eye in a table" if estimated.start == "table" else ""
    return Note(
        "eye_estimated",
        f"eye estimated {poor}{found}{start}",
        time_ms=estimated.time_ms,
        mean_error_um=estimated.mean_abs_error_um,
    )


EYE_MODELS = ("traced", "wavefront")

ESTIMATION_SHARE = 0.5
"""Progress at the end of the estimation."""


def prepare_eye(
    profile: EyeProfile,
    *,
    pupil_diameters_mm: ArrayLike = (3.0, 4.0, 5.0, 6.0),
    focus_range_dpt: tuple[float, float] = (0.0, 0.0),
    wavelengths_nm: ArrayLike = RGB_WAVELENGTHS_NM,
    field_range_deg: FieldRange = ON_AXIS_DEG,
    nodes_deg: FieldNodes | None = None,
    eye_model: str = "traced",
    model: EyeModel | None = None,
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
        Wavelengths that will be requested; red, green and blue by default.
    field_range_deg : ((h_low, h_high), (v_low, v_high))
        Azimuths and elevations.
    nodes_deg : (n_h,), (n_v,), optional
        Azimuths and elevations of the range, ends included, at which wavefronts are
        exact; between them, interpolation is poor.  By default, the function chooses
        nodes between which all directions are interpolated well.
    eye_model : {"traced", "wavefront"}
        "traced" estimates a 45-parameter eye and traces its wavefronts.  "wavefront"
        uses the measurement in closed form, at no cost, but does not model pupils
        larger than the measured one or the effect of accommodation on other
        aberrations.
    model : EyeModel, optional
        Result of `eye_model` for the profile, if it is already known.
    progress : callable, optional
        Callback with the completed fraction and a stage; may raise to cancel.

    Returns
    -------
    eye : EyeOptics
    notes : tuple of str

    Raises
    ------
    ValueError
        The model is unknown, or the eye cannot be traced.
    """
    if eye_model not in EYE_MODELS:
        raise ValueError(
            f"eye_model '{eye_model}': allowed are {', '.join(EYE_MODELS)}"
        )
    is_traced = profile.is_given or profile.surgery is not None
    if eye_model == "wavefront" and not is_traced:
        return MeasuredWavefront.from_profile(profile), profile.notes

    report = progress or (lambda fraction, stage: None)
    report(0.0, "eye")
    estimated = model_of(profile) if model is None else model
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
