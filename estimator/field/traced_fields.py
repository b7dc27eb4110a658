"""Traced part of the field, and wavefronts there as pupil and accommodation change.

The interpolation over field and wavelength is done once (see `FieldValues`), because a
stream of frames requests the same fields repeatedly.

For total defocus, terms that depend only on field and wavelength are computed once.
For a state, total defocus depends only on sums of monomials, by degree, and on the rim
of the pupil.
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from estimator.estimate.given_surfaces import GivenSurfaces
from estimator.estimate.measured_residual import OVERSHOOT, MeasuredResidual
from estimator.estimate.model import EyeModel
from estimator.estimate.surgery import natural_eye
from estimator.eye.tracing import TraceFailed
from estimator.field.interpolation import (
    AberrationGrid,
    FieldInterpolation,
    FieldNodes,
    FieldValues,
    pupil_powers,
    range_nodes_deg,
)
from estimator.field.peripheral_residual import PeripheralResidual
from estimator.native import core
from estimator.native.records import DefocusGrid, DefocusJob, pointer_to
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, SPHERE_PER_C20
from estimator.optics.zernike import (
    DEFAULT_ORDER,
    HIGHEST_ORDER,
    N_TERMS,
    monomial_degrees,
    summed_terms,
)
from estimator.periphery.change import peripheral_change
from estimator.wavefront.aberrations import TRACED_FIELD_LIMIT_DEG, wavefront_grid
from estimator.wavefront.field_wavefronts import (
    N_RIM,
    c20_by_degree,
    circumscribed_radius_mm,
    distinct_rows,
    zernike_from_polynomial,
)
from estimator.wavefront.nodes import fewest_nodes


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
        return np.minimum(pupil_mm, self._open_mm)


def _evaluate_distinct(
    function: Callable[..., NDArray[np.float64]],
    h_deg: NDArray[Any],
    v_deg: NDArray[Any],
) -> NDArray[np.float64]:
    """Evaluate a function of directions (n,), once for each distinct direction."""
    first, number = distinct_rows(h_deg, v_deg)
    return function(h_deg[first], v_deg[first])[number]


FIELD_PUPIL_RATIOS = (0.64, 1.0)
"""Pupils traced over the field, relative to the largest one."""

LARGE_PUPIL_MM = 7.2
LARGE_FIELD_PUPIL_RATIOS = (0.56, 0.8, 1.0)
"""Pupils traced over the field if the largest exceeds `LARGE_PUPIL_MM`."""

TRACE_ERROR_UM = 0.005
"""RMS error of traced wavefronts through the measured pupil above which they get more
terms."""

CHECKED_DEG = [(0, 0), (-20, 0), (20, 0), (-40, 0), (40, 0), (0, -20), (0, 20)]
"""Directions in which this is checked, whatever the range of fields: an eye has the
same wavefronts in every range."""

ON_AXIS_DEG = ((0.0, 0.0), (0.0, 0.0))
SHRINK_RATIO, SMALLEST_SHARE = 0.85, 0.05
"""Factor by which the traced field shrinks until it is unvignetted, and its limit."""

FieldRange = tuple[tuple[float, float], tuple[float, float]]


def largest_open_pupil_mm(grid: AberrationGrid) -> float:
    """Return the largest pupil of an on-axis grid that is unvignetted in all states.

    Raises
    ------
    TraceFailed
        All pupils are vignetted.
    """
    is_open = FieldInterpolation.is_open(grid)[0, 0].all(axis=(1, 2))
    if not is_open.any():
        raise TraceFailed(
            f"no light passes the eye at {grid.pupil_diameters_mm[0]:g} mm"
        )
    return float(grid.pupil_diameters_mm[is_open][-1])


def field_pupils_mm(low_mm: float, high_mm: float) -> NDArray[np.float64]:
    """Return the pupils (n,), mm, to trace over the field, for a range of pupils."""
    large = high_mm > LARGE_PUPIL_MM
    ratios = LARGE_FIELD_PUPIL_RATIOS if large else FIELD_PUPIL_RATIOS
    pupils_mm = np.maximum(high_mm * np.array(ratios), low_mm)
    return np.unique(pupils_mm)


def traced_terms(eye: EyeModel) -> int:
    """Return the number of terms that the traced wavefronts of an eye need.

    It is 28, or as many as represent the wavefronts of the relaxed eye through the
    measured pupil with an RMS error of `TRACE_ERROR_UM`.  A prescription states no
    higher orders, and a given eye no pupil.
    """
    profile = eye.profile
    if profile.is_given or profile.kind == "prescription":
        return N_TERMS
    for order in range(DEFAULT_ORDER, HIGHEST_ORDER + 1):
        n_terms = (order + 1) * (order + 2) // 2
        n_rings, n_azimuths = fewest_nodes(n_terms)
        found = wavefront_grid(
            eye.relaxed,
            fields_deg=CHECKED_DEG,
            wavelengths_nm=[REFERENCE_WAVELENGTH_NM],
            pupil_diameters_mm=[profile.pupil_diameter_mm],
            plane="pupil",
            n_rings=n_rings,
            n_azimuths=n_azimuths,
            n_terms=n_terms,
        )
        if not (found.rms_residual_um > TRACE_ERROR_UM).any():  # or NaN
            break
    return n_terms


def trace_field(
    eye: EyeModel,
    axis: FieldInterpolation,
    field_range_deg: FieldRange,
    field_grid: Callable[..., AberrationGrid],
    nodes_deg: FieldNodes | None = None,
    **axes: Any,
) -> tuple[FieldInterpolation, FieldRange]:
    """Trace a range of fields, which is shrunk until it is unvignetted.

    Parameters
    ----------
    nodes_deg : (n_h,), (n_v,), optional
        Nodes of the whole range, unless it is shrunk or exceeds
        `TRACED_FIELD_LIMIT_DEG`; by default from `field_nodes_deg`.

    Returns
    -------
    field : FieldInterpolation
    traced_range_deg : ((h_low, h_high), (v_low, v_high))
    """
    n_rings, n_azimuths = fewest_nodes(axis.grid.zernike_um.shape[-1])
    limited = np.clip(field_range_deg, -TRACED_FIELD_LIMIT_DEG, TRACED_FIELD_LIMIT_DEG)
    share = 1.0
    while share > SMALLEST_SHARE:
        traced = (share * limited).tolist()
        is_whole = np.array_equal(traced, field_range_deg)
        if nodes_deg is None or not is_whole:
            nodes_deg = range_nodes_deg(traced)
        field = FieldInterpolation(
            field_grid(
                eye,
                h_deg=nodes_deg[0],
                v_deg=nodes_deg[1],
                n_rings=n_rings,
                n_azimuths=n_azimuths,
                **axes,
            )
        )
        if field.passes:
            return field, cast(FieldRange, tuple(map(tuple, traced)))
        share *= SHRINK_RATIO
    return axis, ON_AXIS_DEG


def peripheral_residual(
    eye: EyeModel, nodes_deg: FieldNodes
) -> PeripheralResidual | None:
    """Return the phase of the population's periphery for an eye, over a grid.

    It is None if the eye has the periphery of the model, because the profile requests
    it or the phase cannot be traced over the whole range.
    """
    eye = natural_eye(eye)  # surgery does not change the retina
    if isinstance(eye, GivenSurfaces) or eye.profile.periphery == "model":
        return None
    if not np.any(np.concatenate(nodes_deg)):
        return None
    residual = PeripheralResidual(peripheral_change(eye.profile), eye, nodes_deg)
    return residual if residual.passes else None


def scaled_progress(
    progress: Callable[[float], None] | None, low: float, high: float
) -> Callable[[float], None] | None:
    """Return a progress callback that maps fractions to [low, high]."""
    if progress is None:
        return None
    return lambda done: progress(low + (high - low) * done)


def check_field_range(field_range_deg: FieldRange) -> None:
    """Check a range of fields.

    Raises
    ------
    ValueError
        The range is not ascending or exceeds 90 degrees.
    """
    for low, high in field_range_deg:
        if not -90.0 < low <= high < 90.0:
            raise ValueError(
                f"field_range_deg {field_range_deg}: needs -90 < low <= high < 90 twice"
            )
