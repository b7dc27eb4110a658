"""Total defocus of a traced eye at fixed fields, as pupil and accommodation change.

Terms that depend only on field and wavelength are computed once.  For a state, total
defocus depends only on sums of monomials, by degree, and on the rim of the pupil.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.measured_residual import OVERSHOOT, MeasuredResidual
from estimator.field.interpolation import (
    FieldInterpolation,
    FieldValues,
    pupil_powers,
)
from estimator.native import core
from estimator.native.records import DefocusGrid, DefocusJob, pointer_to
from estimator.optics.units import SPHERE_PER_C20
from estimator.optics.zernike import HIGHEST_ORDER, monomial_degrees
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
        values = field[1]
        count = values.field.size
        open_mm = np.full(count, np.inf) if open_mm is None else open_mm
        fading = residual_weight[:, None] * _sums(residual.residue_um)
        self._grids = [_grid_arrays(*part) for part in (field, on_axis)]
        self._arrays = {
            "fields": np.ascontiguousarray(values.field, np.int64),
            "channels": np.ascontiguousarray(values.channel, np.int64),
            "open_mm": np.ascontiguousarray(open_mm, np.float64),
            "always": _sums(added_um),
            "fading": fading,
        }
        grids = [
            DefocusGrid(*map(pointer_to, arrays), *arrays[-1].shape[1:4])
            for arrays in self._grids
        ]
        self._job = DefocusJob(
            *grids,
            **{name: pointer_to(array) for name, array in self._arrays.items()},
            fading_mm=residual.radius_mm,
            overshoot=OVERSHOOT,
            sphere_per_c20=SPHERE_PER_C20,
            count=count,
        )
        self._scratch_count = grids[1].channel_count + sum(
            grid.accommodation_count for grid in grids
        )

    def at(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float
    ) -> NDArray[np.float64]:
        """Return the least-squares refraction (n,), dpt, on the circle of the pupil."""
        scratch, found_dpt = np.empty(self._scratch_count), np.empty(self._job.count)
        job = DefocusJob.from_buffer_copy(self._job)
        job.scratch, job.found_dpt = pointer_to(scratch), pointer_to(found_dpt)
        job.pupil_mm = pupil_diameter_mm
        job.accommodation_dpt = accommodation_dpt
        core().call("fill_defocus", job)
        return found_dpt


def _sums(polynomial_um: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sums (..., 5) of monomials by degree: 2, 4 ... 10, some of them zero."""
    found = c20_by_degree(polynomial_um)
    sums = np.zeros((*found.shape[:-1], HIGHEST_ORDER // 2))
    sums[..., : found.shape[-1]] = found
    return sums


def _grid_arrays(
    interpolation: FieldInterpolation, values: FieldValues
) -> tuple[NDArray[np.float64], ...]:
    """Return the arrays of a `DefocusGrid`: sums of monomials by degree, and rims."""
    grid, whole = interpolation.grid, values.values
    sums, n_terms = _sums(whole[..., :-N_RIM]), whole.shape[-1] - N_RIM
    powers, degrees = pupil_powers(n_terms), 2 + 2 * np.arange(sums.shape[-1])
    # Sums of degrees that the fit omits are zero, with any power.
    first = np.minimum(np.searchsorted(monomial_degrees(n_terms), degrees), n_terms - 1)
    return (
        np.ascontiguousarray(grid.pupil_diameters_mm, np.float64),
        np.concatenate([powers[first], powers[-N_RIM:]]),
        np.ascontiguousarray(grid.accommodations_dpt, np.float64),
        np.concatenate([sums, whole[..., -N_RIM:]], axis=-1),
    )
