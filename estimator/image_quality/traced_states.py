"""Wavefronts of an eye in a grid of states, each traced once."""

from __future__ import annotations

from dataclasses import fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.corrections.worn_lens import rings_of
from estimator.estimate.model import EyeModel, eye_model
from estimator.field.field_table import traced_directions
from estimator.field.traced_eye import TracedEye
from estimator.image_quality.pupil_light import PupilLight
from estimator.image_quality.states import StateGrid
from estimator.profiles.parse import EyeProfile
from estimator.wavefront.field_wavefronts import FieldWavefronts

MAX_KEPT_EYES = 256
"""Traced states that are kept: an eye takes 0.1 MB."""


class StateTracer:
    """Wavefronts of one eye; the states that were traced last are kept.

    Attributes
    ----------
    profile : EyeProfile
    rings : Rings or None
        Lens with several foci, or lenslets.
    """

    def __init__(self, profile: EyeProfile):
        self.profile = profile
        self.rings = rings_of(profile.correction)
        self._kept: dict[Any, tuple[TracedEye, tuple[str, ...]]] = {}

    @cached_property
    def model(self) -> EyeModel:
        """The eye that is traced."""
        return eye_model(self.profile)

    @property
    def entrance_pupil_mm(self) -> float:
        """Depth of the entrance pupil behind the cornea."""
        return self.model.accommodating.entrance_pupil_mm

    def lights(self, grid: StateGrid) -> tuple[list[PupilLight], tuple[str, ...]]:
        """Return the light of each state, and notes."""
        waves, notes = self.wavefronts(grid)
        lights = [
            PupilLight(
                zernike_um=waves.zernike_um[k],
                zernike_radius_mm=float(waves.circle_diameter_mm[k]) / 2.0,
                pupil_ellipse=waves.pupil_ellipse[k],
                wavelength_nm=float(grid.flat["wavelength_nm"][k]),
                rings=self.rings
                and self.rings.seen_from(
                    float(grid.flat["h_deg"][k]), float(grid.flat["v_deg"][k])
                ),
            )
            for k in range(grid.count)
        ]
        return lights, notes

    def wavefronts(self, grid: StateGrid) -> tuple[FieldWavefronts, tuple[str, ...]]:
        """Return the wavefronts (n,) of states (n,) in the entrance pupil, and notes.

        States with the same pupil, focus and wavelength are traced together.
        """
        flat = grid.flat
        focus_dpt = np.nan_to_num(flat["focus_dpt"], nan=-np.inf)
        traced = np.stack(
            [flat["pupil_diameter_mm"], focus_dpt, flat["wavelength_nm"]], axis=1
        )
        object_dpt = flat.get("object_dpt", np.zeros(grid.count))
        parts: list[tuple[NDArray[np.int64], FieldWavefronts]] = []
        notes: dict[str, None] = {}
        distinct, number = np.unique(traced, axis=0, return_inverse=True)
        for k, (pupil_mm, focus, nm) in enumerate(distinct.tolist()):
            states = np.flatnonzero(number.ravel() == k)
            h_deg, v_deg = flat["h_deg"][states], flat["v_deg"][states]
            eye, own_notes = self._traced(h_deg, v_deg, pupil_mm, focus, nm)
            notes |= dict.fromkeys(own_notes)
            state: dict[str, Any] = {
                "h_deg": h_deg,
                "v_deg": v_deg,
                "pupil_diameter_mm": pupil_mm,
                "accommodation_dpt": eye.grid.accommodations_dpt[0],
                "wavelength_nm": nm,
            }
            total_dpt = eye.total_defocus_dpt(**state, object_dpt=object_dpt[states])
            found = eye.wavefronts(**state, total_defocus_dpt=total_dpt)
            parts.append((states, found))
        order = np.argsort(np.concatenate([states for states, _ in parts]))
        joined = [
            np.concatenate([getattr(found, f.name) for _, found in parts])[order]
            for f in fields(FieldWavefronts)
        ]
        return FieldWavefronts(*joined), tuple(notes)

    def _traced(
        self,
        h_deg: NDArray[np.float64],
        v_deg: NDArray[np.float64],
        pupil_diameter_mm: float,
        focus_dpt: float,
        wavelength_nm: float,
    ) -> tuple[TracedEye, tuple[str, ...]]:
        """Return the eye in one state of focus, traced in directions, and notes."""
        h_deg, v_deg = np.unique(np.stack([h_deg, v_deg]), axis=1)
        state = pupil_diameter_mm, focus_dpt, wavelength_nm
        key = *state, h_deg.tobytes(), v_deg.tobytes()
        if key not in self._kept:
            eye, notes = traced_directions(
                self.profile,
                h_deg=h_deg,
                v_deg=v_deg,
                pupil_diameter_mm=pupil_diameter_mm,
                wavelength_nm=wavelength_nm,
                focus_dpt=None if np.isinf(focus_dpt) else focus_dpt,
                model=self.model,
            )
            if any(getattr(note, "code", "") == "directions_outside" for note in notes):
                raise ValueError(f"{self.profile.name}: {notes[-1]}")
            if len(self._kept) >= MAX_KEPT_EYES:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = eye, notes
        return self._kept[key]
