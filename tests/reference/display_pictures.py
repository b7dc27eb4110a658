"""Pictures of a white point on measured displays, with their 31 wavelengths.

The point is seen by an eye without other aberrations than the color of people's
(Indiana eye), in focus at 555 nm.  The true picture has a PSF for each wavelength, seen
with the color-matching functions of CIE 1931 and shown in the display's primaries.
Others have one or two wavelengths for each primary.  Errors are those of the picture
around the point, over its brightest pixel.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import filter_service
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.vergence import chromatic_refraction_dpt
from estimator.psf.compute import compute_psfs
from filter_service.displays import primary_shares

SPECTRA = Path(filter_service.__file__).with_name("display_spectra.json")
PITCH_MRAD = 0.29
HALF_WIDTH_MRAD = 12.0
PUPIL_MM = 5.0


def measured_displays() -> dict[str, tuple[NDArray, NDArray]]:
    """Wavelengths (31,), nm, and power (31, 3) of measured displays by name."""
    content = json.loads(SPECTRA.read_text(encoding="utf-8"))
    at_nm = np.array(content["wavelengths_nm"], dtype=np.float64)
    displays = content["displays"].items()
    return {name: (at_nm, np.array(power)) for name, power in displays}


@cache
def psf(wavelength_nm: float, defocus_dpt: float) -> NDArray[np.float64]:
    """Kernel [y, x] of one wavelength; the defocus is that at 555 nm."""
    refraction_dpt = chromatic_refraction_dpt(wavelength_nm)
    shift_dpt = refraction_dpt - chromatic_refraction_dpt(REFERENCE_WAVELENGTH_NM)
    zernike_um = np.zeros((1, 28))
    radius_mm = PUPIL_MM / 2.0
    total_dpt = shift_dpt + defocus_dpt
    zernike_um[0, 4] = -total_dpt * radius_mm**2 / (4.0 * np.sqrt(3.0))
    return compute_psfs(
        zernike_um,
        pupil_diameter_mm=PUPIL_MM,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=PITCH_MRAD,
        radius_px=round(HALF_WIDTH_MRAD / PITCH_MRAD),
    )[0].kernel


def true_picture(at_nm: NDArray, power: NDArray, defocus_dpt: float) -> NDArray:
    """White point (3, y, x) in the display's primaries."""
    shares = primary_shares(at_nm, power).sum(axis=1)
    kernels = np.stack([psf(nm, defocus_dpt) for nm in at_nm.tolist()])
    return np.tensordot(shares, kernels, axes=1)


def single_picture(wavelengths_nm, defocus_dpt: float) -> NDArray:
    """The same with one wavelength for each primary."""
    return np.stack([psf(nm, defocus_dpt) for nm in wavelengths_nm])


def wide_picture(wavelengths_nm, widths_nm, defocus_dpt: float) -> NDArray:
    """The same with two wavelengths for each primary."""
    middle_nm, width_nm = np.array(wavelengths_nm), np.array(widths_nm)
    low, high = (
        single_picture((middle_nm + sign * width_nm).tolist(), defocus_dpt)
        for sign in (-1.0, 1.0)
    )
    return 0.5 * (low + high)


def encoded(light: NDArray) -> NDArray:
    """SRGB values, 0 to 1."""
    light = np.clip(light, 0.0, 1.0)
    return np.where(
        light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055
    )


def errors_db(ours: NDArray, truth: NDArray) -> tuple[float, float]:
    """PSNR in linear light and encoded, over the brightest pixel."""
    scale = truth.max()
    linear = np.mean((ours / scale - truth / scale) ** 2)
    coded = np.mean((encoded(ours / scale) - encoded(truth / scale)) ** 2)
    return float(-10.0 * np.log10(linear)), float(-10.0 * np.log10(coded))
