"""Phase that converts an estimated eye's peripheral wavefronts into the population's.

An estimated eye reproduces the person's on-axis wavefront but not the peripheral ones.
Its lens is homogeneous and its retina spherical, and the true lens gradient and retinal
shape cannot be inferred from the on-axis wavefront.  The phase is the wavefront of the
population for this on-axis wavefront (`periphery`), minus that of the eye model.  It is
added to the traced wavefronts, and it is zero on the axis.

For an eye outside the population's range (for example keratoconus), the phase is
computed for an eye whose on-axis wavefront is clamped to that range.  How the actual
eye deviates from the clamped eye comes from ray tracing.

The population was measured through `CIRCLE_MM`.  Wider pupils have the same polynomial:
one that grows more slowly beyond 6 mm gives M a kink of 0.1 to 0.5 dpt/mm there, and
makes the far periphery of a myope up to 1 dpt more myopic at 7 mm than at 6 mm.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.eye.tracing import on_axis_zernike_um
from estimator.field.aberration_grid import (
    FIELD_AZIMUTHS,
    FIELD_RINGS,
    aberration_grid,
)
from estimator.field.interpolation import FieldInterpolation, FieldNodes
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import (
    N_TERMS,
    flip_horizontal,
    remove_central_tilt,
    summed_terms,
)
from estimator.periphery.change import PeripheralChange
from estimator.periphery.meridian import CIRCLE_MM, TERMS
from estimator.profiles.parse import EyeProfile, Measurement
from estimator.wavefront.field_wavefronts import (
    polynomial_in_mm,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial


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
        return self._difference_um(self._traced, h_deg, v_deg) - self._on_axis_um

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
