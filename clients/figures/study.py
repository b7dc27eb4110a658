"""One eye prepared for its figures: estimated and traced once, evaluated often.

`PupilWavefront` is one wavefront in the pupil, with its optical transfer function and
the acuity that it allows; `AcuityByDistance` is that acuity at all distances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from estimator import (
    Acuity,
    EyeModel,
    EyeOptics,
    EyeProfile,
    FieldTable,
    Rings,
    Transfer,
    best_correction_um,
    eye_model,
    field_table,
    load_profile,
    log_mar_of,
    optical_transfer,
    parse_profile,
    predict_acuity,
    prepare_eye,
    preset_names,
    white_light_transfer,
)

SECOND_ORDER = slice(3, 6)
TILTS = slice(1, 3)

STEP_COUNT, ACCOMMODATED_COUNT = 11, 3
"""Number of distances of a curve, and of its part within the accommodation range."""

FINE_STEP_DPT = 0.25
"""Step of the curve of a lens with several foci, which lie 1 dpt apart."""

PAST_LAST_FOCUS_DPT = 1.0
NEAREST_DPT = 5.0
PAST_FAR_POINT_DPT = 2.0
HIGHEST_DPT = 20.0
ACUITY_TOLERANCE_LOG_MAR = 0.005
"""Difference below which two acuities are equal: reports show 0.01."""

MIN_ACCOMMODATION_DPT = 1e-6
"""Smallest accommodation range; an eye with less is treated as fixed-focus."""

PUPILS_MM = (3.0, 5.0)
"""Pupils in daylight and at dusk."""

WAVELENGTH_NM = 555.0
FOCUS_RANGE_DPT = (-80.0, 20.0)
"""From the relaxed state of the most hyperopic eye to the nearest possible focus."""

FIELD_H_DEG = np.arange(-30.0, 31.0, 5.0)
FIELD_V_DEG = np.arange(-20.0, 21.0, 5.0)
FIELD_PUPIL_MM = 4.0
Profile = EyeProfile | Mapping[str, Any] | str | Path
ProgressCallback = Callable[[float, str], None]


@dataclass(frozen=True)
class PupilWavefront:
    """The wavefront of a point source and its pupil.

    Attributes
    ----------
    zernike_um : (28,)
        Coefficients on the circle of ``circle_diameter_mm``, in the plane of the
        entrance pupil.
    pupil_ellipse : (5,)
        Pupil within the circle: center x, y and semi-axes, mm, and angle, rad.
    rings : Rings or None
        Rings that produce several foci, or lenslets in front of the pupil.
    """

    zernike_um: NDArray[np.float64]
    circle_diameter_mm: float
    pupil_ellipse: NDArray[np.float64]
    wavelength_nm: float
    rings: Rings | None = None

    @property
    def is_readable(self) -> bool:
        """Return whether acuity and contrast are known; not through lenslets."""
        return self.rings is None or self.rings.lattice_mm is None

    @cached_property
    def predicted(self) -> Acuity | None:
        """Return acuity in white light, and visual Strehl ratio.

        None if the wavefront is too steep to be resolved, and through lenslets.
        """
        try:
            return predict_acuity(self.zernike_um, **self._pupil)
        except ValueError:
            return None

    @cached_property
    def best_corrected(self) -> PupilWavefront:
        """Return the wavefront with the best sphere and cylinder for this pupil.

        These have the highest visual Strehl ratio at which neither that ratio nor the
        acuity is worse than without them.  Through lenslets, they
        are the least-squares sphere and cylinder.
        """
        if not self.is_readable:
            return self._least_squares
        return next(
            tried
            for tried in self._corrections()
            if tried is self or tried.is_as_good_as(self)
        )

    def near_best_corrected(self, *, n_samples: int) -> PupilWavefront:
        """Return the wavefront with the best sphere and cylinder near least squares.

        Without large higher orders, it equals `best_corrected` and takes less time.

        Parameters
        ----------
        n_samples : int
            Samples across the pupil.
        """
        start_um = self._least_squares.zernike_um
        zernike_um = best_correction_um(start_um, n_samples=n_samples, **self._pupil)
        return replace(self, zernike_um=zernike_um)

    def _corrections(self) -> Iterator[PupilWavefront]:
        """Yield the states to choose the best correction from, the best first."""
        zernike_um = best_correction_um(self.zernike_um, **self._pupil)
        yield replace(self, zernike_um=zernike_um)
        yield self._least_squares
        yield self

    def is_as_good_as(self, other: PupilWavefront) -> bool:
        """Return whether acuity and visual Strehl ratio are not worse than another's.

        A wavefront that is too steep to be resolved is worse than all others.
        """
        mine, its = self.predicted, other.predicted
        if mine is None or its is None:
            return its is None
        has_ratio = mine.visual_strehl_ratio >= its.visual_strehl_ratio
        return has_ratio and mine.log_mar <= its.log_mar + ACUITY_TOLERANCE_LOG_MAR

    @property
    def _least_squares(self) -> PupilWavefront:
        zernike_um = self.zernike_um.copy()
        zernike_um[SECOND_ORDER] = 0.0
        return replace(self, zernike_um=zernike_um)

    @property
    def _pupil(self) -> dict[str, Any]:
        return {
            "zernike_radius_mm": self.circle_diameter_mm / 2.0,
            "wavelength_nm": self.wavelength_nm,
            "pupil_ellipse": self.pupil_ellipse,
            "pupil_screen": self.rings,
        }

    @property
    def untilted_um(self) -> NDArray[np.float64]:
        """Return the coefficients without tilt: the image's position is irrelevant."""
        zernike_um = self.zernike_um.copy()
        zernike_um[TILTS] = 0.0
        return zernike_um

    def white_light_transfer(self) -> Transfer:
        """Return the optical transfer function for white light, as `log_mar_of` needs.

        Raises
        ------
        ValueError
            As for `transfer`.
        """
        return white_light_transfer(self.untilted_um, **self._pupil)

    def transfer(self, **options: Any) -> Transfer:
        """Return the optical transfer function for one wavelength.

        Parameters
        ----------
        **options
            ``frequency_step_cpd``; see `optical_transfer`.

        Raises
        ------
        ValueError
            If the wavefront is too steep to be resolved, or through lenslets.
        """
        return optical_transfer(self.untilted_um, **self._pupil, **options)


@dataclass(frozen=True)
class AcuityByDistance:
    """Acuity through one pupil, logMAR; infinite where the blur is too wide.

    Attributes
    ----------
    object_dpt : (n,)
        Distances, far to near.
    far_log_mar, near_log_mar : (n,)
        Acuity of the eye focused far, and accommodating for each distance.
    """

    object_dpt: NDArray[np.float64]
    far_log_mar: NDArray[np.float64]
    near_log_mar: NDArray[np.float64]


def acuity_log_mar(wavefront: PupilWavefront) -> float:
    """Return the acuity of a wavefront; infinite if it is too steep to be resolved.

    NaN through lenslets: how people read through them is not known.
    """
    if not wavefront.is_readable:
        return np.nan
    try:
        return log_mar_of(wavefront.white_light_transfer())
    except ValueError:
        return np.inf


def distances_dpt(study: EyeStudy, pupil_diameter_mm: float) -> NDArray[np.float64]:
    """Return the distances (n,) of a curve: far to 20 cm, and past the far point."""
    pupil_mm = study.optics.usable_pupil_mm(pupil_diameter_mm)
    far_dpt, _ = study.optics.focus_limits_dpt(pupil_mm)
    nearest = min(max(NEAREST_DPT, far_dpt + PAST_FAR_POINT_DPT), HIGHEST_DPT)
    even = np.linspace(0.0, np.ceil(nearest), STEP_COUNT)
    peaks_dpt = np.array([far_dpt])
    seen = study.wavefront(pupil_mm)
    if seen.rings is not None and seen.is_readable:
        peaks_dpt = far_dpt + seen.rings.main_dpt(seen.wavelength_nm)
        last_dpt = float(peaks_dpt.max()) + PAST_LAST_FOCUS_DPT
        nearest = max(nearest, last_dpt)
        first_dpt = max(far_dpt - PAST_LAST_FOCUS_DPT, 0.0)
        fine = np.arange(first_dpt, last_dpt, FINE_STEP_DPT)
        even = np.union1d(np.linspace(0.0, np.ceil(nearest), STEP_COUNT), fine)
    return np.union1d(even, peaks_dpt[(peaks_dpt > 0.0) & (peaks_dpt < nearest)])


def through_focus_log_mar(
    study: EyeStudy,
    pupil_diameter_mm: float,
    object_dpt: NDArray[np.float64],
    *,
    is_accommodating: bool = False,
) -> NDArray[np.float64]:
    """Return the acuity (n,) of an eye focused far, logMAR, at distances (n,).

    If ``is_accommodating`` is set, the eye accommodates for each distance.
    """
    wavefronts = (
        study.wavefront(
            pupil_diameter_mm, object_dpt=d, focus_dpt=d if is_accommodating else 0.0
        )
        for d in object_dpt.tolist()
    )
    return np.array([*map(acuity_log_mar, wavefronts)])


def accommodated_log_mar(
    study: EyeStudy,
    pupil_diameter_mm: float,
    object_dpt: NDArray[np.float64],
    far_log_mar: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the acuity (n,) of an eye that accommodates for each distance, logMAR.

    Within the accommodation range acuity changes slowly: it is computed at three
    distances and interpolated.

    Parameters
    ----------
    far_log_mar : (n,)
        Acuity of the same eye focused far, which applies beyond its far point.
    """
    pupil_mm = study.optics.usable_pupil_mm(pupil_diameter_mm)
    far_dpt, near_dpt = study.optics.focus_limits_dpt(pupil_mm)
    if near_dpt - far_dpt < MIN_ACCOMMODATION_DPT:
        return far_log_mar.copy()

    predict = partial(through_focus_log_mar, study, pupil_mm, is_accommodating=True)
    found = far_log_mar.copy()
    is_near = object_dpt > near_dpt
    found[is_near] = predict(object_dpt[is_near])
    within = object_dpt[(object_dpt >= max(far_dpt, 0.0)) & ~is_near]
    if within.size:
        sampled_dpt = np.unique(np.linspace(within[0], within[-1], ACCOMMODATED_COUNT))
        found[np.isin(object_dpt, within)] = np.interp(
            within, sampled_dpt, predict(sampled_dpt)
        )
    return found


def profile_of(profile: Profile) -> EyeProfile:
    """Return a profile from any form: parsed, a mapping, a preset's name or a file.

    Raises
    ------
    ValueError
        If the profile is invalid; the message names field, value and allowed range.
    """
    if isinstance(profile, EyeProfile):
        return profile
    if isinstance(profile, Mapping):
        return parse_profile(profile)
    return load_profile(profile)


@dataclass(frozen=True)
class EyeStudy:
    """One eye: its profile, the estimated eye model, and its optics on the axis.

    Attributes
    ----------
    profile : EyeProfile
        Profile as given.
    found : EyeModel
    optics : EyeOptics
        Optics on the axis, at 555 nm, in all states of focus.
    notes : tuple of str
        Sentences on what was measured and what is assumed.
    """

    profile: EyeProfile
    found: EyeModel
    optics: EyeOptics
    notes: tuple[str, ...]

    @classmethod
    def of(cls, profile: Profile, *, progress: ProgressCallback | None = None) -> Self:
        """Estimate and trace an eye.

        Parameters
        ----------
        progress : callable, optional
            Called with a fraction and a stage.

        Raises
        ------
        ValueError
            If the profile is invalid, or no light passes through the eye.
        """
        parsed = profile_of(profile)
        optics, notes = prepare_eye(
            parsed,
            pupil_diameters_mm=PUPILS_MM,
            focus_range_dpt=FOCUS_RANGE_DPT,
            wavelengths_nm=(WAVELENGTH_NM,),
            progress=progress,
        )
        return cls(parsed, eye_model(parsed), optics, notes)

    @cached_property
    def is_example(self) -> bool:
        """Return whether the eye is a preset, not the measurement of a person."""
        if self.profile.name not in preset_names():
            return False
        preset = load_profile(self.profile.name)
        measured = zip(self.profile.measurements, preset.measurements, strict=False)
        return self.profile.kind == preset.kind and all(
            np.array_equal(mine.zernike_um, its.zernike_um) for mine, its in measured
        )

    @property
    def source_label(self) -> str:
        """Return the source of the wavefront: entered, measured, example or computed.

        After surgery it is computed.
        """
        if self.profile.surgery is not None:
            return "computed"
        if self.profile.kind in ("prescription", "eye"):
            return "entered"
        return "example" if self.is_example else "measured"

    @property
    def has_assumed_aberrations(self) -> bool:
        """Return whether the higher orders are typical ones, not this person's."""
        profile = self.profile
        return profile.kind == "prescription" and profile.higher_order == "typical"

    @property
    def assumed_suffix(self) -> str:
        """Return the suffix for titles of figures with assumed higher orders."""
        return ", assumed" if self.has_assumed_aberrations else ""

    @property
    def is_field_assumed(self) -> bool:
        """Return whether all off-axis wavefronts come from the population."""
        profile = self.profile
        measured = any(not m.is_on_axis for m in profile.measurements)
        return profile.periphery == "people" and not measured

    @cached_property
    def measured_um(self) -> NDArray[np.float64]:
        """Return the measured wavefront (28,), at the cornea, without correction.

        It is given on the circle of ``found.zernike_radius_mm``.  For a prescription it
        includes the added typical aberrations; for a given eye it is the eye's own.
        """
        return self.found.zernike_um - self.found.residual_um

    def wavefront(
        self,
        pupil_diameter_mm: float,
        *,
        object_dpt: float = 0.0,
        focus_dpt: float = 0.0,
    ) -> PupilWavefront:
        """Return the wavefront of a point in the pupil, through the correction.

        Parameters
        ----------
        object_dpt : float
            Distance of the point, dpt.
        focus_dpt : float
            Distance that the eye accommodates for, as well as it can.
        """
        pupil_mm = self.optics.usable_pupil_mm(pupil_diameter_mm)
        used_dpt = self.optics.accommodation_dpt(focus_dpt, pupil_diameter_mm=pupil_mm)
        state = {
            "pupil_diameter_mm": pupil_mm,
            "accommodation_dpt": used_dpt,
            "wavelength_nm": WAVELENGTH_NM,
        }
        total_dpt = self.optics.total_defocus_dpt(**state, object_dpt=object_dpt)
        seen = self.optics.wavefronts(
            h_deg=0.0, v_deg=0.0, **state, total_defocus_dpt=total_dpt
        )
        return PupilWavefront(
            zernike_um=seen.zernike_um[0],
            circle_diameter_mm=float(seen.circle_diameter_mm[0]),
            pupil_ellipse=seen.pupil_ellipse[0],
            wavelength_nm=WAVELENGTH_NM,
            rings=self._rings(float(seen.circle_diameter_mm[0])),
        )

    def far(self, pupil_diameter_mm: float) -> PupilWavefront:
        """Return the wavefront of a far point, cached with its best correction."""
        if pupil_diameter_mm not in self._far:
            self._far[pupil_diameter_mm] = self.wavefront(pupil_diameter_mm)
        return self._far[pupil_diameter_mm]

    @cached_property
    def _far(self) -> dict[float, PupilWavefront]:
        return {}

    def _rings(self, circle_diameter_mm: float) -> Rings | None:
        """Return the lens's rings in front of a pupil; None if there are none."""
        if self.optics.rings is None:
            return None
        rings = self.optics.rings.seen_from(0.0, 0.0)
        return None if rings.is_clear(circle_diameter_mm / 2.0) else rings

    def acuity(self, pupil_diameter_mm: float) -> AcuityByDistance:
        """Return the acuity by distance through a pupil, cached because it is slow."""
        if pupil_diameter_mm not in self._acuity:
            at_dpt = distances_dpt(self, pupil_diameter_mm)
            far = through_focus_log_mar(self, pupil_diameter_mm, at_dpt)
            near = accommodated_log_mar(self, pupil_diameter_mm, at_dpt, far)
            self._acuity[pupil_diameter_mm] = AcuityByDistance(at_dpt, far, near)
        return self._acuity[pupil_diameter_mm]

    @cached_property
    def _acuity(self) -> dict[float, AcuityByDistance]:
        return {}

    @cached_property
    def field(self) -> FieldTable:
        """Return the relaxed eye over 60 x 40 deg, through the correction."""
        across, up = np.meshgrid(FIELD_H_DEG, FIELD_V_DEG)
        return field_table(
            self.profile,
            h_deg=across.ravel(),
            v_deg=up.ravel(),
            pupil_diameter_mm=self.optics.usable_pupil_mm(FIELD_PUPIL_MM),
            wavelength_nm=WAVELENGTH_NM,
        )

    @cached_property
    def far_accommodation_dpt(self) -> float:
        """Return the change of M through 4 mm from relaxed to far focus, dpt."""
        pupil_mm = self.optics.usable_pupil_mm(FIELD_PUPIL_MM)
        used_dpt = self.optics.accommodation_dpt(0.0, pupil_diameter_mm=pupil_mm)
        relaxed_dpt, seen_dpt = self.optics.total_defocus_dpt(
            pupil_diameter_mm=pupil_mm,
            accommodation_dpt=np.array([0.0, used_dpt]),
            wavelength_nm=WAVELENGTH_NM,
        ).tolist()
        return relaxed_dpt - seen_dpt
