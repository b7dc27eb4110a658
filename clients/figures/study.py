"""One eye prepared for its figures: estimated and traced once, evaluated often."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from clients.figures.acuity import AcuityByDistance, acuity_by_distance
from clients.figures.pupil_wavefront import PupilWavefront
from estimator import (
    EyeModel,
    EyeOptics,
    EyeProfile,
    FieldTable,
    Lenslets,
    Rings,
    eye_model,
    field_table,
    load_profile,
    parse_profile,
    prepare_eye,
    preset_names,
)

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

    @property
    def name(self) -> str:
        """Return the profile's name."""
        return self.profile.name

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
        """Return the source of the wavefront: entered, measured or example."""
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
        """Return whether all off-axis wavefronts are those of the population."""
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
        total_dpt = self.optics.total_defocus_dpt(**state)
        total_dpt = total_dpt + self.optics.vergence.vergence_dpt(object_dpt)
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
        if not isinstance(rings, Lenslets):
            return rings
        clear_mm = rings.inner_mm - rings.diameter_mm / 2.0
        reach_mm = np.hypot(*np.asarray(rings.centre_mm)) + circle_diameter_mm / 2.0
        return None if reach_mm <= clear_mm else rings

    def acuity(self, pupil_diameter_mm: float) -> AcuityByDistance:
        """Return the acuity by distance through a pupil, cached because it is slow."""
        if pupil_diameter_mm not in self._acuity:
            found = acuity_by_distance(self, pupil_diameter_mm)
            self._acuity[pupil_diameter_mm] = found
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
