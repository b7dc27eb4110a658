"""Refraction of the periphery at every accommodation, relative to the axis.

In people, refraction off the axis relative to that on the axis hardly changes with
accommodation: no significant change in Calver et al. 2007 (Vision Res 47:2341) and
Davies & Mallen 2009 (Br J Ophthalmol 93:1225), 0.1 to 0.5 dpt more myopic over several
diopters in Whatham et al. 2009 (J Vis 9(3):14) and Lundstrom et al. 2009 (J Vis
9(6):17).  The eye model, with its homogeneous lens and fixed retina, turns 0.28 dpt
more hyperopic at 30 deg for each diopter.  A phase removes that: through `CIRCLE_MM`,
at the cornea, M, J0 and J45 relative to the axis are those of the relaxed eye.  Higher
orders change as they are traced.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.estimation import EstimatedEye
from estimator.field.aberration_grid import (
    FIELD_AZIMUTHS,
    FIELD_RINGS,
    AberrationGrid,
    aberration_grid,
)
from estimator.field.peripheral_residual import PeripheralResidual
from estimator.optics.prescription import C2M2, C20, C22
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS
from estimator.periphery.meridian import CIRCLE_MM
from estimator.wavefront.field_wavefronts import (
    polynomial_in_mm,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial

SECOND_ORDER = [C2M2, C20, C22]

ITERATIONS = 3
"""Corrections of the phase; the transfer to the cornea is slightly nonlinear.  After
the third, the refraction is held to 1e-6 dpt."""


def held_refraction_um(
    eye: EstimatedEye, grid: AberrationGrid, periphery: PeripheralResidual
) -> NDArray[np.float64]:
    """Return the phase at the nodes of a grid, in the plane of the entrance pupil.

    Parameters
    ----------
    eye : EstimatedEye
    grid : AberrationGrid
        Grid over the field, whose fields and accommodations are used.
    periphery : PeripheralResidual
        Phase of the population's periphery for this eye.

    Returns
    -------
    (n_h, n_v, n_accommodations, 28), um/mm^degree
        Second-degree monomials; NaN where the eye could not be traced.
    """
    h_deg, v_deg = np.meshgrid(grid.h_deg, grid.v_deg, indexing="ij")
    added_um = eye.rest([REFERENCE_WAVELENGTH_NM]).on_axis_um(2.0 * CIRCLE_MM)[0]
    states_dpt = np.append(0.0, grid.accommodations_dpt)
    axis_um = added_um + _traced_um(eye, states_dpt, h_deg=[0.0], v_deg=[0.0])
    changed_um = periphery.at(h_deg.ravel(), v_deg.ravel())
    field_um = (
        added_um
        + changed_um.reshape(*h_deg.shape, 1, N_TERMS)
        + _traced_um(eye, states_dpt, h_deg=grid.h_deg, v_deg=grid.v_deg)
    )
    depth_mm = eye.accommodating.entrance_pupil_mm

    def at_cornea_um(polynomial_um: NDArray[Any]) -> NDArray[np.float64]:
        moved_um = moved_polynomial(polynomial_um, depth_mm=-depth_mm)
        return zernike_from_polynomial(moved_um, CIRCLE_MM)[..., SECOND_ORDER]

    on_axis_um = at_cornea_um(axis_um)
    wanted_um = at_cornea_um(field_um[:, :, :1]) + on_axis_um - on_axis_um[:, :, :1]
    phase_um = np.zeros_like(field_um)
    for _ in range(ITERATIONS):
        missing_um = np.zeros_like(field_um)
        missing_um[..., SECOND_ORDER] = wanted_um - at_cornea_um(field_um + phase_um)
        step_um = polynomial_in_mm(missing_um, CIRCLE_MM)
        step_um[..., 0] = 0.0  # piston
        phase_um += step_um
    return phase_um[:, :, 1:]


def _traced_um(
    eye: EstimatedEye, states_dpt: NDArray[Any], **fields_deg: Any
) -> NDArray[np.float64]:
    """Return traced monomials (n_h, n_v, n_states, 28) on `CIRCLE_MM`."""
    traced = aberration_grid(
        eye,
        pupil_diameters_mm=[2.0 * CIRCLE_MM],
        accommodations_dpt=states_dpt,
        wavelengths_nm=[REFERENCE_WAVELENGTH_NM],
        n_rings=FIELD_RINGS,
        n_azimuths=FIELD_AZIMUTHS,
        **fields_deg,
    )
    polynomial_um = polynomial_in_mm(traced.zernike_um, traced.zernike_radius_mm)
    return polynomial_um[:, :, 0, :, 0]
