"""Wavefronts of a traced eye at fixed fields, as pupil and accommodation change.

The interpolation over field and wavelength is done once (see `FieldValues`), because a
stream of frames requests the same fields repeatedly.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.measured_residual import MeasuredResidual
from estimator.field.fixed_defocus import FixedDefocus
from estimator.field.interpolation import FieldInterpolation
from estimator.field.peripheral_residual import PeripheralResidual
from estimator.optics.zernike import summed_terms
from estimator.wavefront.field_wavefronts import (
    circumscribed_radius_mm,
    distinct_rows,
    zernike_from_polynomial,
)

MARGIN = 1e-3
"""Distance from the traced range, in deg, mm or dpt, that is extrapolated."""


def check_limits(
    name: str, values: NDArray[Any] | np.float64, low: float, high: float
) -> None:
    """Check that values are in the traced range.

    Raises
    ------
    ValueError
        A value is outside.
    """
    if isinstance(values, np.float64):  # in a tenth of the time
        if low - MARGIN <= values <= high + MARGIN:
            return
    if values.size and not (
        values.min() >= low - MARGIN and values.max() <= high + MARGIN
    ):
        raise ValueError(
            f"{name} {values.min():g} to {values.max():g}: traced are "
            f"{low:g} to {high:g}"
        )


class TracedFields:
    """Wavefronts at n pairs of field and wavelength.

    Parameters
    ----------
    field, on_axis : FieldInterpolation
        Interpolation over the field, and one that contains the axis.
    correction_um : (n_terms,) or (n, n_terms), um/mm^degree
        Wavefront of the correction, which is subtracted.
    residual : MeasuredResidual
        Residual of the estimate, which is added.
    periphery : PeripheralResidual, optional
        Phase added off the axis.  The residual is then added at all fields with a
        weight of 1, because this phase is a change from the axis.
    h_deg, v_deg, wavelength_nm : (n,)
        Fields and wavelengths within the traced range.
    pupil_diameter_mm : (n,), optional
        Pupils that will be requested; by default, any of them may be.
    """

    def __init__(
        self,
        field: FieldInterpolation,
        on_axis: FieldInterpolation,
        correction_um: NDArray[np.float64],
        residual: MeasuredResidual,
        *,
        periphery: PeripheralResidual | None = None,
        h_deg: NDArray[np.float64],
        v_deg: NDArray[np.float64],
        wavelength_nm: NDArray[np.float64],
        pupil_diameter_mm: NDArray[np.float64] | None = None,
    ):
        self._field, self._on_axis = field, on_axis
        self._open_mm = field.open_pupils_mm(h_deg, v_deg)
        pupils = {}
        if pupil_diameter_mm is not None:
            pupils["pupil_diameter_mm"] = self._usable_mm(pupil_diameter_mm)
        self._states = field.values(
            h_deg=h_deg, v_deg=v_deg, wavelength_nm=wavelength_nm, **pupils
        )
        self._residual = residual
        self._residual_weight = residual.left_share(h_deg, v_deg)
        self._added_um = summed_terms(residual.color_um(wavelength_nm), -correction_um)
        if periphery is not None:
            self._residual_weight = np.ones(h_deg.size)
            change_um = _evaluate_distinct(periphery.at, h_deg, v_deg)
            self._added_um = summed_terms(self._added_um, change_um)
        zeros = np.zeros(h_deg.size)
        self._axis_states = on_axis.values(
            h_deg=zeros, v_deg=zeros, wavelength_nm=wavelength_nm, **pupils
        )

    def wavefronts(
        self,
        *,
        pupil_diameter_mm: NDArray[np.float64],
        accommodation_dpt: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return coefficients, um, rims (n, 5) and radii (n,), mm, of states.

        Parameters
        ----------
        pupil_diameter_mm, accommodation_dpt : (n,)

        Returns
        -------
        zernike_um : (n, n_terms), um
            As many terms as the residual or the traced wavefronts have.
        rim_mm : (n, 5)
        radius_mm : (n,)
        """
        pupil_mm = self._usable_mm(pupil_diameter_mm)
        polynomial_um, rim_mm = self._field.between(
            self._states,
            pupil_diameter_mm=pupil_mm,
            accommodation_dpt=accommodation_dpt,
        )
        rim_mm = rim_mm * self._rim_scale(pupil_mm, accommodation_dpt)[:, None]
        radius_mm = circumscribed_radius_mm(rim_mm)
        residue_um = self._residual.residues_um(pupil_mm / 2.0, self._residual_weight)
        zernike_um = zernike_from_polynomial(
            summed_terms(polynomial_um, self._added_um, residue_um), radius_mm
        )
        return zernike_um, rim_mm, radius_mm

    def fixed_defocus(self) -> FixedDefocus:
        """Return a fast function of total defocus, for one pupil and accommodation."""
        return FixedDefocus(
            (self._field, self._states),
            (self._on_axis, self._axis_states),
            self._residual,
            residual_weight=self._residual_weight,
            added_um=self._added_um,
            open_mm=self._open_mm,
        )

    def _rim_scale(
        self, pupil_mm: NDArray[Any], accommodation_dpt: NDArray[Any]
    ) -> NDArray[np.float64]:
        """Return ratios (n,) of the requested pupils to the traced ones, on axis."""
        channel = self._axis_states.channel
        first, number = distinct_rows(channel, pupil_mm, accommodation_dpt)
        _, rim_mm = self._on_axis.between(
            self._axis_states.select(first),
            pupil_diameter_mm=pupil_mm[first],
            accommodation_dpt=accommodation_dpt[first],
        )
        scale: NDArray[np.float64] = (
            pupil_mm[first] / 2.0 / circumscribed_radius_mm(rim_mm)
        )
        return scale[number]

    def _usable_mm(self, pupil_mm: NDArray[Any]) -> NDArray[np.float64]:
        """Return the pupils (n,), reduced at fields where they are vignetted."""
        if self._open_mm is None:
            return pupil_mm
        usable_mm: NDArray[np.float64] = np.minimum(pupil_mm, self._open_mm)
        return usable_mm


def _evaluate_distinct(
    function: Callable[..., NDArray[np.float64]],
    h_deg: NDArray[Any],
    v_deg: NDArray[Any],
) -> NDArray[np.float64]:
    """Evaluate a function of directions (n,), once for each distinct direction."""
    first, number = distinct_rows(h_deg, v_deg)
    return function(h_deg[first], v_deg[first])[number]
