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

from estimator.estimate.given_surfaces import EyeModel
from estimator.field.aberration_grid import (
    FIELD_AZIMUTHS,
    FIELD_RINGS,
    AberrationGrid,
)
from estimator.field.peripheral_residual import PeripheralResidual
from estimator.optics.prescription import C2M2, C20, C22
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS, summed_terms
from estimator.periphery.meridian import CIRCLE_MM
from estimator.wavefront.aberrations import wavefront_grids
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
        Second-degree monomials; NaN where the eye could not be traced.
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
        return zernike_from_polynomial(moved_um, CIRCLE_MM)[..., SECOND_ORDER]

    on_axis_um = at_cornea_um(traced_um[-1])
    wanted_um = at_cornea_um(field_um[:, :, :1]) + on_axis_um - on_axis_um[0]
    phase_um = np.zeros((*shape, N_TERMS))
    for _ in range(ITERATIONS):
        missing_um = np.zeros_like(phase_um)
        missing_um[..., SECOND_ORDER] = wanted_um - at_cornea_um(
            summed_terms(field_um, phase_um)
        )
        step_um = polynomial_in_mm(missing_um, CIRCLE_MM)
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
