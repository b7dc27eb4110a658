"""Retinal images of a flat scene through a measured wavefront, by quadrature.

Ground truth for images and their derivatives by pupil, focus and the profile.  The way
from a profile's coefficients to the image is written anew, in closed form or as
float64 quadrature: Zernike polynomials, the plane of the entrance pupil by rays, the
least-squares focus, and one PSF (`psf_integral`) that reaches over the whole image,
without crop, interpolation or quantization.  Outside the image, the scene is assumed to
continue: light is divided by the share of the PSF within the image.
"""

import math
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval2d
from numpy.typing import NDArray
from scipy.signal import convolve2d, fftconvolve
from scipy.special import roots_legendre

from tests.reference.psf_integral import reference_kernel

DEPTH_MM = 3.05
"""From the cornea to the entrance pupil of an eye that is only a wavefront."""

ORDER = 10
"""Radial order of the wavefront in the entrance pupil."""

FIT_ORDER = 6
"""Radial order of the fit to moved wavefronts in the filter."""

REFERENCE_NM = 555.0

AMPLITUDE_DPT = 10.0
"""Range of accommodation of an eye whose age is not given."""


@cache
def zernike_polynomial(n: int, m: int) -> NDArray[np.float64]:
    """Return coefficients [a, b] of x^a y^b of an OSA-normalized Zernike polynomial."""
    turned = np.zeros((n + 1, n + 1))  # Re or Im of (x + i y)^|m|
    size = abs(m)
    for k in range(size + 1):
        value = math.comb(size, k) * 1j**k
        turned[size - k, k] = value.imag if m < 0 else value.real
    square = np.zeros((3, 3))
    square[2, 0] = square[0, 2] = 1.0
    found = np.zeros((n + 1, n + 1))
    power = np.ones((1, 1))  # of the squared radius
    for k in range((n - size) // 2 + 1):
        s = (n - size) // 2 - k
        radial = (-1) ** s * math.factorial(n - s)
        radial /= math.factorial(s) * math.factorial((n + size) // 2 - s)
        radial /= math.factorial((n - size) // 2 - s)
        part = convolve2d(power, turned)[: n + 1, : n + 1]
        found[: part.shape[0], : part.shape[1]] += radial * part
        power = convolve2d(power, square)
    norm: float = math.sqrt((n + 1) * (2 if m else 1))
    return norm * found


def zernike_terms() -> list[tuple[int, int]]:
    """Return (n, m) up to `ORDER`, in the order of OSA indices."""
    return [(n, m) for n in range(ORDER + 1) for m in range(-n, n + 1, 2)]


@cache
def disc_nodes() -> tuple[NDArray[np.float64], ...]:
    """Return x, y and weights of a quadrature over the unit disc; weights sum to 1."""
    node, weight = roots_legendre(20)
    radius = np.sqrt((node + 1.0) / 2.0)[:, None]
    angle = 2.0 * np.pi * np.arange(64) / 64
    weights = np.broadcast_to(weight[:, None] / 2.0 / angle.size, (20, 64))
    return radius * np.cos(angle), radius * np.sin(angle), weights


@cache
def zernike_values() -> NDArray[np.float64]:
    """Return the polynomials (n_terms, ...) at the nodes of the disc."""
    x, y, _ = disc_nodes()
    return np.stack([polyval2d(x, y, zernike_polynomial(*t)) for t in zernike_terms()])


def chromatic_dpt(wavelength_nm: float) -> float:
    """Return the refraction of the Indiana chromatic eye (Thibos et al. 1992)."""
    return 1.68524 - 633.46 / (wavelength_nm - 214.102)


@dataclass(frozen=True)
class FlatScene:
    """A scene at one distance through an eye in one state.

    Attributes
    ----------
    cornea_um : (n, n)
        Wavefront at the cornea, coefficients [a, b] of x^a y^b, um and mm.
    measured_nm : float
        Wavelength of the wavefront.
    wavelengths_nm : tuple of float
        Of the channels.
    object_dpt : float
        Distance of the scene from the entrance pupil.
    light : (height, width)
        Linear light of the scene in each channel.
    pitch_mrad : (x, y)
        Pixel of the camera on its axis.
    fit_radius_mm : float, optional
        Radius of a circle over which the wavefront in the entrance pupil is fitted up
        to `FIT_ORDER`; by default, it is that of the rays.
    """

    cornea_um: NDArray[np.float64] = field(repr=False)
    measured_nm: float
    pupil_diameter_mm: float
    focus_dpt: float
    object_dpt: float
    light: NDArray[np.float64] = field(repr=False)
    pitch_mrad: tuple[float, float]
    wavelengths_nm: tuple[float, ...] = (REFERENCE_NM,)
    fit_radius_mm: float | None = None

    def with_power(self, sphere_dpt: float) -> "FlatScene":
        """Return the scene with a sphere at the cornea added to the eye."""
        cornea_um = self.cornea_um.copy()
        cornea_um[2, 0] -= sphere_dpt / 2.0
        cornea_um[0, 2] -= sphere_dpt / 2.0
        return replace(self, cornea_um=cornea_um)

    def with_term(self, n: int, m: int, um: float, radius_mm: float) -> "FlatScene":
        """Return the scene with a Zernike term of a circle added to the eye."""
        return replace(self, cornea_um=self.cornea_um + _in_mm({(n, m): um}, radius_mm))

    @cached_property
    def wavefront_um(self) -> NDArray[np.float64]:
        """Coefficients (n_terms,) of the relaxed eye in its pupil, by rays.

        Each ray moves by its slope, and W grows by half the squared slope (eikonal
        equation).  The chief ray, through the center of the pupil, has no slope.
        """
        x, y, weight = disc_nodes()
        radius_mm = self.pupil_diameter_mm / 2.0
        if self.fit_radius_mm is None:
            value = self._moved_um(radius_mm * x, radius_mm * y)
        else:
            whole = self._moved_um(self.fit_radius_mm * x, self.fit_radius_mm * y)
            fitted = np.einsum("tij,ij,ij->t", zernike_values(), whole, weight)
            terms = dict(zip(zernike_terms(), fitted.tolist(), strict=True))
            terms = {t: um for t, um in terms.items() if t[0] <= FIT_ORDER}
            polynomial_um = _in_mm(terms, self.fit_radius_mm)
            value = polyval2d(radius_mm * x, radius_mm * y, polynomial_um)
        return np.einsum("tij,ij,ij->t", zernike_values(), value, weight)

    def _moved_um(
        self, at_x: NDArray[np.float64], at_y: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the wavefront at points of the entrance pupil, mm."""
        own = self.cornea_um.copy()
        own[1, 0] = own[0, 1] = 0.0
        by_x, by_y = polyder(own, axis=0), polyder(own, axis=1)
        from_x, from_y = at_x, at_y
        for _ in range(30):
            slopes = polyval2d(from_x, from_y, by_x), polyval2d(from_x, from_y, by_y)
            from_x = at_x - DEPTH_MM * slopes[0] / 1e3
            from_y = at_y - DEPTH_MM * slopes[1] / 1e3
        value = polyval2d(from_x, from_y, own)
        return value + DEPTH_MM * (slopes[0] ** 2 + slopes[1] ** 2) / 2e3

    def kernel(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the PSF of a channel, wide enough to reach over the whole image."""
        zernike_um = self.wavefront_um.copy()
        # M = -4 sqrt(3) C(2,0) / r^2, by least squares over the pupil.
        per_dpt_um = (self.pupil_diameter_mm / 2.0) ** 2 / (4.0 * math.sqrt(3.0))
        shift_dpt = chromatic_dpt(REFERENCE_NM) - chromatic_dpt(self.measured_nm)
        relaxed_dpt = shift_dpt - zernike_um[4] / per_dpt_um
        accommodation_dpt = np.clip(relaxed_dpt + self.focus_dpt, 0.0, AMPLITUDE_DPT)
        color_dpt = chromatic_dpt(wavelength_nm) - chromatic_dpt(self.measured_nm)
        added_dpt = self.object_dpt - accommodation_dpt + color_dpt
        zernike_um[4] -= added_dpt * per_dpt_um
        return reference_kernel(
            zernike_um,
            pupil_diameter_mm=self.pupil_diameter_mm,
            wavelength_nm=wavelength_nm,
            radius_px=max(self.light.shape) - 1,
            pixel_pitch_mrad=self.pitch_mrad,
            workers=1,
        )

    def image(self) -> NDArray[np.float64]:
        """Return the image (height, width, n_channels)."""
        return np.stack([self._channel(nm) for nm in self.wavelengths_nm], axis=-1)

    def _channel(self, wavelength_nm: float) -> NDArray[np.float64]:
        kernel = self.kernel(wavelength_nm)
        inside = fftconvolve(np.ones(self.light.shape), kernel, mode="same")
        return fftconvolve(self.light, kernel, mode="same") / inside


def _in_mm(
    terms_um: dict[tuple[int, int], float], radius_mm: float
) -> NDArray[np.float64]:
    """Return coefficients [a, b] of x^a y^b, mm, of Zernike terms of a circle."""
    found = np.zeros((ORDER + 1, ORDER + 1))
    for (n, m), um in terms_um.items():
        powers = np.add.outer(np.arange(n + 1), np.arange(n + 1))
        found[: n + 1, : n + 1] += um * zernike_polynomial(n, m) / radius_mm**powers
    return found


def wavefront_of_profile(profile: dict) -> tuple[NDArray[np.float64], float]:
    """Return the wavefront at the cornea, as of `FlatScene`, and its wavelength, nm.

    A prescription has the axis as the examiner sees it: x is mirrored.
    """
    if profile["kind"] == "zernike":
        terms_um = {
            tuple(map(int, name.split(","))): um
            for name, um in profile["zernike_um"].items()
        }
        radius_mm = profile["pupil_diameter_mm"] / 2.0
        return _in_mm(terms_um, radius_mm), profile["wavelength_nm"]
    cylinder_dpt = profile.get("cylinder_dpt", 0.0)
    angle = 2.0 * math.radians(180.0 - profile.get("axis_deg", 0.0))
    mean_dpt = profile["sphere_dpt"] + cylinder_dpt / 2.0
    j0_dpt, j45_dpt = (-cylinder_dpt / 2.0 * f(angle) for f in (math.cos, math.sin))
    found = np.zeros((ORDER + 1, ORDER + 1))
    found[2, 0], found[0, 2] = -(mean_dpt + j0_dpt) / 2.0, -(mean_dpt - j0_dpt) / 2.0
    found[1, 1] = -j45_dpt
    return found, REFERENCE_NM


def derivative(image_at, value: float, step: float) -> NDArray[np.float64]:
    """Return a central difference of fourth order of images of float64."""
    low_2, low, high, high_2 = (image_at(value + k * step) for k in (-2, -1, 1, 2))
    return (8.0 * (high - low) - (high_2 - low_2)) / (12.0 * step)
