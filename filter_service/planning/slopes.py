"""Slopes of wavefronts over their pupils, in pixels, as geometric models of PSFs.

The landing point of a ray is the slope of its wavefront.  The difference of two PSFs is
the distance between their rays from the same points of the pupil.
"""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.optics.zernike import exponents, wavefront_polynomial
from estimator.psf.pupil import PupilFrames, pupil_frames
from estimator.psf.screens import ScreenTables
from estimator.psf.stiles_crawford import StilesCrawford
from estimator.psf.survey import PupilSurvey, survey_pupils
from filter_service.planning.grid import GridSpec
from filter_service.planning.node_wavefronts import PupilStates

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
        Pixel scale; by default that of the stored kernels of these states.
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
