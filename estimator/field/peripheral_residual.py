"""Phase that converts an estimated eye's peripheral wavefronts into the population's.

An estimated eye reproduces the person's on-axis wavefront but not the peripheral ones.
Its lens is homogeneous and its retina spherical, and the true lens gradient and retinal
shape cannot be inferred from the on-axis wavefront.  The phase is the wavefront of the
population for this on-axis wavefront (`periphery`) minus the eye model's wavefront.  It
is added to the traced wavefronts, and it is zero on the axis.

For an eye outside the population's range (for example keratoconus), the phase is
computed for an eye whose on-axis wavefront is clamped to that range.  How the actual
eye deviates from the clamped eye comes from ray tracing.

The population was measured through `CIRCLE_MM`.  Wider pupils have the same polynomial:
one that grows more slowly beyond 6 mm gives M a kink of 0.1 to 0.5 dpt/mm there, and
makes the far periphery of a myope up to 1 dpt more myopic at 7 mm than at 6 mm.

The periphery's wavefront relative to the axis is held at every accommodation, in all
terms of the population.  In people, refraction off the axis relative to that on the
axis hardly changes with accommodation: no significant change in Calver et al. 2007
(Vision Res 47:2341) and Davies & Mallen 2009 (Br J Ophthalmol 93:1225), 0.1 to 0.5 dpt
more myopic over several diopters in Whatham et al. 2009 (J Vis 9(3):14) and Lundstrom
et al. 2009 (J Vis 9(6):17).  Higher orders hardly change either, but for C(4,0), which
falls as much in all directions within 21 deg (Mathur et al. 2009, J Vis 9(12):20).  The
eye model, with its homogeneous lens and fixed retina, turns 0.28 dpt more hyperopic at
30 deg for each diopter, and at 20 deg C(4,0) falls a fifth as much as on the axis.  A
phase removes that: through `CIRCLE_MM`, at the cornea, the wavefront less that on the
axis is the relaxed eye's, but for tilt.
"""

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.estimate.model import EyeModel
from estimator.eye.tracing import on_axis_zernike_um
from estimator.field.interpolation import (
    FIELD_AZIMUTHS,
    FIELD_RINGS,
    AberrationGrid,
    FieldInterpolation,
    FieldNodes,
    aberration_grid,
)
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import (
    N_TERMS,
    flip_horizontal,
    remove_central_tilt,
    summed_terms,
)
from estimator.periphery.change import PeripheralChange
from estimator.periphery.population import CIRCLE_MM, TERMS
from estimator.profiles.parse import EyeProfile, Measurement
from estimator.wavefront.aberrations import wavefront_grids
from estimator.wavefront.field_wavefronts import (
    polynomial_in_mm,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial

MAX_KNOWN = 8
"""Number of arrays of fields whose phases are kept: the plan of an eye's nodes asks a
quarter of them again, for other pupils and states of accommodation."""


class PeripheralResidual:
    """Phase in the plane of the entrance pupil, over a range of fields.

    Parameters
    ----------
    change : PeripheralChange
    eye : EstimatedEye
        Eye to whose wavefronts the phase is added.
    nodes_deg : (n_h,), (n_v,)
        Azimuths and elevations of a grid over fields without vignetting, between which
        the phase is interpolated.
    """

    def __init__(
        self,
        change: PeripheralChange,
        eye: EstimatedEye,
        nodes_deg: FieldNodes,
    ):
        self.change = change
        usual = clamped_eye(change, eye)
        self._traced = _traced(usual, *nodes_deg)
        self._depth_mm = usual.accommodating.entrance_pupil_mm
        self._at_cornea_um = _on_circle(usual)
        axis_deg = np.zeros(1)  # which may lie outside the range
        on_axis = _traced(usual, axis_deg, axis_deg)
        self._on_axis_um = self._difference_um(on_axis, axis_deg, axis_deg)

    @property
    def passes(self) -> bool:
        """Whether the eye could be traced over the whole range."""
        return self._traced.passes

    def at(
        self, h_deg: NDArray[np.float64], v_deg: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return monomials (n, 28), um/mm^degree, at fields (n,) within the range."""
        key = h_deg.tobytes(), v_deg.tobytes()
        found_um = self._known_um.get(key)
        if found_um is None:
            found_um = self._difference_um(self._traced, h_deg, v_deg)
            found_um = found_um - self._on_axis_um
            found_um.flags.writeable = False
            self.keep(h_deg, v_deg, found_um)
        return found_um

    def keep(
        self,
        h_deg: NDArray[np.float64],
        v_deg: NDArray[np.float64],
        phase_um: NDArray[np.float64],
    ) -> None:
        """Keep a result of `at`, which was computed before, for these fields."""
        # A new dict, because other threads may read the old one.
        known = [
            *self._known_um.items(),
            ((h_deg.tobytes(), v_deg.tobytes()), phase_um),
        ]
        self._known_um = dict(known[-MAX_KNOWN:])

    def last_known(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None:
        """Return the arguments of `keep` for the last fields, or None."""
        if not self._known_um:
            return None
        key, phase_um = next(reversed(self._known_um.items()))
        h_deg, v_deg = (np.frombuffer(own, np.float64) for own in key)
        return h_deg, v_deg, phase_um

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without known phases, which take a megabyte."""
        return {name: v for name, v in vars(self).items() if name != "_known_um"}

    @cached_property
    def _known_um(self) -> dict[tuple[bytes, bytes], NDArray[np.float64]]:
        """Phases of the last arrays of fields; files of eyes do not contain them."""
        return {}

    def _difference_um(
        self, traced: FieldInterpolation, h_deg: NDArray[Any], v_deg: NDArray[Any]
    ) -> NDArray[np.float64]:
        population_um = self._at_cornea_um + self.change.zernike_um(h_deg, v_deg)
        population_um = moved_polynomial(
            polynomial_in_mm(remove_central_tilt(population_um), CIRCLE_MM),
            depth_mm=self._depth_mm,
            radius_mm=CIRCLE_MM,
        )
        traced_um, _ = traced.at(
            h_deg=h_deg,
            v_deg=v_deg,
            pupil_diameter_mm=np.full(h_deg.size, 2.0 * CIRCLE_MM),
            accommodation_dpt=np.zeros(h_deg.size),
            wavelength_nm=np.full(h_deg.size, REFERENCE_WAVELENGTH_NM),
        )
        difference_um = zernike_from_polynomial(
            summed_terms(population_um, -traced_um), CIRCLE_MM
        )[..., :N_TERMS]
        known = np.isin(np.arange(N_TERMS), TERMS)
        difference_um = remove_central_tilt(np.where(known, difference_um, 0.0))
        return polynomial_in_mm(difference_um, CIRCLE_MM)


def _traced(
    eye: EstimatedEye, h_deg: NDArray[Any], v_deg: NDArray[Any]
) -> FieldInterpolation:
    """Trace the relaxed eye through `CIRCLE_MM` at the nodes of a grid."""
    grid = aberration_grid(
        eye,
        h_deg=h_deg,
        v_deg=v_deg,
        pupil_diameters_mm=[2.0 * CIRCLE_MM],
        accommodations_dpt=[0.0],
        wavelengths_nm=[REFERENCE_WAVELENGTH_NM],
        n_rings=FIELD_RINGS,
        n_azimuths=FIELD_AZIMUTHS,
    )
    return FieldInterpolation(grid)


def clamped_eye(change: PeripheralChange, eye: EstimatedEye) -> EstimatedEye:
    """Return an eye with the on-axis wavefront of ``change``.

    This is ``eye`` itself unless that wavefront was clamped.
    """
    if change.is_in_population:
        return eye
    zernike_um = np.zeros(N_TERMS)
    zernike_um[list(TERMS)] = change.axis_um
    if change.eye_side == "OS":
        zernike_um = flip_horizontal(zernike_um)
    return estimate_eye(_with_axis(eye.profile, zernike_um))


def _with_axis(profile: EyeProfile, zernike_um: NDArray[Any]) -> EyeProfile:
    measurement = Measurement(zernike_um, 2.0 * CIRCLE_MM, profile.wavelength_nm)
    return replace(
        profile,
        kind="zernike",
        pupil_diameter_mm=measurement.pupil_diameter_mm,
        measurements=(measurement,),
        eye=None,
        periphery="model",
    )


def _on_circle(eye: EstimatedEye) -> NDArray[np.float64]:
    """Return the wavefront (28,) of an eye at the cornea.

    Its normalization radius is `CIRCLE_MM`.
    """
    return on_axis_zernike_um(
        eye.parameters,
        retina=eye.retina,
        pupil_diameter_mm=2.0 * CIRCLE_MM,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
    )


HELD = list(TERMS)

ITERATIONS = 3
"""Corrections of the phase; the transfer to the cornea is slightly nonlinear.  After
the third, up to 40 deg and 6 dpt, M is held to 2e-3 dpt and all terms to 2e-3 um.  A
fourth would divide that by eight and take 5 % of an eye's preparation."""


def held_periphery_um(
    eye: EyeModel, grid: AberrationGrid, periphery: PeripheralResidual
) -> NDArray[np.float64]:
    """Return the phase at the nodes of a grid, in the plane of the entrance pupil.

    Parameters
    ----------
    eye : EyeModel
    grid : AberrationGrid
        Grid over the field, whose fields and accommodations are used.
    periphery : PeripheralResidual
        Phase of the population's periphery for this eye.

    Returns
    -------
    (n_h, n_v, n_accommodations, 28), um/mm^degree
        Monomials of degrees 2 to 4; NaN where the eye could not be traced.
    """
    h_deg, v_deg = np.meshgrid(grid.h_deg, grid.v_deg, indexing="ij")
    shape = *h_deg.shape, 1 + grid.accommodations_dpt.size
    directions_deg = np.stack([h_deg.ravel(), v_deg.ravel()], axis=-1)
    traced_um = _traced_um(
        eye,
        accommodations_dpt=np.append(0.0, grid.accommodations_dpt),
        directions_deg=np.append(directions_deg, [[0.0, 0.0]], axis=0),
    )
    rest_um = eye.rest([REFERENCE_WAVELENGTH_NM]).on_axis_um(2.0 * CIRCLE_MM)
    traced_um = summed_terms(traced_um, rest_um)
    changed_um = periphery.at(*directions_deg.T)
    field_um = summed_terms(traced_um[:-1], changed_um[:, None]).reshape(*shape, -1)
    depth_mm = eye.accommodating.entrance_pupil_mm

    def at_cornea_um(polynomial_um: NDArray[Any]) -> NDArray[np.float64]:
        moved_um = moved_polynomial(
            polynomial_um, depth_mm=-depth_mm, radius_mm=CIRCLE_MM
        )
        return zernike_from_polynomial(moved_um, CIRCLE_MM)[..., HELD]

    on_axis_um = at_cornea_um(traced_um[-1])
    wanted_um = at_cornea_um(field_um[:, :, :1]) + on_axis_um - on_axis_um[0]
    phase_um = np.zeros((*shape, N_TERMS))
    for _ in range(ITERATIONS):
        missing_um = np.zeros_like(phase_um)
        missing_um[..., HELD] = wanted_um - at_cornea_um(
            summed_terms(field_um, phase_um)
        )
        step_um = polynomial_in_mm(remove_central_tilt(missing_um), CIRCLE_MM)
        step_um[..., 0] = 0.0  # piston
        phase_um += step_um
    return phase_um[:, :, 1:]


def _traced_um(
    eye: EyeModel,
    *,
    accommodations_dpt: NDArray[np.float64],
    directions_deg: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return traced monomials (n_directions, n_accommodations, 28) on `CIRCLE_MM`."""
    states = eye.accommodating.states_at(accommodations_dpt)
    traced = wavefront_grids(
        [state.surfaces for state in states],
        fields_deg=directions_deg,
        wavelengths_nm=[REFERENCE_WAVELENGTH_NM],
        pupil_diameters_mm=[2.0 * CIRCLE_MM],
        plane="pupil",
        n_rings=FIELD_RINGS,
        n_azimuths=FIELD_AZIMUTHS,
    )
    found_um = polynomial_in_mm(traced.zernike_um, traced.zernike_radius_mm)
    return np.swapaxes(found_um[:, :, 0, 0], 0, 1)
