"""Cheap look at every wavefront before its PSF is computed: slopes and radius.

The slopes decide the method, the sampling and the size of the kernel; this is the
pre-pass of the PSF engines (`psf_fourier.py`, `psf_geometric.py`).
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.zernike import EXPONENTS

N_EDGE = 48
_RING_RADII = (0.2, 0.35, 0.5, 0.65, 0.8, 0.9)
_N_RING = 24
RADIUS_LIMIT_PX = 1 << 14


@dataclass(frozen=True)
class PupilSurvey:
    """Slopes of P wavefronts over their pupils, mrad of visual angle.

    Attributes
    ----------
    polynomial_um : (P, 28), um
        Monomial coefficients on the unit circle, piston removed.
    pupil_diameter_mm, wavelength_nm : (P,)
    slope_low_mrad, slope_high_mrad : (P, 2)
        Bounding box (x, y) of the slopes.
    edge_slope_mrad : (P, N_EDGE, 2)
        Slopes along the pupil's edge, anticlockwise from +x.
    blur_radius_px : (P,)
        Largest slope in pixels.
    """

    polynomial_um: NDArray[np.float64]
    pupil_diameter_mm: NDArray[np.float64]
    wavelength_nm: NDArray[np.float64]
    slope_low_mrad: NDArray[np.float64]
    slope_high_mrad: NDArray[np.float64]
    edge_slope_mrad: NDArray[np.float64]
    blur_radius_px: NDArray[np.float64]

    @property
    def half_extent_mrad(self) -> NDArray[np.float64]:
        """(P,): half the larger side of the slope bounding box."""
        return (self.slope_high_mrad - self.slope_low_mrad).max(axis=1) / 2.0

    @property
    def wave_number(self) -> NDArray[np.float64]:
        """(P,): n = 2 g D / lambda, the field's width in units of lambda/D."""
        wavelength_um = self.wavelength_nm / 1000.0
        return 2.0 * self.half_extent_mrad * self.pupil_diameter_mm / wavelength_um


def _sample_points() -> tuple[NDArray, NDArray]:
    edge = 2.0 * math.pi * np.arange(N_EDGE) / N_EDGE
    ring = 2.0 * math.pi * np.arange(_N_RING) / _N_RING
    x = [np.cos(edge)] + [r * np.cos(ring) for r in _RING_RADII] + [np.zeros(1)]
    y = [np.sin(edge)] + [r * np.sin(ring) for r in _RING_RADII] + [np.zeros(1)]
    return np.concatenate(x), np.concatenate(y)


def _monomial_slopes() -> tuple[NDArray, NDArray]:
    """(28, n_points): d/dx and d/dy of every monomial at the sample points."""
    x, y = _sample_points()
    a, b = EXPONENTS[:, :1], EXPONENTS[:, 1:]
    d_x = a * x ** np.maximum(a - 1, 0) * y**b
    d_y = b * x**a * y ** np.maximum(b - 1, 0)
    return d_x, d_y


_SLOPE_X, _SLOPE_Y = _monomial_slopes()


def survey_pupils(
    polynomial_um: NDArray[np.float64],
    *,
    pupil_diameter_mm: NDArray[np.float64],
    wavelength_nm: NDArray[np.float64],
    pixel_pitch_mrad: tuple[float, float],
) -> PupilSurvey:
    """Slope range of P wavefronts from 193 points each (about 3 us per wavefront).

    Parameters
    ----------
    polynomial_um : (P, 28), um
        Monomial coefficients on the unit circle; tilt acts, piston does not.
    pupil_diameter_mm, wavelength_nm : (P,)
    pixel_pitch_mrad : (x, y)
    """
    radius_mm = pupil_diameter_mm[:, None] / 2.0
    slope_x = polynomial_um @ _SLOPE_X / radius_mm
    slope_y = polynomial_um @ _SLOPE_Y / radius_mm
    pitch_x, pitch_y = pixel_pitch_mrad
    length_px = np.hypot(slope_x / pitch_x, slope_y / pitch_y)
    edge = np.stack([slope_x[:, :N_EDGE], slope_y[:, :N_EDGE]], axis=-1)
    polynomial_um = polynomial_um.copy()
    polynomial_um[:, 0] = 0.0
    return PupilSurvey(
        polynomial_um=polynomial_um,
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=wavelength_nm,
        slope_low_mrad=np.stack([slope_x.min(1), slope_y.min(1)], axis=1),
        slope_high_mrad=np.stack([slope_x.max(1), slope_y.max(1)], axis=1),
        edge_slope_mrad=edge,
        blur_radius_px=length_px.max(axis=1),
    )


@njit(cache=True, nogil=True)
def _edge_light_outside(edge_px, normal_px, strength_mrad, radius_px):
    """Share of the light that the pupil's edge throws beyond a disc."""
    total = 0.0
    for i in range(edge_px.shape[0]):
        sx, sy = edge_px[i, 0], edge_px[i, 1]
        nx, ny = normal_px[i, 0], normal_px[i, 1]
        a = nx * nx + ny * ny
        b = sx * nx + sy * ny
        c = sx * sx + sy * sy - radius_px * radius_px
        if c >= 0.0:
            return math.inf
        root = math.sqrt(b * b - a * c)
        total += a / (root - b) + a / (root + b)
    return strength_mrad * total / edge_px.shape[0]


@njit(cache=True, nogil=True)
def _smallest_radii(edge_px, normal_px, strength_mrad, blur_px, budget, limit):
    radii = np.empty(edge_px.shape[0], np.int64)
    for p in range(edge_px.shape[0]):
        low = math.ceil(blur_px[p] + 0.21) - 1
        high = limit
        while high - low > 1:
            middle = (low + high) // 2
            lost = _edge_light_outside(
                edge_px[p], normal_px, strength_mrad[p], middle + 0.5
            )
            if lost <= budget:
                high = middle
            else:
                low = middle
        radii[p] = high
    return radii


@njit(cache=True, nogil=True)
def _edge_light_outside_all(edge_px, normal_px, strength_mrad, radius_px):
    outside = np.empty(edge_px.shape[0])
    for p in range(edge_px.shape[0]):
        outside[p] = _edge_light_outside(
            edge_px[p], normal_px, strength_mrad[p], radius_px[p]
        )
    return outside


def _edge_geometry(survey, pixel_pitch_mrad):
    """Edge slopes and normals in pixels, and the strength of the edge light."""
    pitch = np.asarray(pixel_pitch_mrad)
    angle = 2.0 * math.pi * np.arange(N_EDGE) / N_EDGE
    normal_px = np.stack([np.cos(angle), np.sin(angle)], axis=1) / pitch
    wavelength_um = survey.wavelength_nm / 1000.0
    strength_mrad = wavelength_um / (math.pi**2 * survey.pupil_diameter_mm)
    edge_px = np.ascontiguousarray(survey.edge_slope_mrad / pitch)
    return edge_px, normal_px, strength_mrad


def edge_light_outside(
    survey: PupilSurvey,
    *,
    pixel_pitch_mrad: tuple[float, float],
    radius_px: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Share (P,) of the light beyond the discs of given radii, by the edge's light.

    Infinite where the geometric spot itself reaches the disc's rim; the formula is
    that of `needed_radius_px`.
    """
    geometry = _edge_geometry(survey, pixel_pitch_mrad)
    outside = _edge_light_outside_all(*geometry, radius_px + 0.5)
    return np.where(radius_px + 0.5 > survey.blur_radius_px, outside, math.inf)


def needed_radius_px(
    survey: PupilSurvey,
    *,
    pixel_pitch_mrad: tuple[float, float],
    lost_energy_ratio: float,
) -> NDArray[np.int64]:
    """Smallest kernel radius (P,) px that keeps all but a share of the light.

    Notes
    -----
    Far from the geometric spot only the pupil's edge sends light.  By stationary
    phase on the boundary integral, the edge element dphi at angle phi with local
    slope s and outward normal n sends energy lambda / (4 pi³ R d²) dphi dd to
    theta = s + d n, d of either sign; the caustic factor cancels against the
    Jacobian.  For W = 0 this is the mean Airy tail, 2 lambda / (pi² D theta)
    outside theta; for defocus lambda / (pi² D) [1/(theta-g) + 1/(theta+g)].
    """
    return _smallest_radii(
        *_edge_geometry(survey, pixel_pitch_mrad),
        survey.blur_radius_px,
        float(lost_energy_ratio),
        RADIUS_LIMIT_PX,
    )
