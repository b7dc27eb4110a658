"""Total defocus of a traced eye at fixed fields, as pupil and accommodation change.

Terms that depend only on field and wavelength are computed once; see `defocus_loops`.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.measured_residual import MeasuredResidual
from estimator.field.interpolation import (
    FieldInterpolation,
    FieldValues,
    lagrange_weights,
    pupil_powers,
)
from estimator.optics.zernike import monomial_degrees, padded_terms
from estimator.wavefront.field_wavefronts import N_RIM, c20_by_degree


class FixedDefocus:
    """Total defocus of n pairs of field and wavelength, as a function of the state.

    Parameters
    ----------
    field, on_axis : (FieldInterpolation, FieldValues)
        Wavefronts over the field, and on the axis at the same wavelengths.
    residual : MeasuredResidual
        Residual of the estimate.
    residual_weight : (n,)
        Weight of the residual.
    added_um : (n, n_terms)
        Phase that does not depend on the pupil.
    open_mm : (n,), optional
        Unvignetted pupil diameters; unlimited by default.
    """

    def __init__(
        self,
        field: tuple[FieldInterpolation, FieldValues],
        on_axis: tuple[FieldInterpolation, FieldValues],
        residual: MeasuredResidual,
        *,
        residual_weight: NDArray[np.float64],
        added_um: NDArray[np.float64],
        open_mm: NDArray[np.float64] | None,
    ):
        self._grids = tuple(_Grid(*part) for part in (field, on_axis))
        values = field[1]
        count = values.field.size
        open_mm = np.full(count, np.inf) if open_mm is None else open_mm
        self._state = values.field, values.channel, np.ascontiguousarray(open_mm)
        n_terms = max(
            added_um.shape[-1],
            residual.residue_um.size,
            values.values.shape[-1] - N_RIM,
        )
        added_um = padded_terms(added_um, n_terms)
        residue_um = padded_terms(residual.residue_um, n_terms)
        fading = residual_weight[:, None] * c20_by_degree(residue_um)
        self._added = (
            c20_by_degree(added_um),
            np.ascontiguousarray(fading),
            float(residual.radius_mm),
        )

    def at(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float
    ) -> NDArray[np.float64]:
        """Return the least-squares refraction (n,), dpt, on the circle of the pupil."""
        from estimator.field.defocus_loops import fill_defocus

        found_dpt = np.empty(self._state[0].size)
        grids = (grid.inputs_at(accommodation_dpt) for grid in self._grids)
        fill_defocus(
            float(pupil_diameter_mm), *grids, self._state, self._added, found_dpt
        )
        return found_dpt


class _Grid:
    """Nodes of a grid, and its values: sums of monomials by degree, and rims."""

    def __init__(self, interpolation: FieldInterpolation, values: FieldValues):
        self._nodes_mm = np.array(interpolation.grid.pupil_diameters_mm, np.float64)
        self._accommodations_dpt = interpolation.grid.accommodations_dpt
        whole = values.values
        sums, rims = c20_by_degree(whole[..., :-N_RIM]), whole[..., -N_RIM:]
        self._values = np.ascontiguousarray(np.concatenate([sums, rims], axis=-1))
        n_terms = whole.shape[-1] - N_RIM
        powers, degrees = pupil_powers(n_terms), 2 + 2 * np.arange(sums.shape[-1])
        first = np.searchsorted(monomial_degrees(n_terms), degrees)
        self._powers = np.concatenate([powers[first], powers[-N_RIM:]])

    def inputs_at(self, accommodation_dpt: float) -> tuple[NDArray[np.float64], ...]:
        """Return the arguments of the compiled loop for an accommodation."""
        (weights,) = lagrange_weights(
            self._accommodations_dpt, np.array([accommodation_dpt])
        )
        return self._nodes_mm, self._powers, weights, self._values
