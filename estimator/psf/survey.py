"""Wavefront slopes and kernel radii, computed before the PSFs.

The slopes determine method, sampling and kernel size.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.optics.zernike import EXPONENTS
from estimator.psf.pupil import PupilFrames
from estimator.psf.screens import ScreenTables

N_EDGE = 48
_RING_RADII = (0.2, 0.35, 0.5, 0.65, 0.8, 0.9)
N_RING = 24
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

    @property
    def wave_number(self) -> NDArray[np.float64]:
        """Larger side of the spot in lambda/D, n = 2 g D / lambda, (P,)."""
        larger: NDArray[np.float64] = (self.extent_px / self.unit_px).max(axis=1)
        return larger


def _sample_points() -> tuple[NDArray[Any], NDArray[Any]]:
    edge = 2.0 * math.pi * np.arange(N_EDGE) / N_EDGE
    ring = 2.0 * math.pi * np.arange(N_RING) / N_RING
    x = [np.cos(edge)] + [r * np.cos(ring) for r in _RING_RADII] + [np.zeros(1)]
    y = [np.sin(edge)] + [r * np.sin(ring) for r in _RING_RADII] + [np.zeros(1)]
    return np.concatenate(x), np.concatenate(y)


def _monomial_slopes() -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return sample points (2, n) and the slopes (28, n) of every monomial there."""
    x, y = _sample_points()
    a, b = EXPONENTS[:, :1], EXPONENTS[:, 1:]
    d_x = a * x ** np.maximum(a - 1, 0) * y**b
    d_y = b * x**a * y ** np.maximum(b - 1, 0)
    return np.stack([x, y]), d_x, d_y


POINTS, *SLOPES = _monomial_slopes()


@njit(cache=True, nogil=True, fastmath=True)  # type: ignore[untyped-decorator]  # numba
def _add_scaled(
    factor: float, source: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    for i in range(out.shape[0]):
        out[i] += factor * source[i]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _survey(
    disc: NDArray[np.float64],
    half: NDArray[np.float64],
    shear: NDArray[np.float64],
    tables: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    edge: NDArray[np.float64],
    normal: NDArray[np.float64],
    blur: NDArray[np.float64],
    narrow: NDArray[np.float64],
) -> None:
    points, slope_x, slope_y = tables
    gx, gy = np.empty(points.shape[1]), np.empty(points.shape[1])
    for p in range(disc.shape[0]):
        gx[:] = 0.0
        gy[:] = 0.0
        for j in range(1, disc.shape[1]):
            if disc[p, j] != 0.0:
                _add_scaled(disc[p, j], slope_x[j], gx)
                _add_scaled(disc[p, j], slope_y[j], gy)
        r = shear[p]
        s = math.sqrt(1.0 - r * r)
        low[p] = math.inf
        high[p] = -math.inf
        largest = 0.0
        mx, my, mxx, mxy, myy = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(gx.size):
            x = (gx[i] - r / s * gy[i]) / half[p, 0]
            y = gy[i] / s / half[p, 1]
            low[p, 0], high[p, 0] = min(low[p, 0], x), max(high[p, 0], x)
            low[p, 1], high[p, 1] = min(low[p, 1], y), max(high[p, 1], y)
            largest = max(largest, x * x + y * y)
            mx, my = mx + x, my + y
            mxx, mxy, myy = mxx + x * x, mxy + x * y, myy + y * y
            if i < edge.shape[1]:
                edge[p, i, 0], edge[p, i, 1] = x, y
                nx, ny = points[0, i], points[1, i]
                normal[p, i, 0] = (nx - r / s * ny) / half[p, 0]
                normal[p, i, 1] = ny / s / half[p, 1]
        blur[p] = math.sqrt(largest)
        # Variances in units of the box's lambda/D, up to the wavelength.
        n = gx.size
        vxx = (mxx / n - (mx / n) ** 2) * half[p, 0] ** 2
        vyy = (myy / n - (my / n) ** 2) * half[p, 1] ** 2
        vxy = (mxy / n - mx / n * my / n) * half[p, 0] * half[p, 1]
        least = 0.5 * (vxx + vyy) - math.sqrt((0.5 * (vxx - vyy)) ** 2 + vxy * vxy)
        narrow[p] = math.sqrt(max(0.0, least))


_N_RADIAL = 8


def _passed_points() -> tuple[NDArray[Any], NDArray[Any]]:
    """Return powers (6, n) of points on rings of the unit disc, and ring weights (8,).

    The last ring is the edge, which has no weight.
    """
    node, weight = np.polynomial.legendre.leggauss(_N_RADIAL)
    rings = np.append(np.sqrt((node + 1.0) / 2.0), 1.0)
    angle = 2.0 * math.pi * np.arange(N_RING) / N_RING
    x, y = (np.outer(rings, f(angle)).ravel() for f in (np.cos, np.sin))
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]), weight / 2.0


PASSED_POWERS, RING_WEIGHTS = _passed_points()


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
    """Sample the slopes of P wavefronts at 193 points each, in about 3 us each."""
    count = frames.shear_ratio.size
    low, high = np.empty((count, 2)), np.empty((count, 2))
    edge, normal = np.empty((count, N_EDGE, 2)), np.empty((count, N_EDGE, 2))
    blur, narrow = np.empty(count), np.empty(count)
    _survey(
        frames.disc_polynomial_um,
        frames.half_width_um_per_px,
        frames.shear_ratio,
        (POINTS, *SLOPES),
        low,
        high,
        edge,
        normal,
        blur,
        narrow,
    )
    passed_ratio, on_edge_ratio = _passed_light(frames)
    return PupilSurvey(
        frames=frames,
        slope_low_px=low,
        slope_high_px=high,
        edge_slope_px=edge,
        edge_normal_px_per_um=normal,
        blur_radius_px=blur,
        narrow_ratio=narrow * 2.0 / (frames.wavelength_nm / 1000.0),
        passed_ratio=passed_ratio,
        edge_light_um=frames.wavelength_nm / 1000.0 * on_edge_ratio / passed_ratio,
    )


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _edge_light_outside(
    edge_px: NDArray[np.float64],
    normal: NDArray[np.float64],
    edge_um: float,
    radius_px: float,
) -> float:
    """Return the share of the light that the edge of the pupil sends outside a disc."""
    total = 0.0
    for i in range(edge_px.shape[0]):
        sx, sy = edge_px[i, 0], edge_px[i, 1]
        nx, ny = normal[i, 0], normal[i, 1]
        a = nx * nx + ny * ny
        b = sx * nx + sy * ny
        c = sx * sx + sy * sy - radius_px * radius_px
        if c >= 0.0:
            return math.inf
        root = math.sqrt(b * b - a * c)
        total += a / (root - b) + a / (root + b)
    strength_um: float = edge_um / (2.0 * math.pi**2) * total / edge_px.shape[0]
    return strength_um


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _smallest_radii(
    edge_px: NDArray[np.float64],
    normal: NDArray[np.float64],
    edge_um: NDArray[np.float64],
    blur_px: NDArray[np.float64],
    budget: float,
    limit: int,
) -> NDArray[np.int64]:
    radii = np.empty(edge_px.shape[0], np.int64)
    for p in range(edge_px.shape[0]):
        low = math.ceil(blur_px[p] + 0.21) - 1
        step, high = 1, low + 1
        while high < limit:
            lost = _edge_light_outside(edge_px[p], normal[p], edge_um[p], high + 0.5)
            if lost <= budget:
                break
            low, step = high, 2 * step
            high = min(limit, low + step)
        while high - low > 1:
            middle = (low + high) // 2
            lost = _edge_light_outside(edge_px[p], normal[p], edge_um[p], middle + 0.5)
            if lost <= budget:
                high = middle
            else:
                low = middle
        radii[p] = high
    return radii


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]  # numba
def _edge_light_outside_all(
    edge_px: NDArray[np.float64],
    normal: NDArray[np.float64],
    edge_um: NDArray[np.float64],
    radius_px: NDArray[np.float64],
) -> NDArray[np.float64]:
    outside = np.empty(edge_px.shape[0])
    for p in range(edge_px.shape[0]):
        outside[p] = _edge_light_outside(
            edge_px[p], normal[p], edge_um[p], radius_px[p]
        )
    return outside


def _edge_geometry(
    survey: PupilSurvey,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the arguments of the compiled loops: edge slopes, normals, strengths."""
    return survey.edge_slope_px, survey.edge_normal_px_per_um, survey.edge_light_um


def edge_light_outside(
    survey: PupilSurvey, *, radius_px: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the share (P,) of the light that the edges send outside discs.

    The formula is that of `needed_radius_px`.  The result is infinite if the geometric
    spot extends to the rim of the disc.

    Parameters
    ----------
    radius_px : (P,)
        Radii of the discs.
    """
    outside = _edge_light_outside_all(*_edge_geometry(survey), radius_px + 0.5)
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
    radii: NDArray[np.int64] = _smallest_radii(
        *_edge_geometry(survey),
        survey.blur_radius_px,
        float(lost_energy_ratio),
        RADIUS_LIMIT_PX,
    )
    if tail_end_px is None:
        return radii
    is_within = np.ceil(survey.blur_radius_px + PIXEL_CORNER_PX) <= tail_end_px
    bounded: NDArray[np.int64] = np.where(
        is_within, np.minimum(radii, tail_end_px), radii
    )
    return bounded
