"""Estimated eye with ray-traced wavefronts, for the PSF cache.

It has the interface of `measured_wavefront.MeasuredWavefront` without its limitations:
pupils larger than the measured one are traced, accommodation changes the lens and thus
all aberrations, and every field has its own wavefront.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.progressive import (
    ProgressiveLens,
    progressive_polynomial,
)
from estimator.corrections.worn_lens import rings_of, worn_polynomial
from estimator.estimate.model import EyeModel
from estimator.eye.focusing import FocusingEye
from estimator.field.interpolation import (
    AberrationGrid,
    FieldInterpolation,
    FieldNodes,
    aberration_grid,
    accommodation_nodes_dpt,
)
from estimator.field.peripheral_residual import PeripheralResidual, held_periphery_um
from estimator.field.traced_fields import (
    ON_AXIS_DEG,
    FieldRange,
    FixedDefocus,
    TracedFields,
    check_field_range,
    check_limits,
    field_pupils_mm,
    largest_open_pupil_mm,
    peripheral_residual,
    scaled_progress,
    trace_field,
    traced_terms,
)
from estimator.note import Note
from estimator.wavefront.field_wavefronts import (
    FieldWavefronts,
    distinct_rows,
    total_defocus_dpt,
    with_defocus,
)

ACCOMMODATION_STEP_DPT = 1.0
"""Largest step between accommodations whose PSFs are blended.  PSFs are blended at
equal total defocus, so only the slow change of the other aberrations is
interpolated."""

TRACED_ERROR_UM = 1e-3
"""Error of traced aberrations that a reply states."""

PREPARED_MARGIN_DPT = 0.02
"""Focus error above which a note states that the focus was not prepared."""

AXIS_PROGRESS = 0.1


class TracedEye(FocusingEye):
    """Wavefronts of an estimated or given eye over a range of fields, pupils and foci.

    The traced rim, which is up to a few percent smaller than the paraxial entrance
    pupil, is scaled such that on axis its circumscribed circle has the requested
    diameter; the factor is the same at all fields.  The residual of the estimate is
    added to the wavefronts (see `measured_residual`).  The correction is subtracted
    equally at all fields, except for progressive lenses (see
    `corrections.progressive`).

    The largest pupil is the largest traced one that is unvignetted on axis.  Off axis,
    a vignetted pupil is reduced to one with the unvignetted area.  The traced range is
    shrunk until it is unvignetted; fields outside have the wavefront of the nearest
    traced field.

    Attributes
    ----------
    grid : AberrationGrid
        Grid on the axis.
    eye_side : str
        OD or OS.
    field_range_deg : ((h_low, h_high), (v_low, v_high))
        Fields that may be requested.
    traced_range_deg : the same
        Fields that were traced.
    entrance_pupil_mm : float
        Depth of the entrance pupil behind the cornea.
    periphery : PeripheralResidual or None
        Phase added off the axis; None if the eye has the periphery of the model.
    """

    pupil_limit = "traced"

    def __init__(
        self,
        eye: EyeModel,
        axis: FieldInterpolation,
        field: FieldInterpolation | None = None,
        *,
        field_range_deg: FieldRange = ON_AXIS_DEG,
        traced_range_deg: FieldRange = ON_AXIS_DEG,
        periphery: PeripheralResidual | None = None,
        only_nodes: bool = False,
    ):
        self.grid = axis.grid
        self.eye_side = eye.profile.eye_side
        self._accommodating = eye.accommodating
        self.refraction_dpt = eye.refraction_dpt
        self.amplitude_dpt = eye.amplitude_dpt
        self.vergence = eye.accommodating.vergence
        self.max_pupil_diameter_mm = largest_open_pupil_mm(axis.grid)
        self.field_range_deg = field_range_deg
        self.traced_range_deg = traced_range_deg
        self.periphery = periphery
        self._field = field or axis
        # pupils are relative to those on the axis, which other nodes do not give
        has_axis = not only_nodes and all(
            low <= 0.0 <= high for low, high in traced_range_deg
        )
        self._on_axis = self._field if has_axis else axis
        self.entrance_pupil_mm = eye.accommodating.entrance_pupil_mm
        self.rings = rings_of(eye.profile.correction)
        self._lens = eye.profile.correction
        self._correction = worn_polynomial(
            self._lens, entrance_pupil_mm=self.entrance_pupil_mm
        )
        self._residual = eye.rest(
            axis.grid.wavelengths_nm, n_traced_terms=axis.grid.zernike_um.shape[-1]
        )

    @classmethod
    def trace(
        cls,
        eye: EyeModel,
        *,
        pupil_diameters_mm: ArrayLike,
        focus_range_dpt: tuple[float, float],
        wavelengths_nm: ArrayLike,
        field_range_deg: FieldRange = ON_AXIS_DEG,
        nodes_deg: FieldNodes | None = None,
        field_grid: Callable[..., AberrationGrid] = aberration_grid,
        progress: Callable[[float], None] | None = None,
    ) -> "TracedEye":
        """Trace the wavefronts for a range of pupils, foci and fields.

        Parameters
        ----------
        pupil_diameters_mm : (n,)
            Pupils, all of which are traced on axis.  Off axis, the largest and one or
            two smaller ones are traced, from which others are interpolated.
        field_range_deg : ((h_low, h_high), (v_low, v_high))
            Azimuths and elevations; ((0, 0), (0, 0)) is the axis alone.
        nodes_deg : (n_h,), (n_v,), optional
            Azimuths and elevations that are traced, ends of the range included; others
            are not interpolated well.  By default Chebyshev nodes.
        field_grid : callable, optional
            Function that traces the grid; `prepare.few_colors_grid` takes half the
            time of the default.
        progress : callable, optional
            Callback with the completed fraction; may raise to cancel.

        Raises
        ------
        TraceFailed
            All pupils are vignetted on axis.
        ValueError
            The field range is not ascending.
        """
        check_field_range(field_range_deg)
        pupils_mm = np.unique(pupil_diameters_mm)
        range_dpt = eye.accommodating.accommodation_range_dpt(
            focus_range_dpt, pupil_range_mm=(pupils_mm[0], pupils_mm[-1])
        )
        nodes_dpt = accommodation_nodes_dpt(*range_dpt)
        states: dict[str, Any] = {
            "accommodations_dpt": nodes_dpt,
            # both grids trace the same eyes, which take 2 to 5 ms to find and pack
            "states": eye.accommodating.states_at(nodes_dpt),
            "wavelengths_nm": np.unique(wavelengths_nm),
            "n_terms": traced_terms(eye),
        }
        on_axis_only = not np.any(field_range_deg)
        axis_share = 1.0 if on_axis_only else AXIS_PROGRESS
        axis_grid = aberration_grid(
            eye,
            pupil_diameters_mm=pupils_mm,
            **states,
            progress=scaled_progress(progress, 0.0, axis_share),
        )
        axis = FieldInterpolation(axis_grid)
        if on_axis_only:
            return cls(eye, axis)
        field, traced_range_deg = trace_field(
            eye,
            axis,
            field_range_deg,
            field_grid,
            nodes_deg=nodes_deg,
            pupil_diameters_mm=field_pupils_mm(
                axis_grid.pupil_diameters_mm[0], largest_open_pupil_mm(axis_grid)
            ),
            **states,
            progress=scaled_progress(progress, axis_share, 1.0),
        )
        traced_deg = field.grid.h_deg, field.grid.v_deg
        periphery = peripheral_residual(eye, traced_deg)
        if periphery is not None and field.grid.accommodations_dpt.any():
            phase_um = held_periphery_um(eye, field.grid, periphery)
            if np.isfinite(phase_um).all():
                field.add(phase_um)
            else:  # light does not pass 4 mm everywhere; `periphery_note` reports it
                periphery = None
        return cls(
            eye,
            axis,
            field,
            field_range_deg=field_range_deg,
            traced_range_deg=traced_range_deg,
            periphery=periphery,
            only_nodes=nodes_deg is not None,
        )

    def refraction_at_dpt(
        self, *, pupil_diameter_mm: float, accommodation_dpt: float
    ) -> float:
        """Return least-squares M at 555 nm through a pupil, at an accommodation."""
        return self._accommodating.refraction_at_dpt(
            pupil_diameter_mm=pupil_diameter_mm, accommodation_dpt=accommodation_dpt
        )

    def accommodation_for_dpt(
        self, refraction_dpt: float, *, pupil_diameter_mm: float
    ) -> float:
        """Return the traced accommodation with the nearest M through a pupil."""
        accommodation_dpt = self._accommodating.accommodation_for_dpt(
            refraction_dpt, pupil_diameter_mm=pupil_diameter_mm
        )
        low_dpt, high_dpt = self.grid.accommodations_dpt[[0, -1]].tolist()
        return min(max(accommodation_dpt, low_dpt), high_dpt)

    def largest_accommodation_dpt(self, pupil_diameter_mm: float) -> float:
        """Return the accommodation for the near point through a pupil."""
        return self._accommodating.largest_accommodation_dpt(pupil_diameter_mm)

    def focus_notes(
        self, focus_dpt: float, *, pupil_diameter_mm: float
    ) -> tuple[str, ...]:
        """Return notes on a focus that is out of reach or was not traced."""
        notes = super().focus_notes(focus_dpt, pupil_diameter_mm=pupil_diameter_mm)
        if notes:
            return notes  # the limit is the eye's own
        reachable_dpt = self.reachable_focus_dpt(
            focus_dpt, pupil_diameter_mm=pupil_diameter_mm
        )
        if abs(reachable_dpt - focus_dpt) <= PREPARED_MARGIN_DPT:
            return ()
        note = Note(
            "focus_not_prepared",
            f"focus {focus_dpt:g} dpt is outside the prepared range "
            f"(settings.focus_range_dpt): {reachable_dpt:.3g} dpt is used instead",
            focus_dpt=focus_dpt,
            used_dpt=reachable_dpt,
        )
        return (note,)

    def accommodation_nodes_dpt(
        self,
        focus_range_dpt: tuple[float, float],
        *,
        pupil_range_mm: tuple[float, float],
    ) -> NDArray[np.float64]:
        """Return ascending accommodations (n,) between which PSFs may be blended."""
        low_dpt, high_dpt = self.accommodation_range_dpt(
            focus_range_dpt, pupil_range_mm=pupil_range_mm
        )
        count = 1 + int(np.ceil((high_dpt - low_dpt) / ACCOMMODATION_STEP_DPT - 1e-9))
        return np.linspace(low_dpt, high_dpt, max(count, 1))

    def total_defocus_dpt(
        self,
        *,
        h_deg: ArrayLike = 0.0,
        v_deg: ArrayLike = 0.0,
        pupil_diameter_mm: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
        object_dpt: ArrayLike = 0.0,
    ) -> NDArray[np.float64]:
        """Return the least-squares refraction, dpt, plus the vergence of an object.

        All arguments broadcast, and the result has their shape.
        """
        states = np.broadcast_arrays(
            h_deg, v_deg, pupil_diameter_mm, accommodation_dpt, wavelength_nm
        )
        zernike_um, _, radius_mm, number = self._distinct(states)
        found_dpt = total_defocus_dpt(zernike_um, radius_mm)[number]
        return self.with_object_dpt(found_dpt.reshape(states[0].shape), object_dpt)

    def defocus_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., NDArray[np.float64]]:
        """Return `total_defocus_dpt` at fixed fields as a function of the eye's state.

        Returns
        -------
        callable
            Function of ``pupil_diameter_mm`` and ``accommodation_dpt`` that returns
            dpt in the arguments' broadcast shape.
        """
        fields, number = self._fixed_fields(h_deg, v_deg, wavelength_nm)
        return partial(self._defocus_dpt, fields.fixed_defocus(), number)

    def _defocus_dpt(
        self,
        fields: FixedDefocus,
        number: NDArray[np.int64],
        *,
        pupil_diameter_mm: float,
        accommodation_dpt: float,
    ) -> NDArray[np.float64]:
        state = {
            "pupil_diameter_mm": np.float64(pupil_diameter_mm),
            "accommodation_dpt": np.float64(accommodation_dpt),
        }
        self._check_states(**state)
        return fields.at(**state)[number]

    def wavefronts(
        self,
        *,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        pupil_diameter_mm: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
        total_defocus_dpt: ArrayLike,
    ) -> FieldWavefronts:
        """Return wavefronts (P,) with the given total defocus, in C order of states.

        Raises
        ------
        ValueError
            A state is outside the traced range.
        """
        *states, total_dpt = np.broadcast_arrays(
            *(h_deg, v_deg, pupil_diameter_mm, accommodation_dpt, wavelength_nm),
            total_defocus_dpt,
        )
        zernike_um, rim_mm, radius_mm, number = self._distinct(states)
        return with_defocus(
            zernike_um[number],
            rim_mm[number],
            radius_mm[number],
            total_defocus_dpt=total_dpt,
        )

    def wavefronts_at(
        self, *, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> Callable[..., FieldWavefronts]:
        """See `EyeOptics.wavefronts_at`; a call takes 4 ms, `wavefronts` 17 ms."""
        return partial(
            self._wavefronts_of, *self._fixed_fields(h_deg, v_deg, wavelength_nm)
        )

    def _fixed_fields(
        self, h_deg: ArrayLike, v_deg: ArrayLike, wavelength_nm: ArrayLike
    ) -> tuple[TracedFields, NDArray[np.int64]]:
        """Return distinct fields and wavelengths, and the index of each given one."""
        given = np.broadcast_arrays(h_deg, v_deg, wavelength_nm)
        columns = [np.asarray(column, dtype=np.float64).ravel() for column in given]
        first, number = distinct_rows(*columns)
        h_deg, v_deg, wavelength_nm = (column[first] for column in columns)
        self._check_fields(h_deg, v_deg)
        fields = self._fields(h_deg, v_deg, wavelength_nm)
        return fields, number.reshape(given[0].shape)

    def _wavefronts_of(
        self,
        fields: TracedFields,
        number: NDArray[np.int64],
        *,
        pupil_diameter_mm: float,
        accommodation_dpt: float,
        total_defocus_dpt: NDArray[np.float64],
    ) -> FieldWavefronts:
        ones = np.ones(int(number.max()) + 1)
        state = {
            "pupil_diameter_mm": pupil_diameter_mm * ones,
            "accommodation_dpt": accommodation_dpt * ones,
        }
        self._check_states(**state)
        zernike_um, rim_mm, radius_mm = fields.wavefronts(**state)
        every = np.broadcast_to(number.ravel(), total_defocus_dpt.shape).ravel()
        return with_defocus(
            zernike_um[every],
            rim_mm[every],
            radius_mm[every],
            total_defocus_dpt=total_defocus_dpt,
        )

    def chief_ray_shift_mrad(
        self,
        *,
        h_deg: ArrayLike,
        v_deg: ArrayLike,
        accommodation_dpt: ArrayLike,
        wavelength_nm: ArrayLike,
    ) -> NDArray[np.float64]:
        """Return the lateral color relative to 555 nm, mrad, along the pupil axes.

        All arguments broadcast; the result has their shape and a last axis of 2.
        Corrections are not included.  See `chief_shift_mrad`.
        """
        states = np.broadcast_arrays(h_deg, v_deg, accommodation_dpt, wavelength_nm)
        columns = [np.asarray(state, dtype=np.float64).ravel() for state in states]
        first, number = distinct_rows(*columns)
        h, v, accommodation_at_dpt, nm = (column[first] for column in columns)
        h, v = (
            np.clip(angle, *limits)
            for angle, limits in zip((h, v), self.traced_range_deg, strict=True)
        )
        found = self._field.chief_shift_mrad(
            h_deg=h, v_deg=v, accommodation_dpt=accommodation_at_dpt, wavelength_nm=nm
        )
        return found[number].reshape(*states[0].shape, 2)

    def _distinct(
        self, states: Sequence[NDArray[Any]]
    ) -> tuple[
        NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]
    ]:
        """Return coefficients, rims and radii of distinct states, and the inverse."""
        columns = [np.asarray(state, dtype=np.float64).ravel() for state in states]
        first, number = distinct_rows(*columns)
        h_deg, v_deg, pupil_mm, accommodation_dpt, wavelength_nm = (
            c[first] for c in columns
        )
        self._check_fields(h_deg, v_deg)
        state = {"pupil_diameter_mm": pupil_mm, "accommodation_dpt": accommodation_dpt}
        self._check_states(**state)
        fields = self._fields(h_deg, v_deg, wavelength_nm, pupil_diameter_mm=pupil_mm)
        return *fields.wavefronts(**state), number

    def _fields(
        self,
        h_deg: NDArray[np.float64],
        v_deg: NDArray[np.float64],
        wavelength_nm: NDArray[np.float64],
        *,
        pupil_diameter_mm: NDArray[np.float64] | None = None,
    ) -> TracedFields:
        h_deg, v_deg = (
            np.clip(angle, *limits)
            for angle, limits in zip((h_deg, v_deg), self.traced_range_deg, strict=True)
        )
        return TracedFields(
            self._field,
            self._on_axis,
            self._correction_at(h_deg, v_deg),
            self._residual,
            periphery=self.periphery,
            h_deg=h_deg,
            v_deg=v_deg,
            wavelength_nm=wavelength_nm,
            pupil_diameter_mm=pupil_diameter_mm,
        )

    def _correction_at(
        self, h_deg: NDArray[Any], v_deg: NDArray[Any]
    ) -> NDArray[np.float64]:
        """Return the wavefront of the correction, (28,) or (n, 28) at fields (n,)."""
        if not isinstance(self._lens, ProgressiveLens):
            return self._correction
        return progressive_polynomial(
            self._lens, h_deg, v_deg, entrance_pupil_mm=self.entrance_pupil_mm
        )

    def _check_fields(
        self, h_deg: NDArray[np.float64], v_deg: NDArray[np.float64]
    ) -> None:
        check_limits("h_deg", h_deg, *self.field_range_deg[0])
        check_limits("v_deg", v_deg, *self.field_range_deg[1])

    def _check_states(
        self,
        *,
        pupil_diameter_mm: NDArray[np.float64] | np.float64,
        accommodation_dpt: NDArray[np.float64] | np.float64,
    ) -> None:
        largest_mm = self.max_pupil_diameter_mm
        check_limits("pupil_diameter_mm", pupil_diameter_mm, 0.1, largest_mm)
        low_dpt, high_dpt = self.grid.accommodations_dpt[[0, -1]]
        check_limits("accommodation_dpt", accommodation_dpt, low_dpt, high_dpt)
