"""Optical transfer functions, and the contrast sensitivity of the visual system.

A transfer function is the autocorrelation of the pupil function, computed by FFT.  The
neural contrast sensitivity is that of the Standard Spatial Observer, which was measured
through natural optics, divided by the modulation transfer of the mean eye.
"""

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from estimator.optics.prescription import C20
from estimator.optics.pupil_screen import PupilScreen
from estimator.optics.units import SPHERE_PER_C20
from estimator.optics.vergence import chromatic_refraction_dpt
from estimator.optics.zernike import (
    exponents,
    radial_order,
    wavefront_polynomial,
    zernike_gradient,
)
from estimator.psf.stiles_crawford import StilesCrawford

OBSERVER_PUPIL_MM = 4.0
"""Natural pupil diameter of the ModelFest observers (displays of 30 cd/m²)."""

MEAN_EYE_NM = 555.0

HIGHEST_CPD = 60.0
"""Nyquist frequency of the foveal cones."""

WHITE_LIGHT = {457.1: 0.0384, 534.0: 0.5760, 609.5: 0.3856}
"""Weights of the wavelengths, nm, that represent white light.

Gauss quadrature of the photopic luminous efficiency (CIE 1924) over the chromatic
refraction of the eye: acuity is within 0.01 logMAR of 33 wavelengths.
"""

WHITE_STEP_CPD, WHITE_STEP_WAVES = 0.75, 0.4
"""Largest frequency step of white light, and largest `STEP_WAVES`.

Acuity is within 0.01 logMAR of 0.2 cycles per degree and 0.25 waves, 0.02 at 6 dpt.
"""


def contrast_sensitivity(frequency_cpd: ArrayLike) -> NDArray[np.float64]:
    """Return the contrast sensitivity (...) with natural optics.

    References
    ----------
    Watson & Ahumada, J. Vision 5(9), 2005: the "HPmH" function of ModelFest.
    """
    cpd = np.abs(np.asarray(frequency_cpd, dtype=np.float64))
    high = 1.0 / np.cosh(np.minimum((cpd / 4.1726) ** 0.7786, 700.0))
    low = 1.0 / np.cosh(np.minimum(cpd / 1.3625, 700.0))
    return 373.08 * (high - 0.8493 * low)


def perfect_transfer(
    frequency_cpd: ArrayLike, *, pupil_diameter_mm: float, wavelength_nm: float
) -> NDArray[np.float64]:
    """Return the diffraction-limited modulation transfer (...) of a circular pupil."""
    cutoff_cpd = math.radians(1.0) * pupil_diameter_mm * 1e6 / wavelength_nm
    ratio = np.clip(np.abs(np.asarray(frequency_cpd)) / cutoff_cpd, 0.0, 1.0)
    return 2.0 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1.0 - ratio**2))


def mean_eye_transfer(
    frequency_cpd: ArrayLike, *, pupil_diameter_mm: float
) -> NDArray[np.float64]:
    """Return the mean modulation transfer (...) of 200 best-corrected eyes at 555 nm.

    The formula is valid for pupils of 2 to 6 mm.

    References
    ----------
    Watson, J. Vision 13(6):18, 2013.
    """
    d = pupil_diameter_mm
    knee_cpd = 21.95 - 5.512 * d + 0.3922 * d**2
    perfect = perfect_transfer(
        frequency_cpd, pupil_diameter_mm=d, wavelength_nm=MEAN_EYE_NM
    )
    falloff = 1.0 + np.square(np.asarray(frequency_cpd) / knee_cpd)
    return np.sqrt(perfect) * falloff**-0.62


def neural_sensitivity(frequency_cpd: ArrayLike) -> NDArray[np.float64]:
    """Return the neural contrast sensitivity (...), without the optics."""
    cpd = np.asarray(frequency_cpd, dtype=np.float64)
    optics = mean_eye_transfer(cpd, pupil_diameter_mm=OBSERVER_PUPIL_MM)
    return contrast_sensitivity(cpd) / np.maximum(optics, 1e-3)


MIN_SAMPLES, MAX_SAMPLES = 128, 1024
"""Number of samples across the circle of the coefficients."""

FREQUENCY_STEP_CPD = 0.3
"""Largest frequency step; with strong defocus, visible detail is below 2 cpd."""

STEP_WAVES = 0.25
"""Largest difference of the wavefront between neighboring samples."""

N_ORIENTATIONS = 90
"""Orientations of means, over half a circle; the other half has the same modulation."""

SPLINE_MARGIN = 12
"""Samples around the requested frequencies: farther ones change a cubic spline by less
than 1e-6."""

NM_PER_MM = 1e6
UM_PER_MM = 1e3


class SteepWavefront(ValueError):
    """A wavefront is too steep to be sampled: hardly any contrast is left."""


@dataclass(frozen=True)
class Transfer:
    """Optical transfer function on a grid of spatial frequencies.

    The arrays below are the grid itself; the methods interpolate in it, at frequencies
    that the caller chooses, and correct it by `edge_ratio`.

    Attributes
    ----------
    frequency_cpd : (n,)
        Frequencies along each axis, cycles per degree, ascending, 0 in the middle.
    transfer_ratio : (n, n), complex
        Values ``[y, x]``, y up; 1 at frequency 0.  It is the transform of the PSF with
        the kernel exp(+2 pi i f . angle).
    pupil_mm2 : float or None
        Area of the pupil, weighted with what it transmits; None if it is not known.
    edge_ratio : float
        Area that the squares of the sampled pupil have, over its area.  A sample that
        the edge crosses has a part of the amplitude, the square of which is too small.
    """

    frequency_cpd: NDArray[np.float64]
    transfer_ratio: NDArray[np.complex128]
    pupil_mm2: float | None = None
    edge_ratio: float = 1.0

    @property
    def radial_cpd(self) -> NDArray[np.float64]:
        """Radial frequencies, (n, n)."""
        return np.hypot(self.frequency_cpd[:, None], self.frequency_cpd)

    def modulation(self, at_cpd: ArrayLike) -> NDArray[np.float64]:
        """Return the modulation transfer (m,), averaged over orientations.

        Parameters
        ----------
        at_cpd : (m,)
            Radial frequencies.
        """
        return np.abs(self._around(at_cpd)).mean(axis=-1)

    def in_phase(self, at_cpd: ArrayLike) -> NDArray[np.float64]:
        """Return the real part (m,), averaged over orientations.

        It excludes detail that a phase shift displaces, and counts detail of reversed
        contrast as negative.  The argument is the same as for `modulation`.
        """
        return self._around(at_cpd).real.mean(axis=-1)

    def at(self, x_cpd: ArrayLike, y_cpd: ArrayLike) -> NDArray[np.complex128]:
        """Return the transfer (...) at frequencies (...); 0 beyond the grid.

        It differs from the grid by `edge_ratio`, and from the closed form of a circular
        pupil of 2 mm by at most 1.5e-4, the grid by 3e-3.

        Parameters
        ----------
        x_cpd, y_cpd : (...)
            Components of the frequencies, to the right and up.
        """
        from scipy.ndimage import map_coordinates

        # Linear interpolation would exceed a steep, convex transfer: by up to 1.8 % at
        # 3 cycles per degree in the preset `keratoconus`.
        middle = self.frequency_cpd.size // 2
        step_cpd = self.frequency_cpd[middle + 1] - self.frequency_cpd[middle]
        steps = np.stack(np.broadcast_arrays(y_cpd, x_cpd)) / step_cpd
        reach = math.ceil(float(np.abs(steps).max(initial=0.0))) + SPLINE_MARGIN
        reach = min(reach, middle)
        kept = slice(middle - reach, middle + reach + 1)
        nearby = self.edge_ratio * self.transfer_ratio[kept, kept]
        nearby[reach, reach] = 1.0
        points = reach + steps.reshape(2, -1)  # map_coordinates rejects a shape of (2,)
        found: NDArray[np.complex128] = map_coordinates(nearby, points, order=3)
        return found.reshape(steps.shape[1:])

    def _around(self, at_cpd: ArrayLike) -> NDArray[np.complex128]:
        """Return the transfer (m, N_ORIENTATIONS) at radial frequencies (m,)."""
        radial_cpd = np.atleast_1d(np.asarray(at_cpd, dtype=np.float64))[:, None]
        angles = np.pi * (np.arange(N_ORIENTATIONS) + 0.5) / N_ORIENTATIONS
        return self.at(radial_cpd * np.cos(angles), radial_cpd * np.sin(angles))


def optical_transfer(
    zernike_um: NDArray[np.float64],
    *,
    zernike_radius_mm: float,
    wavelength_nm: float,
    pupil_ellipse: NDArray[np.float64] | None = None,
    pupil_screen: PupilScreen | None = None,
    stiles_crawford: StilesCrawford | None = None,
    frequency_step_cpd: float = FREQUENCY_STEP_CPD,
) -> Transfer:
    """Return the monochromatic optical transfer function of a wavefront.

    Parameters
    ----------
    zernike_um : (n_terms,)
    zernike_radius_mm : float
        Radius of the circle of the coefficients.
    wavelength_nm : float
    pupil_ellipse : (5,), optional
        Center x, y and semi-axes, mm, and angle, rad, of the pupil within the circle;
        the whole circle by default.
    pupil_screen : PupilScreen, optional
        Complex amplitude of a multifocal lens, such as the ``rings`` of an eye.
    stiles_crawford : StilesCrawford, optional
        Apodization by the directional sensitivity of the cones.
    frequency_step_cpd : float
        Largest frequency step.

    Raises
    ------
    SteepWavefront
        The wavefront is too steep for `MAX_SAMPLES`.
    ValueError
        The wavefront is not finite, or the screen is a lattice of lenslets.
    """
    check_known(zernike_um, pupil_screen)
    per_mm_cpd = math.radians(1.0) * NM_PER_MM / wavelength_nm
    count = max(
        _samples(zernike_um, wavelength_nm, pupil_screen, zernike_radius_mm),
        fft.next_fast_len(
            math.ceil(2.0 * zernike_radius_mm * per_mm_cpd / frequency_step_cpd)
        ),
    )
    step_mm = 2.0 * zernike_radius_mm / count
    along_mm = (np.arange(count) + 0.5) * step_mm - zernike_radius_mm
    clear = clear_pupil(
        along_mm,
        zernike_radius_mm=zernike_radius_mm,
        wavelength_nm=wavelength_nm,
        pupil_ellipse=pupil_ellipse,
        pupil_screen=pupil_screen,
    )
    inside = clear
    if pupil_screen is not None:
        inside = _inside_grid(along_mm, zernike_radius_mm, pupil_ellipse)
    if stiles_crawford is not None:
        per_mm2, centre_mm = stiles_crawford.amplitude(np.array([wavelength_nm]))
        x, y = (np.exp(-per_mm2 * (along_mm - at_mm) ** 2) for at_mm in centre_mm[0])
        clear = clear * (y[:, None] * x)
    wavefront_um = grid_wavefront_um(zernike_um, along_mm / zernike_radius_mm)
    return Transfer(
        frequency_cpd=np.arange(1 - count, count) * per_mm_cpd * step_mm,
        transfer_ratio=_autocorrelation(clear, wavefront_um, wavelength_nm, count - 1),
        pupil_mm2=_area(clear) * step_mm**2,
        edge_ratio=_area(clear) / _area_within(clear, inside),
    )


def white_light_transfer(
    zernike_um: NDArray[np.float64],
    *,
    zernike_radius_mm: float,
    wavelength_nm: float,
    pupil_ellipse: NDArray[np.float64] | None = None,
    pupil_screen: PupilScreen | None = None,
    frequency_step_cpd: float = WHITE_STEP_CPD,
) -> Transfer:
    """Return the optical transfer function of a wavefront for white light, as seen.

    Other wavelengths are out of focus by the longitudinal chromatic aberration of the
    Indiana Eye, and cones are less sensitive to light from the edge of the pupil
    (Stiles-Crawford effect; Atchison et al., JOSA A 19:1073, 2002, on acuity).

    Parameters
    ----------
    zernike_um : (n_terms,)
    zernike_radius_mm : float
        Radius of the circle of the coefficients.
    wavelength_nm : float
        Of the coefficients.
    pupil_ellipse, pupil_screen : optional
        See `optical_transfer`.
    frequency_step_cpd : float
        Largest frequency step.

    Returns
    -------
    Transfer
        Up to `HIGHEST_CPD`.

    Raises
    ------
    ValueError
        As for `optical_transfer`.
    """
    check_known(zernike_um, pupil_screen)
    radius_mm = zernike_radius_mm
    per_mm_cpd = math.radians(1.0) * NM_PER_MM / wavelength_nm
    count = _samples(zernike_um, wavelength_nm, pupil_screen, radius_mm)
    count = math.ceil(count * STEP_WAVES / WHITE_STEP_WAVES)
    # Samples in proportion to the wavelength: the same frequencies for every color.
    step_cpd = min(frequency_step_cpd, 2.0 * radius_mm * per_mm_cpd / count)
    n_steps = math.ceil(HIGHEST_CPD / step_cpd) + 1
    wavelengths_nm = np.array([*WHITE_LIGHT])
    falloff_mm2, _ = StilesCrawford().amplitude(wavelengths_nm)
    shifts_dpt = chromatic_refraction_dpt(wavelengths_nm)
    shifts_dpt -= chromatic_refraction_dpt(wavelength_nm)
    total = np.zeros((2 * n_steps + 1,) * 2, dtype=np.complex128)
    pupil_mm2 = within_mm2 = 0.0
    for at_nm, weight, shift_dpt, per_mm2 in zip(
        wavelengths_nm.tolist(),
        WHITE_LIGHT.values(),
        shifts_dpt,
        falloff_mm2,
        strict=True,
    ):
        step_mm = step_cpd * at_nm / (math.radians(1.0) * NM_PER_MM)
        count = math.ceil(2.0 * radius_mm / step_mm)
        along_mm = (np.arange(count) - 0.5 * (count - 1)) * step_mm
        clear = clear_pupil(
            along_mm,
            zernike_radius_mm=radius_mm,
            wavelength_nm=at_nm,
            pupil_ellipse=pupil_ellipse,
            pupil_screen=pupil_screen,
        )
        inside = clear
        if pupil_screen is not None:
            inside = _inside_grid(along_mm, radius_mm, pupil_ellipse)
        seen = np.exp(-per_mm2 * along_mm**2)
        clear = clear * (seen[:, None] * seen)
        shifted_um = np.array(zernike_um, dtype=np.float64)
        shifted_um[C20] -= shift_dpt * radius_mm**2 / SPHERE_PER_C20
        wavefront_um = grid_wavefront_um(shifted_um, along_mm / radius_mm)
        total += weight * _autocorrelation(clear, wavefront_um, at_nm, n_steps)
        pupil_mm2 += weight * _area(clear) * step_mm**2
        within_mm2 += weight * _area_within(clear, inside) * step_mm**2
    return Transfer(
        frequency_cpd=step_cpd * np.arange(-n_steps, n_steps + 1, dtype=np.float64),
        transfer_ratio=total,
        pupil_mm2=pupil_mm2,
        edge_ratio=pupil_mm2 / within_mm2,
    )


def check_known(
    zernike_um: NDArray[np.float64], pupil_screen: PupilScreen | None
) -> None:
    """Raise ValueError for lenslets and for coefficients that are not finite."""
    if pupil_screen is not None and pupil_screen.lattice_mm is not None:
        raise ValueError("pupil_screen: expected rings about one center, got lenslets")
    if not np.all(np.isfinite(zernike_um)):
        raise ValueError("zernike_um: expected finite coefficients")


def _area(clear: NDArray[Any]) -> float:
    """Return the area of a pupil in samples, weighted with what it transmits."""
    return float((np.abs(clear) ** 2).sum())


def _area_within(clear: NDArray[Any], inside: NDArray[np.float64]) -> float:
    """Return the same area by the part of each sample within the pupil."""
    light = np.abs(clear) ** 2
    return float(np.divide(light, inside, out=light, where=inside > 0.0).sum())


def _autocorrelation(
    clear: NDArray[Any],
    wavefront_um: NDArray[np.float64],
    wavelength_nm: float,
    n_steps: int,
) -> NDArray[np.complex128]:
    """Return the transfer, shape (2 n_steps + 1,) * 2, of a pupil (n, n).

    It is 1 at frequency 0, in the middle.
    """
    pupil = clear * np.exp(2j * np.pi * wavefront_um * UM_PER_MM / wavelength_nm)
    padded = fft.next_fast_len(max(2 * len(pupil), 2 * n_steps + 2))
    # One axis after the other, as half the rows are padding.  The intensity is
    # real, so that one half of its transform gives the other.
    field = fft.fft(fft.fft(pupil, padded, axis=1), padded, axis=0)
    half = fft.rfft(field.real**2 + field.imag**2, axis=1)[:, : n_steps + 1]
    kept = np.arange(-n_steps, n_steps + 1) % padded
    half = np.conj(fft.fft(half, axis=0)[kept])
    found = np.empty((2 * n_steps + 1,) * 2, dtype=np.complex128)
    found[:, n_steps:] = half
    found[:, :n_steps] = np.conj(half[::-1, :0:-1])
    return found / found[n_steps, n_steps]


def clear_pupil(
    along_mm: NDArray[np.float64],
    *,
    zernike_radius_mm: float,
    wavelength_nm: float,
    pupil_ellipse: NDArray[np.float64] | None,
    pupil_screen: PupilScreen | None,
) -> NDArray[Any]:
    """Return the pupil function (n, n), y then x, of a flat wavefront.

    Parameters
    ----------
    along_mm : (n,)
        Coordinates along either axis, evenly spaced.
    """
    clear: NDArray[Any] = _inside_grid(along_mm, zernike_radius_mm, pupil_ellipse)
    if pupil_screen is not None:
        clear = clear * _screen_grid(along_mm, wavelength_nm, pupil_screen)
    return clear


def _screen_grid(
    along_mm: NDArray[np.float64], wavelength_nm: float, screen: PupilScreen
) -> NDArray[np.complex128]:
    """Return the amplitude (n, n) of a screen on a grid; one quadrant if it repeats."""
    cx, cy = cast("tuple[float, float]", screen.centre_mm)  # one center
    count, is_central = len(along_mm), cx == cy == 0.0
    if is_central and np.array_equal(along_mm, -along_mm[::-1]):
        count = -(-count // 2)
    x_mm, y_mm = np.meshgrid(along_mm[:count], along_mm[:count])
    square_mm2 = (x_mm - cx) ** 2 + (y_mm - cy) ** 2
    found: NDArray[np.complex128] = screen.transmission(square_mm2, wavelength_nm)
    missing = len(along_mm) - count
    for _ in range(2 if missing else 0):
        found = np.concatenate([found, found[:missing][::-1]]).T
    return found


def grid_wavefront_um(
    zernike_um: NDArray[Any], along: NDArray[Any]
) -> NDArray[np.float64]:
    """Return the wavefront (n, n), y then x, on coordinates (n,) of the unit square."""
    n_powers, (a, b) = radial_order(zernike_um.size) + 1, exponents(zernike_um.size).T
    by_powers = np.zeros((n_powers, n_powers))
    by_powers[b, a] = wavefront_polynomial(zernike_um)
    powers = along[:, None] ** np.arange(n_powers)
    return powers @ by_powers @ powers.T


def _samples(
    zernike_um: NDArray[Any],
    wavelength_nm: float,
    screen: PupilScreen | None,
    radius_mm: float,
) -> int:
    """Return the number of samples across the circle for the slope at its rim.

    The additional samples for a screen are capped at `MAX_SAMPLES`.  This aliases only
    the small share of the light that orders of high power deflect at the rim.
    """
    angles = 2.0 * np.pi * np.arange(72) / 72
    slopes = zernike_gradient(  # per radius
        np.cos(angles), np.sin(angles), n_terms=zernike_um.size
    )
    steepest_um = float(np.linalg.norm(slopes @ zernike_um, axis=-1).max())

    def samples_for(slope_um: float) -> int:
        waves_across = 2.0 * slope_um * UM_PER_MM / wavelength_nm
        return max(MIN_SAMPLES, math.ceil(waves_across / STEP_WAVES))

    needed = samples_for(steepest_um)
    if screen is not None and needed <= MAX_SAMPLES:
        deflection_mrad = float(screen.reach_mrad(radius_mm, wavelength_nm))
        with_screen = samples_for(steepest_um + radius_mm * deflection_mrad)
        needed = min(with_screen, MAX_SAMPLES)
    if needed > MAX_SAMPLES:
        raise SteepWavefront(
            f"zernike_um: slope of {steepest_um:.0f} um per pupil radius at the rim; "
            "expected at most "
            f"{MAX_SAMPLES * STEP_WAVES * wavelength_nm / 2.0 / UM_PER_MM:.0f}"
        )
    return fft.next_fast_len(needed)


def _inside_grid(
    along_mm: NDArray[np.float64],
    radius_mm: float,
    ellipse: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    """Return the part (n, n) of each sample within the pupil."""
    x_mm, y_mm = np.meshgrid(along_mm, along_mm)
    return _inside(x_mm, y_mm, radius_mm, ellipse, along_mm[1] - along_mm[0])


def _inside(
    x_mm: NDArray[np.float64],
    y_mm: NDArray[np.float64],
    radius_mm: float,
    ellipse: NDArray[np.float64] | None,
    step_mm: float,
) -> NDArray[np.float64]:
    """Return the part of each sample within the pupil; its edge is a sample wide."""
    radius = np.hypot(x_mm, y_mm) / radius_mm
    circle: NDArray[np.float64] = np.clip(
        0.5 + (1.0 - radius) * radius_mm / step_mm, 0.0, 1.0
    )
    if ellipse is None:
        return circle
    cx, cy, major_mm, minor_mm, angle = ellipse
    along = (x_mm - cx) * np.cos(angle) + (y_mm - cy) * np.sin(angle)
    across = (y_mm - cy) * np.cos(angle) - (x_mm - cx) * np.sin(angle)
    from_rim = 1.0 - np.hypot(along / major_mm, across / minor_mm)
    return np.minimum(circle, np.clip(0.5 + from_rim * minor_mm / step_mm, 0.0, 1.0))
