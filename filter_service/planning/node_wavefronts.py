"""Wavefronts of field nodes in one state of an eye, evaluated once; slopes.

Nodes of a group differ by defocus alone, so each group and channel needs one wavefront.
Evaluating the eye for each batch of PSFs instead took 12 ms per batch of any size.

The landing point of a ray is the slope of its wavefront.  The difference of two PSFs is
the distance between their rays from the same points of the pupil.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.optics.zernike import exponents, wavefront_polynomial
from estimator.psf.pupil import PupilFrames, pupil_frames
from estimator.psf.screens import ScreenTables
from estimator.psf.stiles_crawford import StilesCrawford
from estimator.psf.survey import PupilSurvey, survey_pupils
from estimator.wavefront.field_wavefronts import FieldWavefronts, with_tilt
from filter_service.constants import RGB
from filter_service.planning.grid import GREEN, GridSpec


@dataclass(frozen=True)
class PupilStates:
    """Directions, states, wavelengths and defocus of wavefronts, as arrays (P,)."""

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    pupil_diameter_mm: NDArray[np.float64]
    accommodation_dpt: NDArray[np.float64]
    wavelength_nm: NDArray[np.float64]
    total_defocus_dpt: NDArray[np.float64]

    @classmethod
    def of(cls, **values: ArrayLike) -> PupilStates:
        """Broadcast the fields against each other, in C order."""
        arrays = np.broadcast_arrays(*(np.asarray(v, float) for v in values.values()))
        return cls(**dict(zip(values, (a.ravel() for a in arrays), strict=True)))

    def select(self, index: NDArray[np.int64] | slice) -> PupilStates:
        """Return the states at the given indices."""
        return PupilStates(**{name: v[index] for name, v in vars(self).items()})


WavefrontsOf = Callable[..., FieldWavefronts]
"""See `EyeOptics.wavefronts_at`."""


@dataclass(frozen=True)
class NodeWavefronts:
    """Wavefronts of groups, by channel and wavelength of the channel.

    Attributes
    ----------
    zernike_um : (n_groups, 3, n_primaries, n_terms)
        Coefficients at a total defocus of 0 dpt in the middle of the channel.
    per_dpt_um : (n_groups, 3, n_primaries, n_terms)
        Change per diopter.
    circle_diameter_mm : (n_groups, 3, n_primaries)
    pupil_ellipse : (n_groups, 3, n_primaries, 5)
    wavelength_nm : (3, n_primaries)
    pixel_from_mrad : (n_groups, 2, 2)
        Pixel scale of the stored kernels.
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
    def of(
        cls,
        eye: EyeOptics,
        spec: GridSpec,
        groups: PupilStates,
        wavefronts_of: WavefrontsOf | None = None,
    ) -> NodeWavefronts:
        """Evaluate an eye's wavefronts at groups (n_groups,) of one state.

        Parameters
        ----------
        wavefronts_of : callable, optional
            Result of `node_evaluator`, to share it between states.
        """
        wavefronts_of = wavefronts_of or node_evaluator(
            eye, spec, groups.h_deg, groups.v_deg
        )
        states = channel_states(spec, groups)
        n_primaries = len(spec.primary_wavelengths_nm)
        if n_primaries > 1:
            states = primary_states(eye, spec, states)
        shape = (groups.h_deg.size, RGB, n_primaries)
        count = states.h_deg.size
        found = wavefronts_of(
            pupil_diameter_mm=float(groups.pupil_diameter_mm[0]),
            accommodation_dpt=float(groups.accommodation_dpt[0]),
            total_defocus_dpt=states.total_defocus_dpt + np.array([[0.0], [1.0]]),
        )
        zernike_um = found.zernike_um[:count]
        per_dpt_um = found.zernike_um[count:] - zernike_um
        return cls(
            zernike_um=zernike_um.reshape(*shape, zernike_um.shape[-1]),
            per_dpt_um=per_dpt_um.reshape(*shape, per_dpt_um.shape[-1]),
            circle_diameter_mm=found.circle_diameter_mm[:count].reshape(shape),
            pupil_ellipse=found.pupil_ellipse[:count].reshape(*shape, -1),
            wavelength_nm=spec.primary_wavelengths_nm.T.copy(),
            pixel_from_mrad=np.ascontiguousarray(
                spec.node_pixel_from_mrad(groups.h_deg, groups.v_deg)
            ),
            h_deg=groups.h_deg,
            v_deg=groups.v_deg,
        )

    @classmethod
    def joined(cls, several: Sequence[NodeWavefronts]) -> NodeWavefronts:
        """Concatenate groups of one eye."""
        if len(several) == 1:
            return several[0]
        names = {field.name for field in fields(cls)} - {"wavelength_nm"}
        return replace(
            several[0],
            **{
                name: np.concatenate([getattr(one, name) for one in several])
                for name in names
            },
        )

    def scaled(self, ratio: NDArray[np.float64]) -> NodeWavefronts:
        """Return the wavefronts scaled by a ratio (n_groups,)."""
        each = ratio[:, None, None, None]
        return replace(
            self, zernike_um=each * self.zernike_um, per_dpt_um=each * self.per_dpt_um
        )

    def with_lateral_color(
        self, eye: EyeOptics, spec: GridSpec, groups: PupilStates
    ) -> NodeWavefronts:
        """Return wavefronts with the tilt of each color relative to green."""
        n_primaries = self.wavelength_nm.shape[1]
        states = channel_states(spec, groups)
        if n_primaries > 1:
            states = primary_states(eye, spec, states)
        tilted_um = with_tilt(
            self.zernike_um.reshape(states.h_deg.size, -1),
            self.circle_diameter_mm.ravel() / 2.0,
            lateral_shift_mrad(eye, spec, states),
        )
        return replace(self, zernike_um=tilted_um.reshape(self.zernike_um.shape))

    def at(
        self,
        groups: NDArray[np.int64],
        channels: NDArray[np.int64],
        total_defocus_dpt: NDArray[np.float64],
        *,
        primaries: int | None = None,
    ) -> FieldWavefronts:
        """Return wavefronts (n n_primaries,) of PSFs (n,), grouped by PSF.

        Parameters
        ----------
        primaries : int, optional
            Number of wavelengths per channel; all by default.
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


def node_evaluator(
    eye: EyeOptics, spec: GridSpec, h_deg: NDArray[Any], v_deg: NDArray[Any]
) -> WavefrontsOf:
    """Return a function that evaluates the wavefronts of field nodes (n,) in a state.

    Its result is ordered by node, channel and wavelength.
    """
    per_node = spec.primary_wavelengths_nm.size
    return eye.wavefronts_at(
        h_deg=np.repeat(h_deg, per_node),
        v_deg=np.repeat(v_deg, per_node),
        wavelength_nm=np.tile(spec.primary_wavelengths_nm.T.ravel(), h_deg.size),
    )


def channel_states(spec: GridSpec, groups: PupilStates) -> PupilStates:
    """Return the states (3 n_groups,) of the channels, ordered by group."""
    states = groups.select(np.repeat(np.arange(groups.h_deg.size), RGB))
    wavelength_nm = np.tile(spec.channel_wavelengths_nm, groups.h_deg.size)
    return replace(states, wavelength_nm=wavelength_nm)


def primary_states(eye: EyeOptics, spec: GridSpec, states: PupilStates) -> PupilStates:
    """Return the states (n P,) at the n wavelengths of each state's primary.

    The states of a primary are adjacent and differ in total defocus by the chromatic
    difference of the eye.
    """
    primaries_nm = spec.primary_wavelengths_nm
    away_nm = np.abs(spec.channel_wavelengths_nm - states.wavelength_nm[:, None])
    wavelength_nm = primaries_nm[:, away_nm.argmin(axis=1)].T.ravel()
    every = np.repeat(np.arange(away_nm.shape[0]), len(primaries_nm))
    found = replace(states.select(every), wavelength_nm=wavelength_nm)
    location = {n: c for n, c in vars(found).items() if n != "total_defocus_dpt"}
    middle_nm = states.wavelength_nm[every]
    shift_dpt = eye.total_defocus_dpt(**location) - eye.total_defocus_dpt(
        **(location | {"wavelength_nm": middle_nm})
    )
    return replace(found, total_defocus_dpt=found.total_defocus_dpt + shift_dpt)


def lateral_shift_mrad(
    eye: EyeOptics, spec: GridSpec, states: PupilStates
) -> NDArray[np.float64]:
    """Return the shifts (P, 2) of PSFs along the pupil axes, relative to green."""
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


N_RINGS, N_AZIMUTHS = 5, 16


def apodization(eye: EyeOptics, spec: GridSpec) -> StilesCrawford | None:
    """Return the Stiles-Crawford weights of an eye's pupil, or None if disabled."""
    if not spec.settings.stiles_crawford:
        return None
    return StilesCrawford.of_eye(eye.eye_side)


def state_frames(
    eye: EyeOptics,
    spec: GridSpec,
    states: PupilStates,
    *,
    pixel_from_mrad: NDArray[Any] | None = None,
) -> PupilFrames:
    """Return pupils and wavefronts of states (P,), in pixel coordinates.

    Parameters
    ----------
    pixel_from_mrad : (P, 2, 2), optional
        Pixel scale; by default the scale of the stored kernels of these states.
    """
    if pixel_from_mrad is None:
        pixel_from_mrad = spec.node_pixel_from_mrad(states.h_deg, states.v_deg)
    found = eye.wavefronts(**vars(states))
    weighed = apodization(eye, spec)
    return pupil_frames(
        wavefront_polynomial(found.zernike_um),
        circle_radius_mm=found.circle_diameter_mm / 2.0,
        wavelength_nm=states.wavelength_nm,
        pixel_from_mrad=pixel_from_mrad,
        pupil_ellipse=found.pupil_ellipse,
        apodization=(
            None if weighed is None else weighed.amplitude(states.wavelength_nm)
        ),
    )


def state_survey(eye: EyeOptics, spec: GridSpec, states: PupilStates) -> PupilSurvey:
    """Return the slopes of states (P,) and the extent of their light, with rings."""
    survey = survey_pupils(state_frames(eye, spec, states))
    if eye.rings is None:
        return survey
    return survey.with_screen(
        ScreenTables.from_screen(
            eye.rings.seen_from(states.h_deg, states.v_deg),
            pixel_from_mrad=spec.node_pixel_from_mrad(states.h_deg, states.v_deg),
            pupil_ellipse=eye.wavefronts(**vars(states)).pupil_ellipse,
            wavelength_nm=states.wavelength_nm,
        )
    )


LEAST_LIGHT = 0.02
"""Smallest share of light of a focus in planning; smaller shares are raised to it."""


def main_foci_dpt(eye: EyeOptics, spec: GridSpec) -> NDArray[np.float64]:
    """Return the total defocus (n,) of every focus of all channels."""
    if eye.rings is None:
        return np.zeros(1)
    channels_nm = np.unique(spec.channel_wavelengths_nm).tolist()
    return np.concatenate([eye.rings.main_dpt(nm) for nm in channels_nm])


def main_light_ratio(
    eye: EyeOptics, spec: GridSpec, radius_mm: NDArray[Any]
) -> NDArray[np.float64]:
    """Return each focus's share (n, P) of its channel's light, in pupils (P,)."""
    if eye.rings is None:
        return np.ones((1, radius_mm.size))
    channels_nm = np.unique(spec.channel_wavelengths_nm).tolist()
    ratios = [eye.rings.main_light_ratio(radius_mm, nm) for nm in channels_nm]
    return np.maximum(np.concatenate(ratios), LEAST_LIGHT)


def _sample_points() -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return weights (n,) and positions x and y (n,) over the unit disc."""
    node, weight = np.polynomial.legendre.leggauss(N_RINGS)
    radius = np.sqrt((node + 1.0) / 2.0)[:, None]
    # Each ring is rotated by its own angle, so that rings do not line up.
    turn = np.arange(N_RINGS)[:, None] / N_RINGS
    angle = 2.0 * np.pi * (np.arange(N_AZIMUTHS) + turn) / N_AZIMUTHS
    return (
        np.repeat(weight / 2.0, N_AZIMUTHS) / N_AZIMUTHS,
        (radius * np.cos(angle)).ravel(),
        (radius * np.sin(angle)).ravel(),
    )


WEIGHTS, _X, _Y = _sample_points()
"""Shares (n,) of the pupil that its sample points represent.

The planner uses the same weights with the Stiles-Crawford effect, which reduces the
light of the points that move most.  Blended PSFs then measured 0.2 to 0.8 dB better
than without the effect (three presets).
"""


@cache
def _monomial_slopes(n_terms: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the slopes (n_terms, n) of every monomial at the sample points."""
    a, b = np.split(exponents(n_terms), 2, axis=1)
    return (
        a * _X ** np.maximum(a - 1, 0) * _Y**b,
        b * _X**a * _Y ** np.maximum(b - 1, 0),
    )


def slopes_px(frames: PupilFrames) -> NDArray[np.float64]:
    """Return slopes (P, n, 2), px, x right, y up, at the same points of each pupil."""
    slope_x, slope_y = _monomial_slopes(frames.disc_polynomial_um.shape[1])
    along_x = frames.disc_polynomial_um @ slope_x
    along_y = frames.disc_polynomial_um @ slope_y
    shear = frames.shear_ratio[:, None]
    scale = np.sqrt(1.0 - shear * shear)
    half = frames.half_width_um_per_px
    return np.stack(
        [
            (along_x - shear / scale * along_y) / half[:, :1],
            along_y / scale / half[:, 1:],
        ],
        axis=-1,
    )
