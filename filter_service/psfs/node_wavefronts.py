"""The wavefronts of a plan's nodes, evaluated once for all PSFs.

Nodes of a group differ by defocus alone, so each group and channel has one wavefront.
Evaluating the eye for each batch of PSFs took 12 ms a batch, however small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.wavefront.field_wavefronts import FieldWavefronts, with_tilt
from filter_service.constants import RGB
from filter_service.planning.grid import GREEN, GridSpec
from filter_service.planning.nodes import CachePlan
from filter_service.planning.slopes import PupilStates
from filter_service.psfs.wide_primaries import states_of_primaries


@dataclass(frozen=True)
class NodeWavefronts:
    """Wavefronts of groups, channels and the wavelengths of each channel.

    Attributes
    ----------
    zernike_um : (n_groups, 3, n_primaries, 28)
        At a total defocus of 0 dpt in the middle of the channel, made flatter by the
        plan's ``shrink_ratio``.
    per_dpt_um : (n_groups, 3, n_primaries, 28)
        What a dioptre adds.
    circle_diameter_mm : (n_groups, 3, n_primaries)
    pupil_ellipse : (n_groups, 3, n_primaries, 5)
    wavelength_nm : (3, n_primaries)
    pixel_from_mrad : (n_groups, 2, 2)
        Scale of the pixels that kernels are stored in.
    h_deg, v_deg : (n_groups,)
    """

    zernike_um: NDArray[np.float64]
    per_dpt_um: NDArray[np.float64]
    circle_diameter_mm: NDArray[np.float64]
    pupil_ellipse: NDArray[np.float64]
    wavelength_nm: NDArray[np.float64]
    pixel_from_mrad: NDArray[np.float64]
    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]

    @classmethod
    def of(cls, eye: EyeOptics, spec: GridSpec, plan: CachePlan) -> NodeWavefronts:
        """Evaluate an eye's wavefronts at the groups of a plan."""
        states = PupilStates.of(
            h_deg=plan.h_deg[:, None, None, None],
            v_deg=plan.v_deg[:, None, None, None, None],
            pupil_diameter_mm=plan.pupils_mm[:, None, None],
            accommodation_dpt=plan.accommodations_dpt[:, None],
            wavelength_nm=spec.channel_wavelengths_nm,
            total_defocus_dpt=0.0,
        )
        n_primaries = len(spec.primary_wavelengths_nm)
        if n_primaries > 1:
            states = states_of_primaries(eye, spec, states)
        shape = (states.h_deg.size // (RGB * n_primaries), RGB, n_primaries)
        count = states.h_deg.size
        columns = vars(states.taken(np.tile(np.arange(count), 2)))
        columns["total_defocus_dpt"][count:] += 1.0
        found = eye.wavefronts(**columns)  # in one call each wavefront is found once
        zernike_um = found.zernike_um[:count]
        per_dpt_um = found.zernike_um[count:] - zernike_um
        if plan.shrink_ratio is not None:
            each = np.repeat(plan.shrink_ratio, RGB * n_primaries)[:, None]
            zernike_um, per_dpt_um = each * zernike_um, each * per_dpt_um
        if spec.settings.lateral_color and spec.settings.chromatic:
            shift_mrad = lateral_shift_mrad(eye, spec, states)
            radius_mm = found.circle_diameter_mm[:count] / 2.0
            zernike_um = with_tilt(zernike_um, radius_mm, shift_mrad)
        h_deg, v_deg = (
            angle.reshape(shape)[:, 0, 0] for angle in (states.h_deg, states.v_deg)
        )
        return cls(
            zernike_um=zernike_um.reshape(*shape, zernike_um.shape[-1]),
            per_dpt_um=per_dpt_um.reshape(*shape, per_dpt_um.shape[-1]),
            circle_diameter_mm=found.circle_diameter_mm[:count].reshape(shape),
            pupil_ellipse=found.pupil_ellipse[:count].reshape(*shape, -1),
            wavelength_nm=spec.primary_wavelengths_nm.T.copy(),
            pixel_from_mrad=_node_scale(spec, h_deg, v_deg),
            h_deg=h_deg,
            v_deg=v_deg,
        )

    def at(
        self,
        groups: NDArray[np.int64],
        channels: NDArray[np.int64],
        total_defocus_dpt: NDArray[np.float64],
        *,
        primaries: int | None = None,
    ) -> FieldWavefronts:
        """Wavefronts (n n_primaries,) of PSFs (n,), those of a channel in turn.

        Parameters
        ----------
        primaries : int, optional
            Only so many of each channel.
        """
        own = (groups, channels, slice(primaries))
        zernike_um = self.zernike_um[own] + (
            total_defocus_dpt[:, None, None] * self.per_dpt_um[own]
        )
        return FieldWavefronts(
            zernike_um=zernike_um.reshape(-1, zernike_um.shape[-1]),
            circle_diameter_mm=self.circle_diameter_mm[own].ravel(),
            pupil_ellipse=self.pupil_ellipse[own].reshape(-1, 5),
        )


def _node_scale(
    spec: GridSpec, h_deg: NDArray[np.float64], v_deg: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Scales (n, 2, 2) at directions (n,), each distinct one evaluated once."""
    both = np.stack([h_deg, v_deg], axis=-1)
    few, number = np.unique(both, axis=0, return_inverse=True)
    return spec.node_pixel_from_mrad(few[:, 0], few[:, 1])[number.ravel()]


def lateral_shift_mrad(
    eye: EyeOptics, spec: GridSpec, states: PupilStates
) -> NDArray[np.float64]:
    """Shifts (P, 2) of PSFs along the pupil axes, against green's."""
    place = {
        "h_deg": states.h_deg,
        "v_deg": states.v_deg,
        "accommodation_dpt": states.accommodation_dpt,
    }
    own, green = (
        eye.chief_ray_shift_mrad(**place, wavelength_nm=wavelength_nm)
        for wavelength_nm in (states.wavelength_nm, spec.wavelengths_nm[GREEN])
    )
    return own - green
