"""Aberration grids by network: less exact than traced ones, and no longer faster.

A network takes a sixth of the time of the wavefronts that it replaces, 29 ms less.  The
checks below cost more than that: a new eye takes 1.2 to 1.3 times as long as with
everything traced (`ocufilter bench networks`).

The network models neither vignetting nor any retina but the sphere.  So a grid requires
that light passes the largest pupil at the corners of the field, which are traced.
Those nodes also show the network's error in this eye; if it is far above the stated
one, the grid is rejected.  Lateral color is traced: chief rays cost a fortieth of whole
bundles.  The network was trained on wavefronts at the cornea; they are propagated to
the entrance pupil.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.estimation import EstimatedEye
from estimator.eye.accommodation import FocusedEye
from estimator.eye.lens_change import accommodated_vectors
from estimator.eye.tracing import OPEN_RATIO
from estimator.field.aberration_grid import AberrationGrid
from estimator.networks.card import NetworkUnfit
from estimator.networks.inference import (
    load_network,
    network_aberrations,
    network_focus,
)
from estimator.wavefront.aberrations import wavefront_grid
from estimator.wavefront.chief_rays import chief_shift_mrad
from estimator.wavefront.field_wavefronts import (
    circumscribed_radius_mm,
    ellipse_from_rim,
    polynomial_in_mm,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial, moved_rim

CHECK_RINGS, CHECK_AZIMUTHS = 5, 14
"""Rays of a check, as for a traced field grid: far more exact than a network."""

CORNEA_RADIUS_MM = 7.8
"""Radius of the sphere that represents the cornea in the distance to the entrance
pupil, with an error of 0.05 mm at 45 deg."""


@dataclass(frozen=True)
class NetworkGrid:
    """Grid by network, and its mean error (27 terms) at the corners of its field."""

    grid: AberrationGrid
    checked_error_um: float
    n_checked: int


def network_focused(eye: EstimatedEye, accommodations_dpt: ArrayLike):
    """Return the eye at accommodations (n,) within its amplitude, by focus network.

    The relaxed eye is known.  Of the network's two outputs only the lens diameter is
    used; the chamber depth follows from it exactly by the rule of `accommodation`.

    Returns
    -------
    states : list of FocusedEye
        Focused eyes; ``focus_dpt`` is the requested focus.

    Raises
    ------
    NetworkUnavailable
    """
    used_dpt = np.atleast_1d(np.asarray(accommodations_dpt, dtype=np.float64))
    lens = eye.accommodating
    diameters_mm = np.full(used_dpt.shape, eye.parameters.lens_diameter_mm)
    needed = used_dpt > 0.0
    if needed.any():
        _check_retina(eye)
        changes_mm, _ = network_focus(
            eye.parameters.to_vector(),
            pupil_diameter_mm=lens.pupil_diameter_mm,
            focus_dpt=-lens.at_cornea_dpt(used_dpt[needed]),
        )
        diameters_mm[needed] += np.minimum(changes_mm, 0.0)
    return lens.with_diameters(used_dpt, diameters_mm)


def network_grid(
    eye: EstimatedEye,
    states: list[FocusedEye],
    *,
    pupil_diameters_mm: ArrayLike,
    accommodations_dpt: ArrayLike,
    wavelengths_nm: ArrayLike,
    h_deg: ArrayLike = (0.0,),
    v_deg: ArrayLike = (0.0,),
) -> NetworkGrid:
    """Compute a grid with the aberration network, and check it at its corners.

    ``open_ratio`` is 1, as found at the corners.  ``rms_residual_um`` is NaN: a network
    does not predict the residual of a fit.

    Parameters
    ----------
    states : (n_accommodations,)
        Eye at each accommodation.

    Raises
    ------
    NetworkUnavailable
        No weights, an input outside the training ranges, light that passes only part
        of the pupil, or an error far above the stated one.
    """
    _check_retina(eye)
    h_deg, v_deg, pupils_mm, used_dpt, wavelengths_nm = (
        np.atleast_1d(np.asarray(axis, dtype=np.float64))
        for axis in (
            h_deg,
            v_deg,
            pupil_diameters_mm,
            accommodations_dpt,
            wavelengths_nm,
        )
    )
    found = network_aberrations(
        _vectors(eye, states)[:, None],
        pupil_diameter_mm=pupils_mm[:, None, None],
        wavelength_nm=wavelengths_nm,
        h_deg=h_deg[:, None, None, None, None],
        v_deg=v_deg[:, None, None, None],
    )
    shape = found.zernike_radius_mm.shape
    polynomial_um = polynomial_in_mm(found.zernike_um, found.zernike_radius_mm)
    depth_mm = _depths_mm(eye, h_deg, v_deg)[..., None, None, None]
    rim_mm = moved_rim(found.rim_mm, polynomial_um, depth_mm=depth_mm)
    radius_mm = circumscribed_radius_mm(rim_mm)
    grid = AberrationGrid(
        h_deg=h_deg,
        v_deg=v_deg,
        pupil_diameters_mm=pupils_mm,
        accommodations_dpt=used_dpt,
        wavelengths_nm=wavelengths_nm,
        zernike_um=zernike_from_polynomial(
            moved_polynomial(polynomial_um, depth_mm=depth_mm), radius_mm
        ),
        zernike_radius_mm=radius_mm,
        rms_residual_um=np.full(shape, np.nan),
        open_ratio=np.ones(shape),
        ellipse_mm=ellipse_from_rim(rim_mm),
        chief_shift_mrad=_chief_shifts_mrad(states, h_deg, v_deg, wavelengths_nm),
    )
    errors_um = _corner_errors_um(grid, states)
    error_um = float(errors_um.mean())
    load_network("aberration").card.check_error(error_um, "at the corners of the field")
    return NetworkGrid(grid, error_um, errors_um.size)


def _vectors(eye: EstimatedEye, states: list[FocusedEye]) -> NDArray[np.float64]:
    """Return the parameters (n, 45) of the focused eyes."""
    diameters_mm = [state.parameters.lens_diameter_mm for state in states]
    return accommodated_vectors(
        eye.parameters.to_vector(), lens_diameter_mm=diameters_mm
    )


def _depths_mm(
    eye: EstimatedEye, h_deg: NDArray, v_deg: NDArray
) -> NDArray[np.float64]:
    """Return distances (n_h, n_v) from cornea to entrance pupil along chief rays."""
    cosine = np.cos(np.radians(h_deg))[:, None] * np.cos(np.radians(v_deg))
    behind_mm = CORNEA_RADIUS_MM - eye.accommodating.entrance_pupil_mm
    sine_squared = 1.0 - cosine**2
    return np.sqrt(CORNEA_RADIUS_MM**2 - behind_mm**2 * sine_squared) - (
        behind_mm * cosine
    )


def _check_retina(eye: EstimatedEye) -> None:
    if eye.retina is not None:
        raise NetworkUnfit("the networks know no other retina than the sphere")


def _chief_shifts_mrad(
    states: list[FocusedEye], h_deg: NDArray, v_deg: NDArray, wavelengths_nm: NDArray
) -> NDArray[np.float64]:
    """Trace the lateral color (n_h, n_v, n_states, n_wavelengths, 2)."""
    fields_deg = np.stack(np.meshgrid(h_deg, v_deg, indexing="ij"), axis=-1)
    shifts = [
        chief_shift_mrad(
            state.surfaces,
            fields_deg=fields_deg.reshape(-1, 2),
            wavelengths_nm=wavelengths_nm,
        )
        for state in states
    ]
    shift_mrad = np.stack(shifts, axis=1)
    return shift_mrad.reshape(len(h_deg), len(v_deg), *shift_mrad.shape[1:])


def _corner_errors_um(
    grid: AberrationGrid, states: list[FocusedEye]
) -> NDArray[np.float64]:
    """Return mean errors (n,) at the field's corners, traced at the largest pupil.

    Both ends of the accommodations and the shortest wavelength are checked.
    """
    ends = [sorted({0, len(axis) - 1}) for axis in (grid.h_deg, grid.v_deg)]
    corners = np.array(list(product(*ends)))
    fields_deg = np.column_stack([grid.h_deg[corners[:, 0]], grid.v_deg[corners[:, 1]]])
    errors_um = []
    for k in sorted({0, len(states) - 1}):
        traced = wavefront_grid(
            states[k].surfaces,
            fields_deg=fields_deg,
            wavelengths_nm=grid.wavelengths_nm[:1],
            pupil_diameters_mm=grid.pupil_diameters_mm[-1:],
            plane="pupil",
            n_rings=CHECK_RINGS,
            n_azimuths=CHECK_AZIMUTHS,
        )
        if not np.all(traced.open_ratio > OPEN_RATIO):
            raise NetworkUnfit(
                f"light passes only a part of the {grid.pupil_diameters_mm[-1]:.2g} mm "
                "pupil at the edge of the field"
            )
        ours_um = grid.zernike_um[corners[:, 0], corners[:, 1], -1, k, 0]
        difference_um = ours_um[:, 1:] - traced.zernike_um[:, 0, 0, 1:]
        errors_um.append(np.abs(difference_um).mean(axis=-1))
    return np.concatenate(errors_um)
