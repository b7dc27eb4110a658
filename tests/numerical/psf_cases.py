"""Shared by the PSF tests and `bench_psf.py`: wavefronts, a test image, error measures.

No tests here.  The wavefronts and where they come from: tests/data/psf_cases.json, and
psf_field_cases.json for traced eyes over the visual field.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.fft
from PIL import Image, ImageDraw, ImageFont

from estimator.pinhole import pixel_from_mrad
from estimator.psf_reference import reference_kernel
from estimator.psf_types import disc_mask
from estimator.zernike import index_from_nm, remove_central_tilt, rescale_pupil

CASES = json.loads(
    (Path(__file__).parents[1] / "data" / "psf_cases.json").read_text(encoding="utf-8")
)
CASE_NAMES = tuple(CASES["cases"])
FIELD_CASES = json.loads(
    (Path(__file__).parents[1] / "data" / "psf_field_cases.json").read_text("utf-8")
)
EYE_NAMES = tuple(FIELD_CASES["eyes"])
ECCENTRICITIES_DEG = {(0, 0): 0, (16, 12): 20, (33, 24): 40}
DENSITIES_MRAD = CASES["pixel_pitch_mrad"]
PUPILS_MM = tuple(CASES["pupil_diameters_mm"])


def zernike_from_terms(terms: dict[str, float]) -> np.ndarray:
    zernike_um = np.zeros(28)
    for key, value in terms.items():
        zernike_um[index_from_nm(*map(int, key.split(",")))] = value
    return zernike_um


def case_zernike_um(name: str, pupil_diameter_mm: float) -> np.ndarray:
    """Coefficients (28,) of a case on the given pupil, chief ray at zero slope."""
    zernike_um = zernike_from_terms(CASES["cases"][name]["zernike_um"])
    ratio = pupil_diameter_mm / CASES["zernike_diameter_mm"]
    return remove_central_tilt(rescale_pupil(zernike_um, radius_ratio=ratio))


def configurations() -> list[tuple[str, float, float]]:
    """(case, pupil_mm, wavelength_nm): four pupils at 550 nm, and 450 and 650 nm."""
    rows = [(name, d, 550.0) for name in CASE_NAMES for d in PUPILS_MM]
    rows += [(name, 5.0, w) for name in CASE_NAMES for w in (450.0, 650.0)]
    return rows + [(name, 2.0, 650.0) for name in CASE_NAMES]


@dataclass(frozen=True)
class FieldCase:
    """One traced eye, direction, pupil and pixel size, as the PSF engines take it."""

    eye: str
    eccentricity_deg: int
    pupil_diameter_mm: float
    density: str
    zernike_um: np.ndarray
    options: dict

    def __str__(self):
        return (
            f"{self.eye}-{self.eccentricity_deg}deg-{self.pupil_diameter_mm:g}mm-"
            f"{self.density}"
        )


def field_case(eye, eccentricity_deg, pupil_diameter_mm, density) -> FieldCase:
    """Look a case up; its Jacobian is that of a pinhole with this pixel at its axis."""
    for row in FIELD_CASES["eyes"][eye]:
        place = ECCENTRICITIES_DEG[row["h_deg"], row["v_deg"]]
        if (place, row["pupil_diameter_mm"]) == (eccentricity_deg, pupil_diameter_mm):
            break
    else:
        raise KeyError(eye, eccentricity_deg, pupil_diameter_mm)
    side_px = 2000.0 / DENSITIES_MRAD[density]
    jacobian = pixel_from_mrad(
        row["h_deg"], row["v_deg"], tangents=(-1, 1, 1, -1), size_px=(side_px, side_px)
    )
    options = {
        "pupil_diameter_mm": 2.0 * row["zernike_radius_mm"],
        "wavelength_nm": FIELD_CASES["wavelength_nm"],
        "pupil_ellipse": np.array(row["ellipse_mm"]),
        "pixel_from_mrad": jacobian,
    }
    return FieldCase(
        eye,
        eccentricity_deg,
        pupil_diameter_mm,
        density,
        np.array(row["zernike_um"]),
        options,
    )


def field_cases() -> list[FieldCase]:
    """Six eyes x 0, 20 and 40 degrees x pupils of 2 to 7 mm x three pixel sizes."""
    return [
        field_case(eye, degrees, pupil_mm, density)
        for density in DENSITIES_MRAD
        for eye in EYE_NAMES
        for degrees in ECCENTRICITIES_DEG.values()
        for pupil_mm in (2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
    ]


def compared_radius_px(blur_radius_px: float) -> int:
    """Radius on which a kernel is compared: the spot and the Airy rings around it."""
    return int(np.ceil(blur_radius_px)) + 5


def truth(
    name: str, pupil_mm: float, wavelength_nm: float, pitch_mrad: float, radius_px: int
) -> np.ndarray:
    return reference_kernel(
        case_zernike_um(name, pupil_mm),
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pitch_mrad,
        radius_px=radius_px,
    )


def physical_kernel(psf, radius_px: int) -> np.ndarray:
    """Shares of the whole light in the middle (2r+1)² of a PSF, float64."""
    kernel = psf.kernel.astype(np.float64) * (1.0 - psf.lost_energy_ratio)
    if radius_px > psf.radius_px:
        return np.pad(kernel, radius_px - psf.radius_px)
    inner = slice(psf.radius_px - radius_px, psf.radius_px + radius_px + 1)
    return kernel[inner, inner]


def kernel_errors(kernel: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Relative L2 error and energy error inside the disc of the reference's array."""
    disc = disc_mask(reference.shape[0] // 2)
    difference = (kernel - reference)[disc]
    l2 = float(np.linalg.norm(difference) / np.linalg.norm(reference[disc]))
    return l2, float(difference.sum())


def _smooth_noise(rng: np.random.Generator, size_px: int) -> np.ndarray:
    """Noise with the 1/f amplitude spectrum of photographs, in 0..1."""
    frequency = np.hypot(np.fft.fftfreq(size_px)[:, None], np.fft.fftfreq(size_px))
    frequency[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.standard_normal((size_px, size_px))) / frequency
    spectrum[0, 0] = 0.0
    noise = np.fft.ifft2(spectrum).real
    return np.clip(0.35 + 0.18 * noise / noise.std(), 0.0, 1.0)


def make_test_image(size_px: int = 512) -> np.ndarray:
    """(512, 512) float64 linear, peak 1: photo-like, black text on white, small marks.

    The upper half is 1/f noise with hard-edged objects, the lower left text, the lower
    right marks of 1 to 3 px, white on black: the hardest content for a PSF's tails.
    """
    rng = np.random.default_rng(20)
    half = size_px // 2
    image = _smooth_noise(rng, size_px)
    for _ in range(24):
        y, x = rng.integers(0, half - 24), rng.integers(0, size_px - 48)
        h, w = rng.integers(6, 24), rng.integers(6, 48)
        image[y : y + h, x : x + w] = rng.uniform()
    page = Image.new("L", (half, half), 255)
    draw = ImageDraw.Draw(page)
    for row, size in enumerate((10, 11, 12, 14, 16, 20, 26, 32)):
        font = ImageFont.load_default(size)
        draw.text((4, 4 + 30 * row), "The quick brown fox 0123", font=font, fill=0)
    image[half:, :half] = (np.asarray(page) / 255.0) ** 2.2
    marks = np.zeros((half, half))
    for y in range(6, half - 6, 12):
        for x in range(6, half - 6, 12):
            h, w = rng.integers(1, 4, 2)
            marks[y : y + h, x : x + w] = 1.0
    image[half:, half:] = marks
    return image


def filter_psnr_db(image: np.ndarray, kernel: np.ndarray, reference: np.ndarray):
    """PSNR (peak 1) between the image filtered with each kernel, both at unit sum."""
    difference = kernel / kernel.sum() - reference / reference.sum()
    size = scipy.fft.next_fast_len(image.shape[0] + difference.shape[0])
    spectrum = scipy.fft.rfft2(image, (size, size))
    spectrum *= scipy.fft.rfft2(difference, (size, size))
    error = scipy.fft.irfft2(spectrum, (size, size))
    half = difference.shape[0] // 2
    inside = error[half : half + image.shape[0], half : half + image.shape[1]]
    return float(-10.0 * np.log10(np.mean(inside**2)))
