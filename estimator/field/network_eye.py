"""Eye of the published pipeline: neural networks compute parameters and wavefronts.

The PSF cache uses this eye if the setting ``pipeline`` is "published".  The three
networks of Csoba & Kunkli (2023), section 5, estimate the parameters of the eye, focus
it and predict its wavefronts.  They were trained on the eye model, with its spherical
retina and its own periphery, and without a correction.  The residual between the
measurement and the estimated eye is not added.

The aberration network does not model vignetting.  To report its error in this eye, the
axis and the corners of the field are ray-traced, too.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.eye.accommodation import FocusedEye
from estimator.eye.assembly import accommodated_vectors
from estimator.eye.tracing import OPEN_RATIO
from estimator.field.interpolation import (
    FIELD_AZIMUTHS,
    FIELD_RINGS,
    AberrationGrid,
    FieldInterpolation,
    accommodation_nodes_dpt,
    field_nodes_deg,
)
from estimator.field.traced_eye import TracedEye
from estimator.field.traced_fields import FieldRange, check_field_range
from estimator.networks.inference import (
    INPUTS,
    NetworkUnfit,
    load_network,
    network_aberrations,
    network_focus,
)
from estimator.note import Note
from estimator.profiles.parse import EyeProfile
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.field_wavefronts import (
    circumscribed_radius_mm,
    ellipse_from_rim,
    polynomial_in_mm,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial, moved_rim

PUPIL_STEP_MM = 1.0
"""Step of the pupils at which the network is evaluated, as in the published grid."""

CORNEA_RADIUS_MM = 7.8
"""Radius of the sphere that approximates the cornea.  The distance from the cornea to
the entrance pupil has an error of 0.05 mm at 45 deg."""

ESTIMATED_SHARE, FOCUSED_SHARE = 0.3, 0.5
"""Progress after estimating the eye, and after focusing it."""


class NetworkEye(TracedEye):
    """A `TracedEye` with wavefronts from the aberration network.

    Directions outside the network's training range get the wavefront at the edge of
    that range.  Pupils are limited to the range, too.
    """

    pupil_limit = "network's"

    def usable_pupil_mm(self, pupil_diameter_mm: float) -> float:
        """Return the pupil, limited to the training range of the network."""
        smallest_mm = float(self.grid.pupil_diameters_mm[0])
        return max(super().usable_pupil_mm(pupil_diameter_mm), smallest_mm)

    def notes(self, *, pupil_diameter_mm: float, focus_dpt: float) -> tuple[str, ...]:
        """Return notes on parts of a request that this eye cannot meet."""
        notes = super().notes(pupil_diameter_mm=pupil_diameter_mm, focus_dpt=focus_dpt)
        smallest_mm = float(self.grid.pupil_diameters_mm[0])
        if pupil_diameter_mm >= smallest_mm - 1e-9:
            return notes
        raised = Note(
            "pupil_raised",
            f"pupil {pupil_diameter_mm:g} mm raised to the {self.pupil_limit} "
            f"{smallest_mm:g} mm",
            pupil_diameter_mm=pupil_diameter_mm,
            used_mm=smallest_mm,
        )
        return (raised, *notes)


def network_eye(
    profile: EyeProfile,
    *,
    pupil_range_mm: tuple[float, float],
    focus_range_dpt: tuple[float, float],
    wavelengths_nm: ArrayLike,
    field_range_deg: FieldRange,
    progress: Callable[[float, str], None] | None = None,
) -> tuple[NetworkEye, tuple[str, ...]]:
    """Estimate the eye of a profile by network; return it with notes.

    Parameters
    ----------
    profile : EyeProfile
        Measured wavefront, or an eye given by its parameters.
    pupil_range_mm, focus_range_dpt : (low, high)
        Pupils and focus distances that will be requested.
    wavelengths_nm : (n,)
    field_range_deg : ((h_low, h_high), (v_low, v_high))
    progress : callable, optional
        Callback with the completed fraction and a stage; may raise to cancel.

    Raises
    ------
    NetworkUnavailable
        The weights are missing, or the networks were not trained for this eye: its
        kind, its correction, its retina, or a value outside a training range.
    """
    check_field_range(field_range_deg)
    _check_profile(profile)

    report = progress or (lambda fraction, stage: None)
    report(0.0, "eye")
    found = estimate_eye(profile, method="network")
    if found.network_reason:
        raise NetworkUnfit(f"the eye network cannot be used: {found.network_reason}")
    report(ESTIMATED_SHARE, "aberrations")
    eye = _bare(found)
    range_mm = trained_range("aberration", "pupil_diameter_mm")
    low_mm, high_mm = np.clip(pupil_range_mm, *range_mm).tolist()
    low_dpt, high_dpt = eye.accommodating.accommodation_range_dpt(
        focus_range_dpt, pupil_range_mm=(low_mm, high_mm)
    )
    nodes_dpt = accommodation_nodes_dpt(low_dpt, high_dpt)
    states = network_focused(eye, nodes_dpt)
    report(FOCUSED_SHARE, "aberrations")
    (h_low, h_high), (v_low, v_high) = trained = tuple(
        tuple(np.clip(range_deg, *trained_range("aberration", name)).tolist())
        for range_deg, name in zip(field_range_deg, ("h_deg", "v_deg"), strict=True)
    )
    grid = network_grid(
        eye,
        states,
        h_deg=field_nodes_deg(h_low, h_high),
        v_deg=field_nodes_deg(v_low, v_high),
        pupil_diameters_mm=_pupils_mm(low_mm, high_mm),
        accommodations_dpt=nodes_dpt,
        wavelengths_nm=np.unique(wavelengths_nm),
    )
    seen = NetworkEye(
        eye,
        FieldInterpolation(grid),
        field_range_deg=field_range_deg,
        traced_range_deg=cast(FieldRange, trained),
    )
    return seen, (*_notes(found, grid, states), *found.notes, *profile.notes)


def _check_profile(profile: EyeProfile) -> None:
    """Raise if the networks were not trained for this kind of profile.

    Raises
    ------
    NetworkUnfit
    """
    if profile.surfaces is not None:
        problem = f"kind '{profile.kind}' defines the eye by its surfaces"
    elif profile.surgery is not None:
        problem = "surgery"
    elif profile.correction is not None:
        problem = "a correction, such as spectacles or an intraocular lens"
    elif profile.retina is not None:
        problem = "a retina other than the sphere of the eye model"
    else:
        return
    raise NetworkUnfit(f"the networks do not model this profile: {problem}")


def trained_range(network: str, column: str) -> tuple[float, float]:
    """Return the training range of an input column of a network, in its unit."""
    card = load_network(network).card
    index = INPUTS[network].index(column)
    return float(card.low[index]), float(card.high[index])


def _bare(found: EstimatedEye) -> EstimatedEye:
    """Return the eye as defined by its parameters alone, without a residual."""
    return replace(found, profile=replace(found.profile, eye=found.parameters))


def _pupils_mm(low_mm: float, high_mm: float) -> NDArray[np.float64]:
    """Return pupils (n,): both ends of a range and whole millimeters in between."""
    inner = np.arange(math.ceil(low_mm), math.floor(high_mm) + 1, PUPIL_STEP_MM)
    return np.unique([low_mm, *inner, high_mm])


def network_focused(
    eye: EstimatedEye, accommodations_dpt: ArrayLike
) -> list[FocusedEye]:
    """Return the eye in accommodated states (n,) within its amplitude.

    The focus network predicts the accommodated states.  Only one of its two outputs is
    used, the lens diameter: the chamber depth follows from the diameter by the rule of
    `accommodated_eyes`.

    Raises
    ------
    NetworkUnavailable
    """
    used_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
    lens = eye.accommodating
    diameters_mm = np.full(used_dpt.shape, eye.parameters.lens_diameter_mm)
    needed = used_dpt > 0.0
    if needed.any():
        changes_mm, _ = network_focus(
            eye.parameters.to_vector(),
            pupil_diameter_mm=lens.pupil_diameter_mm,
            focus_dpt=-lens.at_cornea_dpt(used_dpt[needed]),
        )
        diameters_mm[needed] += np.minimum(changes_mm, 0.0)
    return lens.with_diameters(used_dpt, diameters_mm)


def network_grid(
    eye: EstimatedEye,
    states: Sequence[FocusedEye],
    *,
    h_deg: NDArray[np.float64],
    v_deg: NDArray[np.float64],
    pupil_diameters_mm: NDArray[np.float64],
    accommodations_dpt: NDArray[np.float64],
    wavelengths_nm: NDArray[np.float64],
) -> AberrationGrid:
    """Return the wavefronts of the aberration network at all nodes of a grid.

    The network predicts them at the cornea; they are propagated to the entrance pupil.
    ``open_ratio`` is 1, ``rms_residual_um`` NaN, and there is no lateral color: the
    network predicts none of the three.

    Parameters
    ----------
    states : (n_accommodations,)
        The eye at each accommodation.
    h_deg, v_deg, pupil_diameters_mm, accommodations_dpt, wavelengths_nm : (n,)
        Nodes of the axes.

    Raises
    ------
    NetworkUnavailable
    """
    vectors = accommodated_vectors(
        eye.parameters.to_vector(),
        lens_diameter_mm=[state.parameters.lens_diameter_mm for state in states],
    )
    found = network_aberrations(
        vectors[:, None],
        pupil_diameter_mm=pupil_diameters_mm[:, None, None],
        wavelength_nm=wavelengths_nm,
        h_deg=h_deg[:, None, None, None, None],
        v_deg=v_deg[:, None, None, None],
    )
    shape = found.zernike_radius_mm.shape
    polynomial_um = polynomial_in_mm(found.zernike_um, found.zernike_radius_mm)
    depth_mm = _depths_mm(eye, h_deg, v_deg)[..., None, None, None]
    rim_mm = moved_rim(found.rim_mm, polynomial_um, depth_mm=depth_mm)
    radius_mm = circumscribed_radius_mm(rim_mm)
    moved_um = moved_polynomial(
        polynomial_um, depth_mm=depth_mm, radius_mm=found.zernike_radius_mm
    )
    n_h, n_v, _, *n_others = shape
    return AberrationGrid(
        h_deg=h_deg,
        v_deg=v_deg,
        pupil_diameters_mm=pupil_diameters_mm,
        accommodations_dpt=accommodations_dpt,
        wavelengths_nm=wavelengths_nm,
        zernike_um=zernike_from_polynomial(moved_um, radius_mm),
        zernike_radius_mm=radius_mm,
        rms_residual_um=np.full(shape, np.nan),
        open_ratio=np.ones(shape),
        ellipse_mm=ellipse_from_rim(rim_mm),
        chief_shift_mrad=np.zeros((n_h, n_v, *n_others, 2)),
    )


def _depths_mm(
    eye: EstimatedEye, h_deg: NDArray[np.float64], v_deg: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return distances (n_h, n_v) from cornea to entrance pupil along chief rays."""
    cosine = np.cos(np.radians(h_deg))[:, None] * np.cos(np.radians(v_deg))
    behind_mm = CORNEA_RADIUS_MM - eye.accommodating.entrance_pupil_mm
    depth_mm: NDArray[np.float64] = np.sqrt(
        CORNEA_RADIUS_MM**2 - behind_mm**2 * (1.0 - cosine**2)
    )
    return depth_mm - behind_mm * cosine


def traced_errors_um(
    grid: AberrationGrid, states: Sequence[FocusedEye], fields: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the mean error (n,) of 27 terms of a grid at some of its fields.

    The reference is ray tracing with the largest pupil and the shortest wavelength, at
    the least and the greatest accommodation.  Nodes where light does not fill the pupil
    are omitted.

    Parameters
    ----------
    fields : (n_fields, 2)
        Indices of azimuth and elevation.
    """
    h, v = fields.T
    errors_um = []
    for k in sorted({0, len(states) - 1}):
        traced = wavefront_grid(
            states[k].surfaces,
            fields_deg=np.column_stack([grid.h_deg[h], grid.v_deg[v]]),
            wavelengths_nm=grid.wavelengths_nm[:1],
            pupil_diameters_mm=grid.pupil_diameters_mm[-1:],
            plane="pupil",
            n_rings=FIELD_RINGS,
            n_azimuths=FIELD_AZIMUTHS,
        )
        difference_um = grid.zernike_um[h, v, -1, k, 0] - traced.zernike_um[:, 0, 0]
        passes = traced.open_ratio[:, 0, 0] > OPEN_RATIO
        errors_um.append(np.abs(difference_um[passes, 1:]).mean(axis=-1))
    return np.concatenate(errors_um)


def _error_note(grid: AberrationGrid, states: Sequence[FocusedEye]) -> Note:
    """Return a note on the error of the aberration network in this eye."""
    expected = load_network("aberration").card.error
    pupil_mm = float(grid.pupil_diameters_mm[-1])
    axes = grid.h_deg, grid.v_deg
    places = {"on_axis": [tuple(int(np.abs(axis).argmin()) for axis in axes)]}
    if axes[0].size * axes[1].size > 1:
        ends = (sorted({0, axis.size - 1}) for axis in axes)
        places["corner"] = list(product(*ends))
    values = {
        f"{name}_error_um": traced_errors_um(grid, states, np.array(fields)).mean()
        for name, fields in places.items()
    }
    known = {name: um for name, um in values.items() if np.isfinite(um)}
    words = {"on_axis_error_um": "near the axis", "corner_error_um": "at the corners"}
    found = " and ".join(f"{um:.2g} um {words[name]}" for name, um in known.items())
    return Note(
        "aberrations_by_network",
        f"aberrations by network, expected error {expected}; with a {pupil_mm:g} mm "
        f"pupil {found or 'light passes only a part of it'}",
        expected_error_um=expected.mean_abs,
        pupil_diameter_mm=pupil_mm,
        **known,
    )


def _notes(
    found: EstimatedEye, grid: AberrationGrid, states: Sequence[FocusedEye]
) -> tuple[str, ...]:
    """Return notes on the networks' errors, and on what they do not model."""
    profile = found.profile
    eye = Note("eye_given_by_parameters", "eye as given by its parameters")
    if found.method == "network":
        expected = load_network("eye").card.error
        eye = Note(
            "eye_by_network",
            f"eye estimated by the network in {found.time_ms:.0f} ms, mean error "
            f"{found.mean_abs_error_um:.1e} um over 25 terms; expected {expected}",
            time_ms=found.time_ms,
            mean_error_um=found.mean_abs_error_um,
            expected_error_um=expected.mean_abs,
        )
    aberrations = _error_note(grid, states)
    lacking = {
        "the residual of the measurement": found.method == "network",
        "measurements off the axis": len(profile.measurements) > 1,
        "the periphery of measured eyes": (
            grid.h_deg.size > 1 and profile.periphery == "people"
        ),
        "straylight": profile.straylight is not None,
        "yellowing": profile.yellowing is not None,
    }
    missing = ", ".join(name for name, lacks in lacking.items() if lacks)
    if not missing:
        return eye, aberrations
    text = f"not modeled by the published pipeline: {missing}"
    return eye, aberrations, Note("published_not_modeled", text)
