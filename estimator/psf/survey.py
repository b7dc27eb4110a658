"""Wavefront slopes and kernel radii, computed before the PSFs.

The slopes determine method, sampling and kernel size.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import core
from estimator.psf.compiled import compiled_psfs
from estimator.psf.pupil import PupilFrames
from estimator.psf.screens import ScreenTables
from estimator.psf.tables import N_EDGE, N_RING, PASSED_POWERS, RING_WEIGHTS

RADIUS_LIMIT_PX = 1 << 14

PIXEL_CORNER_PX = 0.21
"""Addition to a blur radius, so that the disc contains the corners of its pixels."""


@dataclass(frozen=True)
class PupilSurvey:
    """Slopes of P wavefronts over their pupils, in pixels (x right, y up).

    Attributes
    ----------
    frames : PupilFrames
    slope_low_px, slope_high_px : (P, 2)
        Bounding box (x, y) of the slopes.
    edge_slope_px : (P, N_EDGE, 2)
        Slopes along the edge of the pupil, counterclockwise from +x of the unit disc.
    edge_normal_px_per_um : (P, N_EDGE, 2)
        Outward normals of the edge in t, the gradients of the unit disc's radius.
    blur_radius_px : (P,)
        Largest slope.
    narrow_ratio : (P,)
        RMS of the slopes along the minor principal axis of the spot, in lambda/D.
    passed_ratio : (P,)
        Transmission of the apodized pupil.
    edge_light_um : (P,)
        Wavelength times the intensity at the edge of the pupil over the mean intensity;
        diffracted light is proportional to it.
    screen : ScreenTables, optional
        Complex amplitude in the pupils.
    """

    frames: PupilFrames
    slope_low_px: NDArray[np.float64]
    slope_high_px: NDArray[np.float64]
    edge_slope_px: NDArray[np.float64]
    edge_normal_px_per_um: NDArray[np.float64]
    blur_radius_px: NDArray[np.float64]
    narrow_ratio: NDArray[np.float64]
    passed_ratio: NDArray[np.float64]
    edge_light_um: NDArray[np.float64]
    screen: ScreenTables | None = None

    def with_screen(self, screen: ScreenTables) -> "PupilSurvey":
        """Return the survey with a screen, whose deflection is added to the slopes."""
        return replace(
            self,
            slope_low_px=self.slope_low_px - screen.reach_px,
            slope_high_px=self.slope_high_px + screen.reach_px,
            blur_radius_px=self.blur_radius_px + screen.reach_px.max(axis=1),
            screen=screen,
        )

    @property
    def extent_px(self) -> NDArray[np.float64]:
        """Sides of the bounding box of the slopes, (P, 2)."""
        return self.slope_high_px - self.slope_low_px

    @property
    def unit_px(self) -> NDArray[np.float64]:
        """Lambda / D along the image's axes, (P, 2)."""
        wavelength_um = self.frames.wavelength_nm[:, None] / 1000.0
        return wavelength_um / (2.0 * self.frames.half_width_um_per_px)


def _disc_log_amplitude(frames: PupilFrames) -> NDArray[np.float64]:
    """Return the apodization (P, 6) over the unit disc."""
    one, x, y, xx, xy, yy = frames.log_amplitude.T
    r = frames.shear_ratio
    s = np.sqrt(1.0 - r * r)
    columns = one, x + r * y, s * y, xx + r * xy + r * r * yy, s * xy + 2 * r * s * yy
    return np.stack([*columns, s * s * yy], axis=1)


def _passed_light(frames: PupilFrames) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the mean intensity (P,) over the apodized pupils, and over their edges."""
    count = frames.shear_ratio.size
    if not frames.log_amplitude.any():
        return np.ones(count), np.ones(count)
    intensity = np.exp(2.0 * _disc_log_amplitude(frames) @ PASSED_POWERS)
    rings = intensity.reshape(count, -1, N_RING).mean(axis=2)
    return rings[:, :-1] @ RING_WEIGHTS, rings[:, -1]


def survey_pupils(frames: PupilFrames) -> PupilSurvey:
    """Sample the slopes of P wavefronts at 193 points each."""
    count = frames.shear_ratio.size
    low, high = np.empty((count, 2)), np.empty((count, 2))
    edge, normal = np.empty((count, N_EDGE, 2)), np.empty((count, N_EDGE, 2))
    blur, narrow = np.empty(count), np.empty(count)
    wavelength_um = frames.wavelength_nm / 1000.0
    compiled_psfs().call(
        "survey_pupils",
        frames.disc_polynomial_um,
        frames.half_width_um_per_px,
        frames.shear_ratio,
        np.ascontiguousarray(wavelength_um),
        *(low, high, edge, normal, blur, narrow),
    )
    passed_ratio, on_edge_ratio = _passed_light(frames)
    return PupilSurvey(
        frames=frames,
        slope_low_px=low,
        slope_high_px=high,
        edge_slope_px=edge,
        edge_normal_px_per_um=normal,
        blur_radius_px=blur,
        narrow_ratio=narrow,
        passed_ratio=passed_ratio,
        edge_light_um=wavelength_um * on_edge_ratio / passed_ratio,
    )


def _edge_geometry(
    survey: PupilSurvey,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the arguments of the compiled loops: edge slopes, normals, strengths."""
    return survey.edge_slope_px, survey.edge_normal_px_per_um, survey.edge_light_um


def edge_light_outside(
    survey: PupilSurvey, *, radius_px: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the share (P,) of the light that the edges send outside discs.

    The formula is the same as in `needed_radius_px`.  The result is infinite if the
    geometric spot extends to the rim of the disc.

    Parameters
    ----------
    radius_px : (P,)
        Radii of the discs.
    """
    outside = np.empty(radius_px.size)
    core().call(
        "edge_lights_outside",
        radius_px.size,
        *_edge_geometry(survey),
        radius_px + 0.5,
        outside,
    )
    return np.where(radius_px + 0.5 > survey.blur_radius_px, outside, math.inf)


def needed_radius_px(
    survey: PupilSurvey, *, lost_energy_ratio: float, tail_end_px: int | None = None
) -> NDArray[np.int64]:
    """Return the smallest kernel radii (P,), px, for a given loss of light.

    Parameters
    ----------
    survey : PupilSurvey
    lost_energy_ratio : float
        Allowed share of the light outside the kernel.
    tail_end_px : int, optional
        Upper bound of the radius for PSFs all of whose rays are within it: diffracted
        light falls so slowly that a part of it is always farther out.

    Notes
    -----
    Far from the geometric spot, light comes from the edge of the pupil only.  By the
    method of stationary phase for the boundary integral, an edge element ds with slope
    s and outward normal n sends lambda / (4 pi² A d²) ds dd to p = s + d n, for d of
    either sign and the area A of the pupil; the caustic factor cancels the Jacobian.
    For W = 0 and a circle, this is the mean Airy tail, 2 lambda / (pi² D theta) outside
    theta; for defocus, it is lambda / (pi² D) [1/(theta-g) + 1/(theta+g)].
    """
    radii = np.empty(survey.blur_radius_px.size, np.int64)
    core().call(
        "needed_radii",
        radii.size,
        *_edge_geometry(survey),
        survey.blur_radius_px,
        lost_energy_ratio,
        RADIUS_LIMIT_PX,
        radii,
    )
    if tail_end_px is None:
        return radii
    is_within = np.ceil(survey.blur_radius_px + PIXEL_CORNER_PX) <= tail_end_px
    bounded: NDArray[np.int64] = np.where(
        is_within, np.minimum(radii, tail_end_px), radii
    )
    return bounded
